"""Working calls of every command, a value of each of its options, and the files that they name.

What holds for all commands is tested on these. The options of a command, their flags, and whether it can be
resumed come from the command itself.
"""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import g2ard
from helpers.cloud_files import las
from helpers.photos import cloud_of, photographed
from helpers.scenes import around, checkered_ball, under_a_sky

_VIEWED = "--views photos.json --size 24"
_TRAINED = f"{_VIEWED} --steps 3"
_TAUGHT = f"{_TRAINED} --teacher ball.ply"
_TILED = "--tile-rows 150 --workers 1"
CALLS = {
    "distill": f"distill ball.ply -r 8 {_TRAINED} --renders --no-page -o out",
    "distill a page": f"distill ball.ply -r 8 {_TRAINED} --renders --keep --format sog -o out",
    "distill tiles": f"distill ball.ply -r 8 {_TRAINED} --renders --focus far --no-page {_TILED} -o out",
    "simplify": "simplify ball.ply -r 8 --views photos.json -o out.ply",
    "simplify blind": "simplify ball.ply -r 8 --no-views --parents rows.npy -o out.ply",
    "simplify tiles": f"simplify ball.ply -r 8 --views photos.json {_TILED} -o out.ply",
    "recover": f"recover small.ply {_TAUGHT} -o out.ply",
    "recover a folder": f"recover small.ply {_TAUGHT} -o out/meta.json",
    "adapt": f"adapt small.ply {_TAUGHT} -o out.ply",
    "register": (
        "register ball.ply --images two.json --poses moved.json --matcher direct --keep all "
        "--report page.html -o out.json"
    ),
    "lift": "lift cloud.ply -o out.ply",
    "ingest": "ingest ball.ply small.ply --tile-rows 150 -o out",
    "ingest a cloud": "ingest cloud.ply --tile-rows 150 -o out",
    "convert": "convert ball.ply -o out.ply",
    "clean": "clean stray.ply -o out.ply",
    "clean a sky": "clean sky.ply --split-sky far.ply --preview found.png -o out.ply",
    "poses": "poses ball.ply -k 8 -o out.json",
    "select": "select ball.ply --views photos.json -k 4 -o out.json",
    "render": f"render ball.ply {_VIEWED} --sheet look.png -o out",
    "render an orbit": "render ball.ply --orbit 4 --size 32 -o out.webp",
    "view": "view ball.ply --views photos.json -o out.html",
    "lod": f"lod sky.ply -r 2,4 {_VIEWED} --merge-only -o out",
    "lod with recovery": f"lod ball.ply -r 1,4 {_TRAINED} -o out",
    "lod tiles": f"lod ball.ply -r 1,4 {_TRAINED} {_TILED} -o out",
    "lod as 3D Tiles": f"lod ball.ply -r 4,8 {_VIEWED} --merge-only --format 3dtiles -o out",
    "evaluate": f"evaluate small.ply {_VIEWED}",
    "evaluate on a page": f"evaluate ball.ply small.ply {_VIEWED} --teacher ball.ply -o out.html",
    "compare": f"compare ball.ply small.ply {_VIEWED}",
    "compare on a page": f"compare ball.ply small.ply {_VIEWED} -o out.html",
    "info": "info ball.ply",
}
"""Name, which begins with the command → arguments, of which the last is the output if there is one."""

WRITING = [name for name, words in CALLS.items() if " -o " in words]
FIRST = list({name.split()[0]: name for name in reversed(WRITING)}.values())
"""The first call of each command that writes an output."""


def output_of(name: str) -> str:
    """Return the main file or folder that a call writes."""
    words = CALLS[name].split()
    inside = {
        "distill": f"scene.{'sog' if 'sog' in words else 'ply'}",
        "lod": "tileset.json" if "3dtiles" in words else "lod-meta.json",
        "ingest": "tiles.json",
    }
    return f"{words[-1]}/{inside[words[0]]}" if words[0] in inside else words[-1]


@cache
def options_of(name: str) -> dict[str, Any]:
    """Return the options of a command, or of a call's command, by name, as its parser has them."""
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.command import app

    register_commands()
    command = get_command(app).commands[name.split()[0]]  # type: ignore[attr-defined]
    return {p.name: p for p in command.params if p.param_type_name == "option"}


