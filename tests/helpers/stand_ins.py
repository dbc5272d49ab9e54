"""Small files and folders in the place of those that the documentation names.

`provide` makes them; `SHRUNK` and `shrunk` make a printed command small enough for a test.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

import g2ard
from g2ard.io import write_views
from helpers import dataset_files, lpips_weights
from helpers.feature_scenes import blotched
from helpers.photos import cloud_of, photographed, photos_of, rgba_photos_of
from helpers.project import environment
from helpers.scenes import around, checkered_ball, under_a_sky

SCENE = checkered_ball(1000)
ESTONIA = np.array([542_300.0, 6_589_200.0, 30.0])
"""A place in EPSG:32635, the map system that pages name."""
FOCAL = 1200
"""Pixels of the photos in `new/`, as `--focal` says."""

SHRUNK = """
[distill]
size = 48
steps = 5
focus = "far"
[lod]
size = 48
steps = 5
[adapt]
steps = 5
[recover]
size = 48
steps = 5
[compare]
size = 48
looks = 4
[render]
size = 48
[evaluate]
size = 48
"""
"""A config file for printed commands, whose own options win."""


def shrunk(words: Sequence[str]) -> list[str]:
    """Divide counts of Gaussians (500 at most) and of steps by a hundred, and shrink turntables and times.

    >>> shrunk(["distill", "-n", "20k", "--steps", "3000", "--time", "2m"])
    ['distill', '-n', '200', '--steps', '30', '--time', '5s']
    """
    found = list(words)
    for i, (option, value) in enumerate(pairwise(words), 1):
        if option == "--time":
            found[i] = "5s"
        number = re.fullmatch(r"([\d.]+)([kM]?)", value)
        if number is None:
            continue
        size = float(number[1]) * {"": 1, "k": 1e3, "M": 1e6}[number[2]] / 100
        if option == "--steps" or (option == "-n" and size >= 1):
            found[i] = str(min(500, max(1, int(size))))
        elif option in ("--orbit", "--pool"):
            found[i] = "8"
    return found


def _trained(path: Path, scene: g2ard.Splats = SCENE) -> None:
    """A scene beside the few small views in which it was trained: to plan views takes seconds."""
    g2ard.save(path, scene)
    g2ard.save_views(path.with_name("cameras.json"), around(8, (48, 36)))


def _small(path: Path) -> None:
    _trained(path, blotched())


def _simplified(path: Path) -> None:
    g2ard.save(path, g2ard.simplify(SCENE, count=250, method="fast").splats)


def _cloud(path: Path) -> None:
    cloud_of(path, SCENE)


def _map_cloud(path: Path) -> None:
    rows = np.arange(len(SCENE))
    cloud_of(
        path,
        SCENE,
        ESTONIA,
        classification=(rows % 2 + 2).astype("u1"),
        intensity=rows.astype("u2"),
    )


def _photos(folder: Path) -> None:
    photos_of(folder, scene=SCENE)


def _photos_with_alpha(folder: Path) -> None:
    rgba_photos_of(folder)


def _inria(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    g2ard.save_views(folder / "cameras.json", photographed(folder / "images", SCENE, around(24)))
    _cloud(folder / "input.ply")


def _colmap(folder: Path, origin: Sequence[float] = (0, 0, 0)) -> None:
    """A COLMAP project; its world is moved to `origin`."""
    (folder / "images").mkdir(parents=True)
    views = photographed(folder / "images", SCENE, around(24))
    moved = views.viewmats.copy()
    moved[:, :3, 3] -= moved[:, :3, :3] @ np.array(origin)
    names = tuple(f"{name}.png" for name in views.names)
    write_views(
        folder, replace(views, viewmats=moved, names=names), format="colmap", overwrite=True
    )
    rows = [
        f"{i} {x} {y} {z} 128 128 128 0.5 1 0 2 0"
        for i, (x, y, z) in enumerate(SCENE.means[::4] + origin)
    ]
    (folder / "sparse/0/points3D.txt").write_text("\n".join(rows) + "\n")


def _map_colmap(folder: Path) -> None:
    _colmap(folder, ESTONIA)


def _city(folder: Path) -> None:
    """Write the files of `python -m benchmarks synth city`."""
    folder.mkdir()
    _cloud(folder / "cloud.ply")
    for name, count in (("train", 24), ("val", 6)):
        (folder / name).mkdir()
        g2ard.save_views(folder / f"{name}.json", photographed(folder / name, SCENE, around(count)))


def _new_photos() -> g2ard.Cameras:
    views = around(3, (400, 300), 7.5)
    Ks = views.Ks.copy()
    Ks[:, [0, 1], [0, 1]] = FOCAL
    return replace(views, Ks=Ks)


def _new(folder: Path) -> None:
    folder.mkdir()
    photographed(folder, blotched(), _new_photos())


def _new_with_lenses(folder: Path) -> None:
    _new(folder)
    transforms = folder / "transforms.json"
    g2ard.save_views(transforms, _new_photos())
    transforms.write_text(transforms.read_text().replace("images/", ""))


def _rough(path: Path) -> None:
    """The poses of `new/`, a little off."""
    moved = _new_photos().viewmats.copy()
    moved[:, :3, 3] += 0.05
    g2ard.save_views(path, replace(_new_photos(), viewmats=moved))


def _run(folder: Path) -> None:
    """A distilled scene; the files that `distill` read are not in it."""
    dense = folder.with_name("scene.ply")
    _trained(dense)
    asked = (
        "distill",
        dense.name,
        "-r",
        "4",
        "--steps",
        "2",
        "--size",
        "32",
        "--no-page",
        "-o",
        folder.name,
    )
    subprocess.run(
        [sys.executable, "-m", "g2ard", *asked, "-q"],
        cwd=folder.parent,
        env=environment(),
        check=True,
    )
    dense.unlink()
    dense.with_name("cameras.json").unlink()


def _views(path: Path) -> None:
    g2ard.save_views(path, around(6))


def _sky(path: Path) -> None:
    _trained(path, under_a_sky(SCENE))


def _matrix_city(folder: Path) -> None:
    """The data set's `small_city` alone."""
    whole = folder.with_name("MatrixCity")
    dataset_files.matrix_city(whole, SCENE)
    (whole / "small_city").rename(folder)


