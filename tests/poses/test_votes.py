"""Places from which a scene was looked at, by the votes of its Gaussians, and pools under skies."""

from __future__ import annotations

import numpy as np
import pytest

from g2ard.poses import plan_pool
from g2ard.poses.matter import Matter
from g2ard.poses.votes import Votes
from g2ard.scene.reproducible import canonical_order
from g2ard.scene.splats import Splats
from helpers.skies import courtyard, under_sky
from reference import poses as naive

BALL = naive.discs(way := np.random.default_rng(3).normal(size=(6000, 3)), way, 0.01)


def voted(splats: Splats) -> Votes:
    order = canonical_order(splats, np.arange(len(splats)))
    scales = np.sort(splats.scales[order].astype(np.float64), axis=1)
    sizes = np.sqrt(scales[:, 1] * scales[:, 2])
    return Votes.of(
        splats.means[order].astype(np.float64), sizes, splats.opacities[order].astype(np.float64)
    )


def test_votes_are_the_share_of_rows_above_a_pixel() -> None:
    votes = voted(BALL)
    places = np.random.default_rng(0).normal(size=(5, 3)) * 6
    for place, found in zip(places, votes.at(places), strict=True):
        shares = [
            weight
            for point, reach, weight in zip(votes.points, votes.reach, votes.weights, strict=True)
            if np.linalg.norm(point - place) <= reach
        ]
        assert found == pytest.approx(sum(shares), abs=1e-12)


SHARES = [0.05, 0.1, 0.3, 0.33, 0.35, 0.6, 0.8]
DISTANCES = [4, 5, 60, 500, 1e4]
SKIES = [
    # whole spheres and their upper halves in turn
    (share, distance, -1.0 if (row + column) % 2 else 0.0)
    for row, share in enumerate(SHARES)
    for column, distance in enumerate(DISTANCES)
]


@pytest.mark.parametrize(("share", "distance", "lowest"), SKIES)
def test_no_share_of_sky_moves_what_is_near(share: float, distance: float, lowest: float) -> None:
    scene = courtyard(0.1)
    whole = under_sky(scene, share, distance, lowest)
    radius = voted(whole).radius
    assert np.isfinite(radius)
    matter = Matter.of(whole)
    kept = matter.origin + matter.size * matter.points
    assert 0.98 * len(scene) < len(kept) <= len(scene)
    assert np.abs(kept).max() < 6
    assert matter.beyond_share == pytest.approx(share, abs=0.03)


def test_far_matter_that_is_fine_is_no_sky() -> None:
    there = naive.moved(BALL, shift=(60.0, 0.0, 0.0))
    assert voted(naive.joined(BALL, there)).radius == np.inf
    few = there.take(range(100))
    assert voted(naive.joined(BALL, few)).radius < 10


def test_one_place_is_one_hypothesis() -> None:
    for splats in (BALL, courtyard(0.2), BALL.take(range(3)), BALL.take([0])):
        assert voted(splats).radius == np.inf


@pytest.mark.parametrize("share", [0.1, 0.32, 0.34, 0.6])
def test_pools_stand_in_the_yard_and_some_poses_show_the_sky(share: float) -> None:
    scene = courtyard()
    whole = under_sky(scene, share, 500.0, -0.1)
    pool = plan_pool(whole, 64)
    eyes = pool.cameras.positions
    assert np.abs(eyes).max() < 40
    assert (eyes[:, 2] > 0).all()
    sky = whole.means[np.linalg.norm(whole.means, axis=1) > 100]
    framed = np.any([view.holds(sky.astype(np.float64)) for view in pool.cameras], axis=0)
    assert share * (1 - framed.mean()) < 0.15
    own = np.array([view.holds(scene.means.astype(np.float64)).mean() for view in pool.cameras])
    assert (own > 0.1).mean() > 0.8