def flag_of(command: str, option: str) -> str:
    """Return the long flag of an option; of one that is on in its command's call, its opposite."""
    found = options_of(command)[option]
    # weights count unless a preset says otherwise
    on = found.default is True or option == "weighted"
    off = on and not {*found.secondary_opts} & {*CALLS[command].split()}
    return max(found.secondary_opts if off else found.opts, key=len)


def without(words: list[str], *options: str) -> list[str]:
    """Return the words of a call without some options and their values."""
    found = [options_of(words[0])[name] for name in options]
    flags = {flag: option for option in found for flag in (*option.opts, *option.secondary_opts)}
    rest, kept = iter(words), []
    for word in rest:
        if word not in flags:
            kept.append(word)
        elif not flags[word].is_flag:
            next(rest)
    return kept


COMMON = {
    "views": "few.json",
    "images": "half",
    "size": "20",
    "background": "0.25,0.5,0",
    "up": "1,0,0",
    "render_model": "antialiased",
    "count": "40",
    "ratio": "9",
    "fit": "9kB",
    "min_psnr": "20",
    "min_ssim": "0.6",
    "method": "fast",
    "keep_region": "0,0,1,0.5",
    "schedule": "paper",
    "steps": "4",
    "tile_rows": "100",
    "sh_degree": "0",
    "split": "test",
    "preset": "paper",
    "looks": "9",
    "format": "inria",
    "teacher": "sky.ply",
    "alpha": "mask",
    "photos": "",
    "convention": "inria",
    "box": "-1,-1,0,1,1,1",
    "where": "classification==2",
    "color": "class",
}
"""Values of options that several commands have."""


def _common(names: str) -> dict[str, str]:
    return {name: COMMON[name] for name in names.split()}


VALUES: dict[str, dict[str, str]] = {
    "distill": {
        **_common(
            "count ratio fit min_psnr min_ssim views alpha photos method keep_region schedule"
        ),
        **_common("steps sh_degree size background up tile_rows render_model box where color"),
        "images": "other --photos",
        "held_out": "few.json",
        "preset": "lift",
        "keep": "",
        "format": "splat",
        "views_format": "inria",
        "clean": "",
        "page": "",
        "compare": "",
        "focus": "far",
    },
    "simplify": {
        **_common("count ratio fit min_psnr min_ssim views images preset method keep_region up"),
        **_common("tile_rows render_model box where color"),
        "no_views": "",
        "parents": "rows.npy",
    },
    "recover": {
        **_common(
            "views teacher photos schedule steps sh_degree split size background render_model"
        ),
        "images": "other --photos",
        "alpha": "mask --photos",
        "anchors": "fewer.ply --set period=1",
        "preset": "lift --steps 200",
        "weighted": "",
    },
    "adapt": {
        **_common(
            "views photos alpha teacher steps schedule sh_degree split size background preset"
        ),
        **_common("render_model"),
        "images": "other",
        "tolerance": "0 --steps 600",
        "prior_views": "9",
    },
    "lift": {
        **_common("box where color"),
        "neighbors": "5",
        "spread": "2",
        "normal_ratio": "0.3",
        "max_anisotropy": "1.1",
        "opacity": "0.9",
    },
    "convert": {
        **_common("sh_degree render_model box color"),
        "sphere": "0,0,0.5,0.9",
        "where": "x<0.5",
        "invert": "",
        "layout": "inria",
        "from_axes": "RUB",
        "transform": "0,-2,0,5,2,0,0,0,0,0,2,0,0,0,0,1",
        "scale": "2",
        "rotate": "0,0,90",
        "translate": "1,0,0",
        "recentre": "--translate 5,0,0",
        "to_axes": "RUB",
        "spz_version": "4",
        "compress": "spz",
    },
    "clean": {
        **_common("render_model"),
        "only": "none",
        "split_sky": "sky_alone.ply",
        "strength": "0.9",
        "preview": "found.png",
    },
    "poses": {
        **_common("format looks up"),
        "kind": "aerial",
        "size": "64x48",
        "fov": "30",
    },
    "select": {
        **_common("format views images preset"),
        "k": "5",
        "policy": "directional",
        "split": "all",
    },
    "render": {
        **_common("views images looks convention split size background up render_model"),
        "turn": "8",
        "fps": "9",
        "sheet": "other.png",
        "depth": "",
        "around": "",
    },
    "view": {
        **_common("views images background up render_model"),
        "start": "view_009",
    },
    "lod": {
        **_common("views images steps size background up tile_rows render_model box where color"),
        "ratios": "2,5",
        "recover": "--steps 30",
        "environment": "--ratios 2,4",
        "most": "1",
        "extent": "0.5 --chunk-min 1",
        "least": "1 --chunk-extent 0.5",
        "kind": "3dtiles",
        "place": "25,59,30",
        "unit": "ft",
    },
    "evaluate": {
        **_common("views alpha convention size background render_model"),
        "images": "other",
        "teacher": "ball.ply",
        "anchors": "fewer.ply",
        "output": "page.html ball.ply --teacher ball.ply",
        "eight_bit": "",
        "split": "all",
    },
    "compare": {
        **_common("views images size background render_model"),
        "output": "page.html",
        "looks": "5",
    },
    "ingest": _common("tile_rows render_model box where color"),
    "register": {
        **_common("format split alpha background render_model"),
        "photos": "photos.json",
        "poses": "photos.json",
        "intrinsics": "wide.json",
        "focal": "50",
        "size": "40",
        "refine": "none",
        "passes": "1",
        "accept": "0.9",
        "keep": "registered",
        "truth": "few.json --json told.json",
        "report": "other.html",
    },
    "info": {
        "images": "other",
        "devices": "",
    },
}
"""Command → each option for the result, a value of it that its plainest call has not, and further words."""

