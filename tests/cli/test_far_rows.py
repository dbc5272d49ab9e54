"""Far Gaussians that a format cannot hold are named before the work begins."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.jobs.convert import convert
from helpers.commands import CommandLine
from helpers.scenes import around, checkered_ball


def spoiled(folder: Path, rows: list[int], away: float, both_sides: bool) -> g2ard.Splats:
    """Write scene.ply, some of whose rows lie far away, and views of it."""
    scene = checkered_ball(600)
    means = scene.means.copy()
    for k, row in enumerate(rows):
        means[row, k % 3] = away if k % 2 == 0 or not both_sides else -away
    scene = replace(scene, means=means)
    g2ard.save(folder / "scene.ply", scene)
    g2ard.save_views(folder / "views.json", around(4))
    return scene


COMMANDS = {
    "simplify": "simplify scene.ply -r 4 -o out.spz",
    "distill": "distill scene.ply -r 4 -o run --format spz --views views.json",
    "lod": "lod scene.ply -o out --format 3dtiles --ratios 2,8 --views views.json",
    "recover": "recover scene.ply --teacher scene.ply --views views.json -o out.spz",
    "adapt": "adapt scene.ply --teacher scene.ply --views views.json -o out.spz",
    "convert": "convert scene.ply out.spz",
    "convert glb": "convert scene.ply out.glb --compress spz",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_far_rows_are_named_before_the_work(
    tmp_path: Path, command_line: CommandLine, name: str
) -> None:
    rows = [20, 3, 599, 100]
    scene = spoiled(tmp_path, rows, 3e7, True)
    status, out, err = command_line(*COMMANDS[name].split(), cwd=tmp_path)
    assert (status, out) == (1, "")
    assert f"row {min(rows)}" in err
    assert not re.search("simplify:|recover:|teacher:|pack:", err)
    assert not any(
        (tmp_path / place).exists() for place in ("out", "out.spz", "out.glb", "run/scene.spz")
    )
    box = [float(v) for v in re.search(r"--box=([-\d.,]+\d)", err)[1].split(",")]
    assert len(convert(scene, box=box)) == len(scene) - len(rows)


def test_wider_gaussians_of_a_reduction_need_fewer_steps(
    tmp_path: Path, command_line: CommandLine
) -> None:
    """A scene that only its reduction fits into the format is not refused."""
    scene = spoiled(tmp_path, [7], 2.0**12 * 1000, False)
    step = 2.0**12 * 1000 / 2**22
    scale = step / 2
    g2ard.save(
        tmp_path / "scene.ply",
        replace(scene, scales=np.full_like(scene.scales, scale)),
        overwrite=True,
    )
    assert command_line("convert", "scene.ply", "a.spz", cwd=tmp_path)[0] == 1
    assert (
        command_line("simplify", "scene.ply", "-r", 20, "--no-views", "-o", "b.spz", cwd=tmp_path)[
            0
        ]
        == 0
    )
