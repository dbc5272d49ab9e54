"""Simplification's cells and flags painted on the scene, and the command that renders them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard import io
from g2ard.errors import InputError
from g2ard.report.paint import cell_labels, flag_colors, label_colors, painted
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.select.surfaces import surface
from g2ard.stages.simplify import flag, simplify
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball


def test_cells_are_the_cores() -> None:
    ball = checkered_ball(4000)
    far = Splats.create([[9e6, 0, 0], [9e6, 1, 0]], scales=np.full((2, 3), 0.1)).with_sh_degree(1)
    both = join([ball, far])
    for scene, count in ((ball, 300), (ball, 40), (both, 300), (ball.take([5]), 3)):
        cells, labels = surface(scene, count), cell_labels(scene, count)
        assert labels.shape == (len(scene),)
        assert np.array_equal(np.unique(labels), np.arange(len(cells.centers)))
        middles = np.array([scene.means[labels == c].mean(0) for c in range(len(cells.centers))])
        theirs = cells.centers + cells.origin
        apart = np.linalg.norm(middles[:, None] - theirs[None], axis=2).min(1)
        assert np.median(apart) < 0.3 * cells.size  # their centres are weighed by mass
    lone = cell_labels(both, 300)[-2:]
    assert lone[0] != lone[1]  # beyond the lattice each is a cell of its own
    with pytest.raises(InputError, match="got 0 and 4000"):
        cell_labels(ball, 0)


def test_flags_are_constant_within_a_cell() -> None:
    """Flags are decided per cell: other cells than the core's would hold both kinds."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(6000, 1, 3)) * (rng.random((6000, 1, 1)) < 0.5)
    points = rng.uniform(-1, 1, (6000, 3)) * [1, 1, 0.01]
    noise[points[:, 0] < 0] = 0
    scene = Splats.create(points, scales=np.full((6000, 3), 0.02), sh0=noise)
    flags, labels = flag(scene, 250), cell_labels(scene, 250)
    assert 0.2 < flags.mean() < 0.8
    share = np.bincount(labels, flags) / np.bincount(labels)
    assert np.isin(share, (0, 1)).all()


def test_paint_keeps_geometry_and_shade() -> None:
    ball = checkered_ball(300)
    found = painted(ball, flag_colors(np.arange(300) < 100))
    assert np.array_equal(found.means, ball.means)
    assert np.array_equal(found.logit_opacities, ball.logit_opacities)
    assert found.sh_degree == 0
    assert (found.colors[:100, 0] > found.colors[:100, 2]).all()
    assert (found.colors[100:, 0] < found.colors[100:, 2]).all()
    lumas = ball.colors.sum(1)
    assert found.colors[lumas.argmax()].sum() > 0.3
    labels = label_colors(np.arange(-1, 500))
    assert len(np.unique(labels.round(6), axis=0)) == 501
    assert labels[0].max() < 0.1 < labels[1:].max(1).min()
    with pytest.raises(InputError, match=r"expected shape \(300, 3\)"):
        painted(ball, np.zeros((2, 3)))


def pixels(folder: Path) -> np.ndarray:
    with Image.open(folder / "view_000.png") as image:
        return np.asarray(image).astype(int)


def test_command(command_line: CommandLine, tmp_path: Path) -> None:
    ball = checkered_ball(1500)
    io.write_splats(tmp_path / "ball.ply", ball)
    io.write_views(tmp_path / "views.json", around(2))

    def call(*options: str, out: str) -> tuple[int, str, str]:
        return command_line("render", "ball.ply", "--views", "views.json", "-o", out, *options, cwd=tmp_path)

    for color in ("flags", "cells", "parents"):
        status, said, err = call("--color", color, "-r", "10", out=color)
        assert status == 0, err
        assert f"{color}: " in said + err
    images = {name: pixels(tmp_path / name) for name in ("flags", "cells", "parents")}
    assert (np.abs(images["flags"] - images["cells"]).max(), np.ptp(images["cells"])) > (40, 40)
    ask = ("simplify", "ball.ply", "-r", 10, "--no-views", "-o", "small.ply", "--parents", "to.npy")
    succeeds(command_line, tmp_path, *ask)
    written = np.load(tmp_path / "to.npy")
    assert np.array_equal(written, simplify(io.read_splats(tmp_path / "ball.ply"), 150).parents)
    status, _, err = call("--color", "parents", "--parents", "to.npy", out="again")
    assert status == 0, err
    assert np.array_equal(pixels(tmp_path / "again"), images["parents"])