def _kings_college(folder: Path) -> None:
    dataset_files.cambridge(folder, (400, 225), blotched(2500))


def _lpips(folder: Path) -> None:
    folder.mkdir()
    backbone, linear = lpips_weights.weights()
    torch.save(backbone, folder / "alexnet-owt-7be5be79.pth")
    torch.save(linear, folder / "alex.pth")


def _survey(path: Path) -> None:
    path.mkdir()
    _map_cloud(path / "tile_1.laz")


STAND_INS: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(
        ("scene.ply", "scan.ply", "dense.ply", "city.ply", "room.ply", "tree.spz"), _trained
    ),
    **dict.fromkeys(("guitar.compressed.ply", "park24.ply"), _trained),
    "cloud.ply": _cloud,
    **dict.fromkeys(("cloud.laz", "city.laz", "map.laz", "east.laz", "west.laz"), _map_cloud),
    "survey": _survey,
    **dict.fromkeys(("photos", "fox"), _photos),
    **dict.fromkeys(("project", "caliterra"), _colmap),
    "chair": _photos_with_alpha,
    "plush": _inria,
    "folder": _inria,
    "city": _city,
    "small.ply": _small,
    "new": _new,
    "rough.json": _rough,
    "park.ply": _sky,
    "PATH.json": _views,
    "teacher.ply": _trained,
    "theirs.spz": lambda path: g2ard.save(path, SCENE, axes="RDF"),
    "small_city": _matrix_city,
    "KingsCollege": _kings_college,
    "KingsCollege.ply": lambda path: g2ard.save(path, blotched(2500)),
    "weights": _lpips,
}
"""Name → what makes a file or folder of that name."""

PLACEHOLDERS = {
    **dict.fromkeys(("PLAYBOT", "GUITAR", "SCENE", "SCENE…", "PATH"), "scene.ply"),
    "VIEWS": "photos",
    "DIR": "out",
    "636800,851000,400,637400,851600,700": "542200,6589100,0,542400,6589300,60",
    "tcp://HOST:8786": "local",
    "/shared/work": "work",
}
"""Word that a reader replaces → what a test puts there."""

OF_PAGE: dict[str, dict[str, Callable[[Path], None]]] = {
    "README.md": {"scene.ply": _small, "new": _new_with_lenses},
    "docs/how-to/web-delivery.md": {"project": _map_colmap, "run": _run},
    "docs/how-to/lidar-map.md": {"project": _map_colmap},
    "docs/how-to/clean-floaters.md": {"scene.ply": _sky},
    "docs/how-to/own-views.md": {"views.json": _views},
    "docs/how-to/rasteriser.md": {"small.ply": _simplified},
}
"""Page → names that mean something else there."""


def provide(name: str, folder: Path, page: str, store: Path) -> None:
    """Make the file or folder that a word of a command names, unless it exists or no input has that name.

    Args:
        name: the word, such as `scene.ply` or `city/train.json`.
        folder: where the command runs.
        page: the page of the command.
        store: where what was made once is kept.
    """
    first = name.rstrip("/").split("/")[0]
    own = OF_PAGE.get(page, {})
    make = own.get(first) or STAND_INS.get(first)
    if make is None or (folder / first).exists():
        return
    made = store / (page.replace("/", "-") if first in own else "any") / f"for {first}"
    if not made.exists():
        made.mkdir(parents=True)
        make(made / first)
    shutil.copytree(made, folder, dirs_exist_ok=True)
