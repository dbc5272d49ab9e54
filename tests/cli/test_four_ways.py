"""One job, four ways: flags, a config file, --set and Python give the same bits."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from helpers.calls import CALLS, VALUES, flag_of, without
from helpers.commands import CommandLine, succeeds

GIVEN = {
    "simplify": "method keep_region",
    "distill": "steps background schedule method",
    "recover": "steps background schedule sh_degree",
    "adapt": "steps background tolerance prior_views sh_degree",
    "lift": "neighbors spread normal_ratio max_anisotropy opacity",
    "lod": "background size",
    "convert": "box sphere where transform scale rotate translate from_axes to_axes sh_degree",
    "clean": "strength",
}
"""Command with a public function of its name → options that both have, given together."""
SETTINGS = ("simplify", "distill", "recover", "adapt")
"""Commands whose options are settings too."""


def _values(command: str) -> dict[str, str]:
    values = {name: VALUES[command][name].split()[0] for name in GIVEN[command].split()}
    return values | ({} if command in ("simplify", "lift", "convert") else {"seed": "3"})


def _typed(text: str) -> Any:
    """Return what Python takes for an option's text."""
    try:
        numbers = [float(word) if "." in word else int(word) for word in text.split(",")]
    except ValueError:
        return text
    if len(numbers) == 16:
        return np.reshape(numbers, (4, 4))
    return tuple(numbers) if len(numbers) > 1 else numbers[0]


def _python(command: str, folder: Path) -> bytes:
    """Do with Python what a call with values of its options does."""
    values: dict[str, Any] = {name: _typed(text) for name, text in _values(command).items()}
    ball, small, photos = (folder / name for name in ("ball.ply", "small.ply", "photos.json"))
    if command == "lod":
        levels = g2ard.lod(folder / "sky.ply", ratios=(2, 4), views=photos, recover=False, **values)
        g2ard.save_levels(folder / "python", levels.splats)
        return _bytes(folder / "python")
    if command == "simplify":
        made = g2ard.simplify(
            ball, ratio=8, views=photos, **values | {"keep_region": (values["keep_region"],)}
        )
        scene = made.splats
    elif command == "distill":
        scene = g2ard.distill(ball, ratio=8, views=photos, photos=False, size=24, **values).splats
    elif command == "recover":
        scene = g2ard.recover(small, views=photos, teacher=ball, size=24, **values).splats
    elif command == "adapt":
        views = g2ard.load_views(photos, split="train").resized(24)
        targets = g2ard.TeacherRenders(g2ard.load(ball), views, background=values["background"])
        scene = g2ard.adapt(g2ard.load(small), targets, g2ard.AdaptConfig(**values)).splats
    elif command == "convert":
        scene = g2ard.convert(ball, **values)
    elif command == "clean":
        scene = g2ard.clean(folder / "stray.ply", **values).splats
    else:
        points = g2ard.load_points(folder / "cloud.ply")
        scene = g2ard.lift(points.positions, points.colors, **values)
    g2ard.save(folder / "python.ply", scene)
    return _bytes(folder / "python.ply")


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


@pytest.mark.parametrize("command", GIVEN)
def test_the_ways_agree(
    command: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    """All options of a command at once, so that none is lost on any way."""
    folder, words = shutil.copytree(inputs, tmp_path / "files"), CALLS[command].split()

    def run(*more: str) -> bytes:
        succeeds(command_line, folder, *without(words, *_values(command)), "-w", "-q", *more)
        return _bytes(folder / words[-1])

    values = {flag_of(command, name): text for name, text in _values(command).items()}
    expected = _python(command, folder)
    assert run(*(word for pair in values.items() for word in pair)) == expected
    table = "".join(f'{flag[2:]} = "{text}"\n' for flag, text in values.items())
    (folder / "c.toml").write_text(f"[{command}]\n{table}")
    assert run("--config", "c.toml") == expected
    if command in SETTINGS:
        settings = [
            word for name, text in _values(command).items() for word in ("--set", f"{name}={text}")
        ]
        assert run(*settings) == expected
