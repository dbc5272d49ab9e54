"""The lift against its float64 twin, and on the clouds that break lifts."""

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.scene.splats import SH_C0
from g2ard.stages.lift import _choose_anchor, isolated, lift
from helpers.clouds import lines, surface
from helpers.threads import on_threads
from reference.lift import discs


def test_spread_is_an_option():
    points = surface(100)
    got = lift(points, np.full_like(points, 0.25), spread=0.6)
    np.testing.assert_allclose(0.5 + SH_C0 * got.sh0[:, 0], 0.25, atol=1e-6)
    np.testing.assert_allclose(got.opacities, 0.5, atol=1e-6)
    assert got.sh_degree == 0
    _, want_scales = discs(points - _choose_anchor(points), spread=0.6)
    np.testing.assert_allclose(got.scales, want_scales, rtol=1e-5)


@pytest.mark.parametrize(("count", "told"), [(6, False), (60, True)])
def test_flocks_far_from_a_surface_are_told(count: int, told: bool) -> None:
    rng = np.random.default_rng(1)
    plain = np.column_stack([rng.uniform(0, 50, (3000, 2)), rng.normal(0, 0.05, 3000)])
    flock = np.array([20, 20, 500]) + rng.normal(0, 40, (count, 3))
    points = np.concatenate([plain, flock])
    text = isolated(lift(points, np.full_like(points, 0.5)))
    assert (text is not None and "isolated points" in text) == told


def test_translation_and_scale_by_powers_of_two_are_exact():
    points = np.round(surface() * 2**20) / 2**20
    colors = np.full_like(points, 0.5)
    here, far = lift(points, colors), lift(points * 4 + 2**22, colors)
    assert far.offset.any()  # float32 cannot hold such coordinates
    np.testing.assert_allclose(far.means + far.offset, points * 4 + 2**22, rtol=0, atol=1e-5)
    for there in (far, lift(points * 4 + 1024, colors)):
        np.testing.assert_array_equal(there.scales, here.scales * 4)
        np.testing.assert_array_equal(there.quats, here.quats)


@pytest.mark.parametrize("points", [surface(20_000), lines(24, 500)[0]], ids=["surface", "lines"])
def test_threads_do_not_matter(points):
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
        (
            np.zeros((3, 3)),
            np.zeros((3, 3)),
            {"neighbors": 1},
            "neighbors: expected a whole number",
        ),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"spread": 0.0}, "spread: expected"),
        (np.zeros((3, 3)), np.zeros((3, 3)), {"max_anisotropy": 0.5}, "max_anisotropy: expected"),
    ],
)
def test_bad_input_is_named(points, colors, options, message):
    with pytest.raises(InputError, match=message):
        lift(points, colors, **options)


def test_near_coordinates_get_no_offset():
    points = np.random.default_rng(3).uniform(-100, 100, (500, 3))
    near = lift(points, np.full((500, 3), 0.5))
    np.testing.assert_array_equal(near.offset, 0)
    np.testing.assert_array_equal(near.means, points.astype(np.float32))


@pytest.mark.parametrize("count", [1, 14, 35])
@pytest.mark.parametrize("seed", [0, 1])
def test_strays_do_not_become_large(count: int, seed: int) -> None:
    """Far points take a size near that of the surface; those of the surface keep theirs, at any density."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-40, 40, (8000, 2)), rng.normal(0, 0.05, 8000)])
    ground[:, :2] *= 0.3 + 0.7 * np.abs(ground[:, :2]) / 40  # ten times denser in the middle
    strays = np.column_stack([rng.uniform(-40, 40, (count, 2)), rng.uniform(80, 400, count)])
    alone = lift(ground, np.full(ground.shape, 0.5)).scales
    found = lift(np.concatenate([ground, strays]), np.full((8000 + count, 3), 0.5)).scales
    same = (found[:8000] == alone).all(1)
    assert same.mean() > 0.98
    edge = np.quantile(alone.max(1), 0.999)
    assert found[8000:].max() < 5 * edge  # 20 to 70 without a limit