_REGISTER = "register ball.ply --keep all --poses moved.json -o out.json"
_MATCHED = f"{_REGISTER} --images two.json --matcher matches:grid"
_CHOICES = ("box", "where", "color")
ON: dict[str, dict[str, str]] = {
    "lift": dict.fromkeys(_CHOICES, "lift scan.las -o out.ply"),
    "ingest": dict.fromkeys(_CHOICES, "ingest scan.las --tile-rows 150 -o out"),
    "simplify": {
        **dict.fromkeys(_CHOICES, "simplify scan.las -r 8 --no-views -o out.ply"),
        **dict.fromkeys(("no_views", "preset", "up"), "simplify ball.ply -r 8 -o out.ply"),
        "images": "simplify ball.ply -r 8 --views sizeless.json -o out.ply",
    },
    "select": {"images": "select ball.ply --views sizeless.json -k 4 -o out.json"},
    "distill": {
        **dict.fromkeys(_CHOICES, f"distill scan.las -r 8 {_TRAINED} --photos --no-page -o out"),
        "views_format": "distill ball.ply -r 8 --steps 3 --size 24 --views made --no-page -o out",
        "compare": "distill ball.ply -r 8 --steps 3 --size 24 --views photos.json --renders -o out",
    },
    "adapt": dict.fromkeys(
        ("alpha", "images"), "adapt small.ply --views photos.json --steps 3 -o out.ply"
    ),
    "convert": {
        "color": "convert scan.las -o out.ply",
        "compress": "convert ball.ply -o out.glb",
        "spz_version": "convert ball.ply -o out.spz",
        "invert": "convert ball.ply --sphere 0,0,0.5,0.9 -o out.ply",
    },
    "lod": {
        **dict.fromkeys(
            _CHOICES, "lod scan.las -r 1,4 --views views.json --size 24 --merge-only -o out"
        ),
        "images": "lod ball.ply -r 1,4 --views sizeless.json --steps 3 -o out",
        "steps": "lod ball.ply -r 1,4 --views photos.json --size 24 -o out",
        "place": "lod ball.ply -r 4,8 --views photos.json --size 24 --merge-only --format 3dtiles -o out",
        "unit": "lod ball.ply -r 4,8 --views photos.json --size 24 --merge-only --format 3dtiles "
        "--georeference 25,59,30 -o out",
    },
    "render": {
        "images": "render ball.ply --views sizeless.json -o out",
        "fps": "render ball.ply --orbit 4 --size 32 -o out.webp",
        "turn": "render ball.ply --size 32 -o out",
        "looks": "render ball.ply --size 32 -o out",
        "up": "render ball.ply --orbit 4 --size 32 -o out",
    },
    "view": {"images": "view ball.ply --views sizeless.json -o out.html"},
    "evaluate": {"views": f"evaluate small.ply --teacher ball.ply {_VIEWED}"},
    "compare": {
        "images": "compare ball.ply small.ply --views sizeless.json",
        "looks": "compare ball.ply small.ply --size 24",
    },
    "register": {
        "focal": f"{_REGISTER} --images pair --focal 48 --matcher direct",
        "intrinsics": f"{_REGISTER} --images pair --intrinsics photos.json --matcher direct",
        "accept": f"{_MATCHED} --json told.json",
        "keep": _MATCHED,
        "passes": f"{_MATCHED} --refine none",
        "refine": _MATCHED,
    },
    "info": {"images": "info photos.json --json -"},
}
"""Command → option that has no effect on its plainest call: the call that it is added to."""

