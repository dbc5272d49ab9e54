"""`g2ard clean`: Gaussians that it removes and keeps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import render
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import look_at
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.clean import FLOATING, KINDS, compare_depths, find_clutter
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball, views_at


def junk() -> tuple[Splats, np.ndarray]:
    """Return a ball with clutter of every kind, and the kind of each row; −1 for the ball."""
    ball = checkered_ball(2500)
    shells = [replace(ball, means=ball.means * np.float32(1 - 0.02 * i)) for i in range(3)]
    ball = join([replace(shell, logit_opacities=np.full(2500, 5, np.float32)) for shell in shells])
    rng = np.random.default_rng(0)
    within = replace(ball.take(slice(0, 200)), means=ball.means[:200] * 0.3)
    faint = replace(ball.take(slice(0, 50)), logit_opacities=np.full(50, -7, np.float32))
    giant = Splats.create([[0.5, 0, 0]], scales=[[40, 40, 40]], logit_opacities=[-4])
    ends = rng.normal(size=(10, 3))
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    quats = np.concatenate([1 + ends[:, 2:], np.cross([0, 0, 1], ends)], axis=1)

    needles = Splats.create(2 * ends, quats=quats, scales=np.tile([0.002, 0.002, 0.1], (10, 1)))
    floaters = Splats.create(
        [[1.8, 0, 0], [1.81, 0, 0], [0, -2, 0.5]],
        scales=np.full((3, 3), 0.01),
        logit_opacities=[2, 2, 2],
    )
    parts = [ball, within, faint, giant, needles, floaters]
    kinds = np.repeat([-1, 0, 0, 1, 2, 3], [len(part) for part in parts])
    return join(parts), kinds


def find(splats: Splats, **options: object):
    """Find clutter as if views could see all of the scene."""
    views = around(24)
    pixels = int((views.widths * views.heights).sum())
    return find_clutter(
        splats, visibility(splats, views), np.ones(len(splats), bool), pixels, **options
    )


def test_every_kind_is_found_and_the_ball_stays() -> None:
    splats, kinds = junk()
    found = find(splats)
    for number, name in enumerate(KINDS[:4]):
        assert (found.kind[kinds == number] == number).mean() > 0.85, name  # shells have gaps
    outer = np.flatnonzero(kinds < 0)[:2500]
    assert (found.kind[outer] >= 0).mean() < 0.02
    assert sum(found.counts.values()) == (~found.keep).sum()


def test_the_invisible_are_invisible() -> None:
    splats, _ = junk()
    found = find(splats, kinds=("invisible",))
    assert set(np.unique(found.kind)) == {-1, 0}
    views = around(7, distance=2.5)
    for i in range(7):  # other views than were measured
        with_all, without = (render(s, views[i]).image for s in (splats, splats.take(found.keep)))
        assert psnr(np.clip(without, 0, 1), np.clip(with_all, 0, 1)) > 55


def test_gaussians_outside_all_views_stay() -> None:
    splats, _ = junk()
    view = around(24).take([0])
    behind = replace(splats, means=splats.means + (100 * view.positions[0]).astype(np.float32))
    unoccluded, _ = compare_depths(behind, view, floating=False)
    assert not unoccluded.any()
    found = find_clutter(behind, visibility(behind, view), unoccluded, 64 * 48, ("invisible",))
    np.testing.assert_array_equal(found.kind >= 0, splats.logit_opacities < -5.54)


def test_gaussians_behind_a_wall_stay() -> None:
    """Gaussians behind the wall are in the frame, but no view sees them."""
    x, z = np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-3, 3, 61))
    means = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], 1)
    wall = Splats.create(
        means, scales=np.full((x.size, 3), 0.1), logit_opacities=np.full(x.size, 9.0)
    )
    beyond = replace(checkered_ball(500), logit_opacities=np.full(500, 5, np.float32))
    beyond = replace(beyond, means=beyond.means + np.float32([0, 3, 0]))
    before = replace(
        wall.take([0]), means=np.float32([[0, -1, 0]]), logit_opacities=np.float32([-5.4])
    )
    scene = join([wall, beyond, before])
    view = views_at([look_at([0, -4, 0], [0, 0, 0])])
    unoccluded, _ = compare_depths(scene, view, floating=False)
    assert not unoccluded[x.size : -1].any()
    assert unoccluded[-1]
    hidden = visibility(scene, view).weight[x.size : -1]
    assert hidden.max() < 1e-3  # it would be called invisible by what shows alone
    kinds = find_clutter(scene, visibility(scene, view), unoccluded, 64 * 48, ("invisible",)).kind
    assert (kinds[x.size : -1] < 0).all()


def test_a_chain_of_thin_gaussians_is_not_a_needle() -> None:
    """A string: each end lies inside the next Gaussian."""
    along = np.linspace(-1, 1, 21)[:, None] * [1, 0, 0]
    string = Splats.create(
        along, scales=np.tile([0.05, 0.001, 0.001], (21, 1)), logit_opacities=[3] * 21
    )
    scene = join([checkered_ball(500), replace(string, means=string.means + np.float32([0, 0, 2]))])
    found = find(scene, kinds=("needle",))
    assert found.counts["needle"] <= 2  # the string's own ends


def veiled(ball: Splats) -> tuple[Splats, np.ndarray]:
    """Return a ball behind haze, with streaks rooted in it, and the kind of each row; −1 for the ball."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(300, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    quats = np.concatenate([1 + ways[:, 2:], np.cross([0, 0, 1], ways)], axis=1)
    size, white = np.full((200, 3), 0.08), np.full((300, 1, 3), 1.5)
    haze = Splats.create(ways[:200] * rng.uniform(1.3, 1.8, (200, 1)), scales=size, sh0=white[:200])
    streaks = Splats.create(
        1.2 * ways[200:],
        quats=quats[200:],
        scales=np.tile([0.006, 0.006, 0.1], (100, 1)),
        sh0=white[200:],
    )
    parts = [ball, replace(haze, logit_opacities=np.full(200, -2, np.float32)), streaks]
    return join(parts), np.repeat(
        [-1, KINDS.index("haze"), KINDS.index("streak")], list(map(len, parts))
    )


