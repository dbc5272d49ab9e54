"""The lift against its float64 twin, and on the clouds that break lifts."""

import json

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.scene.splats import SH_C0
from g2ard.stages.lift import _anchor, lift
from helpers.commands import succeeds
from helpers.threads import on_threads
from reference.lift import discs


def surface(n=400, seed=0):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-5, 5, (2, n))
    return np.stack([x, y, np.sin(x) + 0.01 * rng.normal(size=n)], 1)


def normals(splats):
    w, x, y, z = splats.quats.T.astype(np.float64)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)


def test_equals_the_naive_twin():
    points = surface()
    got = lift(points, np.full_like(points, 0.25))
    want_normals, want_scales = discs(points - _anchor(points))
    np.testing.assert_allclose(got.scales, want_scales, rtol=1e-5)
    np.testing.assert_allclose(np.abs((normals(got) * want_normals).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * got.sh0[:, 0], 0.25, atol=1e-6)
    np.testing.assert_allclose(got.opacities, 0.5, atol=1e-6)
    assert got.sh_degree == 0


def test_spread_is_an_option():
    points = surface(100)
    got = lift(points, np.full_like(points, 0.25), spread=0.6)
    _, want_scales = discs(points - _anchor(points), spread=0.6)
    np.testing.assert_allclose(got.scales, want_scales, rtol=1e-5)


def test_translation_and_scale_by_powers_of_two_are_exact():
    points = np.round(surface() * 2**20) / 2**20
    colors = np.full_like(points, 0.5)
    here, far = lift(points, colors), lift(points * 4 + 2**22, colors)
    assert far.offset.any()  # float32 cannot hold such coordinates
    np.testing.assert_allclose(far.means + far.offset, points * 4 + 2**22, rtol=0, atol=1e-5)
    for there in (far, lift(points * 4 + 1024, colors)):
        np.testing.assert_array_equal(there.scales, here.scales * 4)
        np.testing.assert_array_equal(there.quats, here.quats)


def test_threads_do_not_matter():
    points = surface(20_000)
    found = on_threads(lambda: lift(points, np.full_like(points, 0.5)).fingerprint())
    assert len(set(found)) == 1


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.zeros((1000, 3)),
        np.array([[0.0, 0, 0], [1, 0, 0]]),
        np.arange(30.0)[:, None] * [1, 0, 0],
        np.concatenate([surface(200), [[1e5, 1e5, 1e5], [-1e5, 0, 0]]]),
        np.repeat(surface(100), 5, 0),
        surface(200) * 1e-9,
        surface(200) * 1e9,
    ],
    ids=["one", "identical", "two", "line", "floaters", "duplicates", "tiny", "huge"],
)
def test_degenerate_clouds_give_sensible_discs(points):
    got = lift(points, np.full(points.shape, 0.5))
    assert len(got) == len(np.unique(points.astype(np.float32), axis=0))
    assert got.finite_rows().all()
    assert (got.scales > 0).all()
    assert (got.scales[:, 0] <= 4.0001 * got.scales[:, 1]).all()


def lines(count, each, noise=0.004, seed=0):
    """A plane of 6 × 6 scanned in lines: points and the distance of lines."""
    x, y = np.tile(np.linspace(-3, 3, each), count), np.repeat(np.linspace(-3, 3, count), each)
    return np.column_stack([x, y, np.random.default_rng(seed).normal(0, noise, len(x))]), 6 / (count - 1)


