"""Views that complete others: greedy choice against its twin, what is chosen, and when it ends."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.select.light import complete
from helpers.threads import on_threads
from reference import select as naive


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 40), st.integers(0, 9))
def test_greedy_equals_trying_all(seed: int, views: int, rows: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    received = rng.exponential(size=(views, rows)).astype(np.float32) * (
        rng.random((views, rows)) < 0.5
    )
    before = rng.exponential(size=rows) * 3
    chosen, gains = _core.select_light(received, before, k)
    expected, their_gains = naive.brightest(received, before, k)
    np.testing.assert_allclose(gains, their_gains, rtol=1e-12, atol=1e-15)
    if len(np.unique(np.round(their_gains, 9))) == len(their_gains):  # no ties
        assert chosen.tolist() == expected


def test_any_number_of_threads_gives_the_same_bits() -> None:
    rng = np.random.default_rng(0)
    received, before = rng.random((40, 30_000), np.float32), rng.random(30_000)
    first, *others = on_threads(lambda: _core.select_light(received, before, 20))
    for other in others:
        for a, b in zip(first, other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_invalid_light_is_refused(value: float) -> None:
    light, before = np.ones((2, 3), np.float32), np.ones(3)
    light[1, 2] = value
    with pytest.raises(InputError, match="received"):
        _core.select_light(light, before, 1)
    with pytest.raises(InputError, match="received"):
        _core.select_light(np.ones((2, 3), np.float32), np.array([1, value, 1]), 1)


def row_of_balls(count: int = 6) -> Splats:
    """Clusters of small Gaussians, 10 apart along x."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(count * 50, 3)) * 0.5 + np.repeat(np.arange(count) * 10.0, 50)[
        :, None
    ] * (
        1,
        0,
        0,
    )
    return Splats.create(
        means, scales=np.full((len(means), 3), 0.05), logit_opacities=np.full(len(means), 3.0)
    )


def before_ball(x: float, distance: float = 4.0) -> Camera:
    return Camera.facing(
        [x, -distance, 0], [x, 0, 0], width=160, height=120, name=f"view_{x:g}_{distance:g}"
    )


def test_views_of_what_is_unseen_come_first_and_what_is_known_is_not_added() -> None:
    scene = row_of_balls()
    seen = Cameras.of([before_ball(x) for x in (0, 10, 20, 30)])
    offered = Cameras.of([before_ball(x, 4.1) for x in (0, 40, 10, 50, 20)])
    order, gains, unseen = complete(scene, seen, offered, 5)
    assert sorted(order[:2].tolist()) == [1, 3]
    assert len(order) < 5
    assert (np.diff(gains) <= 0).all()
    assert unseen < 0.05
    assert complete(scene, seen, offered, 1)[2] == pytest.approx(1 / 6, abs=0.05)
    assert len(complete(scene, seen, offered, 5, least_views=10_000)[0]) == 5


def test_nearer_views_of_small_gaussians_gain_more_than_far_ones() -> None:
    scene = row_of_balls(1)
    seen = Cameras.of([before_ball(0, 80)])
    offered = Cameras.of([before_ball(0, distance) for distance in (60, 5, 30)])
    assert complete(scene, seen, offered, 3)[0][0] == 1


def test_a_row_that_stands_for_several_gaussians_shares_its_light() -> None:
    scene, seen = row_of_balls(1), Cameras.of([before_ball(0, 30)])
    offered = Cameras.of([before_ball(0, 5)])
    one, many = (complete(scene, seen, offered, 1, represents=n, least_views=99) for n in (1, 100))
    assert many[2] >= one[2]
    assert many[1][0] != one[1][0]