REFUSED: dict[tuple[str, str], str] = {
    ("distill", "fit"): "8,865 bytes are too few",
    ("distill", "keep_region"): "no effect on the method paper",
    ("simplify", "images"): "no effect on the method paper",
    ("simplify", "keep_region"): "no effect on the method paper",
    ("simplify", "up"): "no effect without generated views",
    ("simplify", "views"): "no effect on the method paper",
    ("adapt", "prior_views"): "no effect on the schedule paper",
    ("adapt", "tolerance"): "no effect on the schedule paper",
}
"""Command and option that `--preset paper` refuses → words of the refusal."""


_MATCHES = """import numpy as np


def grid(photo, render):
    pixels = np.stack(np.meshgrid(np.arange(2.0, 47, 3), np.arange(2.0, 35, 3)), -1).reshape(-1, 2)
    return pixels, pixels + (0.5, 0)
"""


def write_inputs(folder: Path) -> None:
    """Write the files that `CALLS`, `VALUES` and `ON` name.

    Photos are half transparent. Those in `other` are of another scene, those in `half` half as wide, which
    only `sizeless.json` takes from them. `matches.grid` matches pixels.
    """
    ball, views = checkered_ball(400), around(16, (48, 36))
    small = g2ard.simplify(ball, count=40, blind=True).splats
    g2ard.save(folder / "ball.ply", ball)
    g2ard.save(folder / "small.ply", small)
    g2ard.save(folder / "other.ply", ball.take(range(0, 400, 2)))
    g2ard.save(folder / "fewer.ply", replace(small, means=small.means * np.float32(1.02)))
    g2ard.save(folder / "sky.ply", under_a_sky(ball))
    faint = np.where(np.arange(400) < 20, -9, 3).astype(np.float32)
    g2ard.save(folder / "stray.ply", under_a_sky(replace(ball, logit_opacities=faint)))
    cloud_of(folder / "cloud.ply", ball)
    classes, rgb = np.arange(400, dtype=np.uint8) % 2 + 2, np.arange(1200).reshape(400, 3) * 50
    las(
        folder / "scan.las", ball.means.astype(float), rgb.astype(np.uint16), classification=classes
    )
    g2ard.save_views(folder / "views.json", views)
    g2ard.save_views(folder / "few.json", around(10, (48, 36), 2.5))
    for name, scene in (("photos", ball), ("other", checkered_ball(300, seed=1))):
        (folder / name).mkdir()
        pictured = photographed(folder / name, scene, views)
        for path in (folder / name).glob("*.png"):
            with Image.open(path) as photo:
                photo.putalpha(Image.linear_gradient("L").resize(photo.size))
                photo.save(path)
        if name == "photos":
            g2ard.save_views(folder / "photos.json", pictured, weights=np.arange(1.0, 17.0))
            g2ard.save_views(folder / "two.json", pictured.take([0, 1]), splits=["train", "test"])
            moved = pictured.viewmats.copy()
            moved[:, :3, 3] += 0.1
            g2ard.save_views(folder / "moved.json", replace(pictured, viewmats=moved))
    (folder / "half").mkdir()
    for path in (folder / "photos").glob("*.png"):
        with Image.open(path) as photo:
            photo.resize((24, 18)).save(folder / "half" / path.name)
    (folder / "pair").mkdir()
    for name in ("view_000.png", "view_001.png"):
        shutil.copy(folder / "photos" / name, folder / "pair" / name)
    g2ard.save_views(folder / "wide.json", replace(views, Ks=views.Ks * [[[0.8], [0.8], [1.0]]]))
    sizeless = {"fl_x": 48.0, "fl_y": 48.0, "frames": []}
    for view in views:
        pose = np.linalg.inv(view.viewmat) * [1, -1, -1, 1]
        sizeless["frames"].append(
            {"file_path": f"photos/{view.name}.png", "transform_matrix": pose.tolist()}
        )
    (folder / "sizeless.json").write_text(json.dumps(sizeless))
    (folder / "matches.py").write_text(_MATCHES)
