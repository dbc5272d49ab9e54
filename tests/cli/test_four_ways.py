"""One job, four ways: flags, a config file, --set and Python give the same bits."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from helpers.commands import CommandLine, succeeds
from helpers.photos import cloud_of
from helpers.scenes import around, checkered_ball, under_a_sky

BALL, VIEWS = checkered_ball(400), around(16, (48, 36))
Values = Mapping[str, Any]

OPTIONS: dict[str, tuple[str, dict[str, Any], set[str]]] = {
    "simplify": (
        "simplify ball.ply -r 8 --views views.json",
        {"method": "fast", "keep_region": ((0.0, 0.0, 1.0, 0.8),)},
        {"method", "keep_region"},
    ),
    "distill": (
        "distill ball.ply -r 8 --views views.json --size 32 --focus far --no-page",
        {"steps": 4, "background": (0.25, 0.5, 0.0), "seed": 3, "schedule": "paper", "method": "paper"},
        {"steps", "background", "seed", "schedule", "method"},
    ),
    "recover": (
        "recover small.ply --views views.json --teacher ball.ply",
        {"steps": 4, "background": (0.25, 0.5, 0.0), "seed": 3, "schedule": "paper", "sh_degree": 0},
        {"steps", "background", "seed", "schedule", "sh_degree"},
    ),
    "adapt": (
        "adapt small.ply --views views.json --teacher ball.ply --split all",
        {
            **{"steps": 4, "background": (0.25, 0.5, 0.0), "seed": 3},
            **{"tolerance": 0.5, "prior_views": 0.0, "sh_degree": 0},
        },
        {"steps", "background", "seed", "tolerance", "prior_views", "sh_degree"},
    ),
    "lift": (
        "lift cloud.ply",
        {"neighbors": 12, "spread": 2.0, "normal_ratio": 0.2, "max_anisotropy": 8.0, "opacity": 0.25},
        set(),
    ),
    "lod": (
        "lod ball.ply -r 2,4 --views views.json",
        {"steps": 2, "background": (0.25, 0.5, 0.0), "seed": 3, "size": 24},
        set(),
    ),
    "convert": (
        "convert ball.ply small.ply",
        {
            "box": (-1.0, -1.0, 0.0, 1.0, 1.0, 2.0),
            "sphere": (0.0, 0.0, 0.5, 1.0),
            "where": "opacity > 0.1",
            "transform": (0.0, -2, 0, 5, 2, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1),
            "scale": 0.5,
            "rotate": (0.0, 30.0, 90.0),
            "translate": (1.0, 0.0, -2.0),
            "from_axes": "RFU",
            "to_axes": "RUB",
            "sh_degree": 0,
        },
        set(),
    ),
    "clean": ("clean stray.ply", {"only": ("giant", "haze"), "strength": 0.5, "seed": 3}, set()),
}
"""Command → its words, a value of each option, and those options that are settings too."""


def _text(value: object, between: str = ",") -> str:
    """Write a value as a user types it."""
    if isinstance(value, tuple) and isinstance(value[0], tuple):
        return ";".join(map(_text, value))
    return between.join(map(str, value)) if isinstance(value, tuple) else str(value)


def _flags(values: Values) -> list[str]:
    words = []
    for name, value in values.items():
        words += [f"--{name.replace('_', '-')}", _text(value)]
    return words


def _config(command: str, values: Values) -> str:
    """Write a config file; a number stays a number."""
    lines = [f"[{command}]"]
    for name, value in values.items():
        lines.append(f"{name} = {value if isinstance(value, int | float) else repr(_text(value))}")
    return "\n".join(lines) + "\n"


def _python(command: str, values: dict[str, Any], folder: Path) -> bytes:
    small = g2ard.load(folder / "small.ply")
    if command == "lod":
        levels = g2ard.lod(folder / "ball.ply", ratios=(2, 4), views=folder / "views.json", **values)
        g2ard.save_levels(folder / "python", levels.splats, overwrite=True)
        return _bytes(folder / "python")
    if command == "simplify":
        made = g2ard.simplify(folder / "ball.ply", ratio=8, views=folder / "views.json", **values).splats
    elif command == "distill":
        values = {**values, "size": 32, "settings": {"focus": "far"}}
        made = g2ard.distill(folder / "ball.ply", ratio=8, views=folder / "views.json", **values).splats
    elif command == "recover":
        made = g2ard.recover(
            folder / "small.ply", views=folder / "views.json", teacher=folder / "ball.ply", **values
        ).splats
    elif command == "adapt":
        background = values.get("background", (0.0, 0.0, 0.0))
        targets = g2ard.TeacherRenders(g2ard.load(folder / "ball.ply"), VIEWS, background=background)
        made = g2ard.adapt(small, targets, g2ard.AdaptConfig(**values)).splats
    elif command == "convert":
        if "transform" in values:
            values = {**values, "transform": np.reshape(values["transform"], (4, 4))}
        made = g2ard.convert([folder / "ball.ply", folder / "small.ply"], **values)
    elif command == "clean":
        made = g2ard.clean(folder / "stray.ply", **values).splats
    else:
        points = g2ard.load_points(folder / "cloud.ply")
        made = g2ard.lift(points.positions, points.colors, **values)
    g2ard.save(folder / "python.ply", made, overwrite=True)
    return (folder / "python.ply").read_bytes()


def _bytes(output: Path) -> bytes:
    """Return a scene's file, or all files of levels except for their page."""
    if output.is_file():
        return output.read_bytes()
    if (output / "scene.ply").is_file():
        return (output / "scene.ply").read_bytes()
    files = (path for path in sorted(output.rglob("*")) if path.is_file())
    kept = [path for path in files if path.suffix in (".webp", ".json") and path.parent != output]
    assert kept
    return b"".join(path.read_bytes() for path in kept)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    g2ard.save(folder / "ball.ply", BALL)
    g2ard.save(folder / "small.ply", g2ard.simplify(BALL, count=50, blind=True).splats)
    g2ard.save_views(folder / "views.json", VIEWS)
    cloud_of(folder / "cloud.ply", BALL)
    faint = np.where(np.arange(400) < 20, -9, 3).astype(np.float32)
    g2ard.save(folder / "stray.ply", under_a_sky(replace(BALL, logit_opacities=faint), 60))
    return folder


@pytest.mark.parametrize("command", OPTIONS)
def test_the_ways_agree(command: str, inputs: Path, tmp_path: Path, command_line: CommandLine) -> None:
    """All options of a command at once, so that none is lost on any way."""
    words, values, in_settings = OPTIONS[command]
    folder = shutil.copytree(inputs, tmp_path / "inputs")

    def run(name: str, *more: str) -> bytes:
        output = name if command in ("distill", "lod") else f"{name}.ply"
        succeeds(command_line, folder, *words.split(), *more, "-o", output, "-q")
        return _bytes(folder / output)

    expected = _python(command, values, folder)
    assert run("flags", *_flags(values)) == expected
    (folder / "c.toml").write_text(_config(command, values))
    assert run("config", "--config", "c.toml") == expected
    named = [word for n in values if n in in_settings for word in ("--set", f"{n}={_text(values[n])}")]
    others = {name: value for name, value in values.items() if name not in in_settings}
    assert run("settings", *named, *_flags(others)) == expected
