"""A run of every command that writes files, and the inputs that they share."""

from pathlib import Path

import g2ard
from g2ard.io import write_views
from helpers.photos import cloud_of, photographed
from helpers.scenes import around, checkered_ball, under_a_sky

VIEWED = "--views views.json --steps 2 --size 24"
TRAIN = f"{VIEWED} --teacher ball.ply"
COMMANDS = {
    "run/scene.sog": f"distill ball.ply -r 8 {VIEWED} --keep --format sog -o run",
    "recovered.ply": f"recover ball.ply {TRAIN} -o recovered.ply",
    "adapted.ply": f"adapt ball.ply {TRAIN} -o adapted.ply",
    "small.ply": "simplify ball.ply -r 8 --no-views --parents rows.npy -o small.ply",
    "clean.ply": "clean ball.ply --preview found.png -o clean.ply",
    "tiled.ply": "simplify ball.ply -r 8 --no-views --tile-rows 150 --workers 1 -o tiled.ply",
    "rest.ply": "clean sky.ply --split-sky far.ply -o rest.ply",
    "copy.splat": "convert ball.ply copy.splat",
    "lifted.ply": "lift cloud.ply -o lifted.ply",
    "levels/lod-meta.json": "lod ball.ply -r 4,8 --merge-only --views views.json -o levels",
    "tileset/tileset.json": (
        "lod ball.ply -r 4,8 --merge-only --views views.json --format 3dtiles -o tileset"
    ),
    "turn.webp": "render ball.ply --orbit 4 --size 32 -o turn.webp",
    "chosen.json": "select ball.ply --views views.json -k 4 -o chosen.json",
    "renders": "render ball.ply --views views.json --sheet look.png -o renders",
    "pool.json": "poses ball.ply -k 4 -o pool.json",
    "page.html": "view ball.ply --views views.json -o page.html",
    "two.html": "compare ball.ply other.ply --views views.json -o two.html",
    "sizes.html": "evaluate ball.ply other.ply --teacher ball.ply --views views.json -o sizes.html",
    "tiles/tiles.json": "ingest ball.ply --tile-rows 150 -o tiles",
    "poses.json": "register ball.ply --images photos.json --matcher direct --report page.html -o poses.json",
}
"""Main output → arguments."""


def write_inputs(folder: Path) -> None:
    """Write the inputs of `COMMANDS`."""
    ball = checkered_ball(400)
    g2ard.save(folder / "ball.ply", ball)
    g2ard.save(folder / "sky.ply", under_a_sky(ball))
    g2ard.save(folder / "other.ply", ball.take(range(0, 400, 2)))
    cloud_of(folder / "cloud.ply", ball)
    write_views(folder / "views.json", around(16, (48, 36)))
    write_views(folder / "photos.json", photographed(folder, ball, around(2, (96, 72))))