def test_strength_removes_haze_and_streaks_and_keeps_the_ball() -> None:
    ball = checkered_ball(2500)
    scene, kinds = veiled(ball)
    _, floating = compare_depths(scene, around(96))
    found = [
        find(scene, kinds=FLOATING, floating=floating, strength=s) for s in (0, 0.25, 0.5, 0.75)
    ]
    shares = np.array([[(f.kind[kinds == kind] >= 0).mean() for kind in (-1, 4, 5)] for f in found])
    assert (shares[0] == 0).all()
    assert (np.diff(shares, axis=0) >= 0).all()
    assert shares[2, 0] < 0.01
    assert shares[2, 1:].min() > 0.8
    view = around(7)[3]
    clear, veil, clean = (
        render(s, view).image.clip(0, 1) for s in (ball, scene, scene.take(found[2].keep))
    )
    assert psnr(clean, clear) > psnr(veil, clear) + 10


def test_unknown_kinds_are_rejected() -> None:
    splats, _ = junk()
    with pytest.raises(InputError, match="kinds: expected"):
        find(splats, kinds=("dust",))


def test_the_sky_is_kept_apart_and_joined_again(tmp_path: Path, command_line: CommandLine) -> None:
    splats, _ = junk()
    rays = np.random.default_rng(1).normal(size=(400, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    dome = Splats.create(
        60 * rays, scales=np.full((400, 3), 5.0), logit_opacities=np.full(400, 3.0)
    )
    write_splats(tmp_path / "a.ply", join([splats, dome]))
    words = ["clean", "a.ply", "--split-sky", "sky.ply", "-o", "near.ply", "--only", "none"]
    told = succeeds(command_line, tmp_path, *words).err
    assert "sky: 400 Gaussians" in told
    assert (read_splats(tmp_path / "sky.ply").means == dome.means.astype(np.float32)).all()
    succeeds(command_line, tmp_path, "convert", "near.ply", "sky.ply", "both.ply")
    assert (tmp_path / "both.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    words[1:4] = ["near.ply", "--split-sky", "none.ply"]
    words[5] = "same.ply"
    assert "none.ply: not written" in succeeds(command_line, tmp_path, *words).err
    assert not (tmp_path / "none.ply").exists()
    refused(command_line, tmp_path, "clean", "a.ply", "--split-sky", "a.ply", "-o", "b.ply")