def turn(seed):
    """A random rotation."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(("count", "each"), [(12, 30), (9, 60), (6, 150), (5, 240)])
def test_lines_equal_the_naive_twin(count, each):
    points = lines(count, each)[0] @ turn(count).T
    got = lift(points, np.full_like(points, 0.25))
    want_normals, want_scales = discs(points - _anchor(points))
    np.testing.assert_allclose(got.scales, want_scales, rtol=1e-5)
    np.testing.assert_allclose(np.abs((normals(got) * want_normals).sum(1)), 1, atol=1e-5)


@pytest.mark.parametrize("ratio", [3, 10, 34, 60])
@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_discs_of_scan_lines_lie_along_the_surface(ratio, noise):
    """Their width is that of the distance of lines. Noise is a share of the spacing within lines."""
    points, gap = lines(24, 23 * ratio + 1, noise * 6 / (23 * ratio))
    rotation = turn(ratio)
    got = lift(points @ rotation.T, np.full_like(points, 0.5))
    off = np.degrees(np.arccos(np.clip(np.abs(normals(got) @ rotation[:, 2]), 0, 1)))
    assert np.percentile(off, 95) < 12
    assert 0.25 < np.median(got.scales[:, 0]) / gap < 0.6
    assert np.percentile(got.scales[:, 0], 99) < 0.8 * gap


@pytest.mark.parametrize("copies", [2, 3, 11, 12, 40])
@pytest.mark.parametrize("shuffled", [False, True])
def test_copies_of_points_give_the_discs_of_points(copies, shuffled):
    """Copies are merged in the order of the first ones, and their colours averaged."""
    points, rng = surface(300), np.random.default_rng(1)
    colors = rng.random((copies, 300, 3))
    once = lift(points, colors.mean(0))
    every, tints = np.tile(points, (copies, 1)), colors.reshape(-1, 3)
    order = np.arange(300)
    if shuffled:
        at = rng.permutation(len(every))
        every, tints = every[at], tints[at]
        order = np.array(list(dict.fromkeys(at % 300)))
    got = lift(every, tints)
    np.testing.assert_array_equal(got.means, once.means[order])
    np.testing.assert_array_equal(got.scales, once.scales[order])
    np.testing.assert_allclose(got.sh0, once.sh0[order], atol=1e-5)


def test_threads_do_not_matter_in_lines():
    points = lines(24, 500)[0]
    found = on_threads(lambda: lift(points, np.full_like(points, 0.5)).fingerprint())
    assert len(set(found)) == 1


def test_non_finite_points_are_left_out():
    points = surface(50)
    points[7, 1] = np.nan
    assert len(lift(points, np.full_like(points, 0.5))) == 49


@pytest.mark.parametrize(
    ("points", "colors", "options", "message"),
    [
        (np.zeros((3, 2)), np.zeros((3, 2)), {}, "points: expected shape"),
        (np.zeros((3, 3)), np.zeros((2, 3)), {}, "colors: expected shape"),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), {}, "none of the 3 points is finite"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"opacity": 1.0}, "opacity: expected"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"neighbors": 1}, "neighbors: expected a whole number"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"spread": 0.0}, "spread: expected"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"max_anisotropy": 0.5}, "max_anisotropy: expected"),
    ],
)
def test_bad_input_is_named(points, colors, options, message):
    with pytest.raises(InputError, match=message):
        lift(points, colors, **options)


def test_command_line(tmp_path, command_line):
    from g2ard.io import read_splats, write_points
    from g2ard.io.types import Points

    points = surface(300) + np.array([500_000.0, 4_000_000.0, 0.0])
    write_points(tmp_path / "cloud.ply", Points(points, np.full((300, 3), 0.5, np.float32)))
    out = succeeds(command_line, tmp_path, "lift", "cloud.ply", "-o", "prior.ply", "--json", "-").out
    assert json.loads(out)["output_count"] == 300
    prior = read_splats(tmp_path / "prior.ply")
    np.testing.assert_allclose(prior.means + prior.offset, points, atol=0.01)
    status, _, err = command_line("lift", "absent.ply", "-o", "other.ply", cwd=tmp_path)
    assert (status, len(err.splitlines())) == (1, 1)
    assert "absent.ply" in err


def test_near_coordinates_get_no_offset():
    points = np.random.default_rng(3).uniform(-100, 100, (500, 3))
    near = lift(points, np.full((500, 3), 0.5))
    np.testing.assert_array_equal(near.offset, 0)
    np.testing.assert_array_equal(near.means, points.astype(np.float32))
