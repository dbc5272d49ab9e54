"""The methods default and fast: clusters against their float64 twins, and visibility."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.rendering.renderer import render
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.stages.simplify.pairs import fit_opacities
from helpers.scenes import around, assert_same_bits, checkered_ball
from helpers.simplify_cases import Views, all_alike, assert_kept, assert_sound, opaque_wall, scene
from reference import simplify as naive


# fast cuts coarser
@pytest.mark.parametrize(("method", "least"), [("default", 0.6), ("fast", 0.55)])
def test_visible_gaussians_keep_more_detail(method, least):
    prior = scene(4000)
    left = prior.means[:, 0] < 0
    seen = Views(np.where(left, 100.0, 0.0), np.where(left, 0.01, np.inf))
    out = simplify(prior, 400, method=method, visibility=seen)
    assert_sound(out, 4000, 400)
    blind = simplify(prior, 400, method=method).splats
    share, unguided = (np.mean(s.means[:, 0] < 0) for s in (out.splats, blind))
    assert share > least
    assert share > 5 * unguided  # detail draws the blind one to the other half
    with pytest.raises(InputError, match=r"visibility.weight: expected shape \(4000,\)"):
        simplify(prior, 400, method=method, visibility=Views(np.ones(3), np.ones(4000)))


def test_visibility_is_measured_again_for_the_result():
    prior, asked = scene(4000), []

    def look(splats):
        asked.append(len(splats))
        return Views(np.ones(len(splats)), np.full(len(splats), 0.01))

    out = simplify(prior, 100, visibility=look, protected=np.ones(4000, bool))
    assert_sound(out, 4000, 100)
    assert asked == [4000, 100]  # the last to fit what was merged
    assert out.protected.all()
    assert out.report.unseen == 0


def test_unseen_gaussians_are_counted():
    prior = scene(4000)
    unseen = prior.means[:, 0] < 0

    def look(splats):
        return Views(np.where(splats.means[:, 0] < 0, 0.0, 1.0), np.full(len(splats), 0.01))

    out = simplify(prior, 100, visibility=look)
    assert out.report.unseen == (unseen & (out.parents >= 0)).sum() > 0
    assert simplify(prior, 100).report.unseen is None


@pytest.mark.parametrize("growth", [1.0, 1.5])
@pytest.mark.parametrize("method", ["default", "fast"])
def test_clusters_conserve_mass_mean_and_covariance(method, growth):
    prior = scene(3000, dtype=np.float64)
    config = SimplifyConfig(max_growth=growth, surface_depth=np.inf)
    e2 = (0.4 * 0.01) ** 2
    seen = Views(np.ones(3000), np.full(3000, 0.01))
    out = simplify(prior, 1500, method=method, visibility=seen, config=config)
    small = out.splats
    for p in range(0, 1500, 7):
        rows = np.flatnonzero(out.parents == p)
        if len(rows) == 1:
            assert_kept(prior, rows[0], small, p)
            continue
        mean, cov, alpha, sh = naive.merge_as_rendered(prior, rows, e2, growth)
        # blur and α are float32
        np.testing.assert_allclose(small.means[p], mean, rtol=0, atol=1e-7)
        np.testing.assert_allclose(
            naive.covariance(small, p), cov, rtol=0, atol=1e-6 * np.trace(cov)
        )
        np.testing.assert_allclose(small.opacities[p], alpha, rtol=1e-4)
        np.testing.assert_allclose(np.r_[small.sh0[p], small.shN[p]], sh, rtol=0, atol=1e-5)


@pytest.mark.parametrize("method", ["default", "fast"])
def test_an_opaque_wall_stays_opaque_and_thin(method):
    wall, cameras = opaque_wall()
    alpha = {}
    for growth in (1.0, 1.5):
        out = simplify(wall, 80, method=method, config=SimplifyConfig(max_growth=growth)).splats
        alpha[growth] = render(out, cameras[0]).alpha[15:45, 20:60].mean()
        assert out.scales.min(axis=1).max() < 0.0025
    assert alpha[1.5] > alpha[1.0] + 0.05
    seen = simplify(wall, 80, method=method, visibility=visibility_source(cameras)).splats
    assert render(seen, cameras[0]).alpha[15:45, 20:60].mean() > alpha[1.5]


def test_opacities_are_fitted_and_all_else_is_the_members():
    prior = scene(4000, dtype=np.float64)
    config = SimplifyConfig(max_growth=1)
    out = simplify(prior, 100, visibility=all_alike, config=config)
    assert out.report.fitted > 50
    members = np.bincount(out.parents[out.parents >= 0], minlength=100)
    floor = 0.05 * members.mean()  # every row sends 1 to the views, before and after
    factor = np.clip((members + floor) / (1 + floor), 0.5, 2) ** 0.25
    for p in range(0, 100, 7):
        rows = np.flatnonzero(out.parents == p)
        if len(rows) > 1:
            mean, cov, alpha, sh = naive.merge_as_rendered(prior, rows, (0.4 * 0.01) ** 2, 1.0)
            wanted = alpha * factor[p]
            held = min(wanted, max(alpha, 0.99))
            np.testing.assert_allclose(out.splats.means[p], mean, rtol=0, atol=1e-7)
            np.testing.assert_allclose(out.splats.opacities[p], held, rtol=1e-4)
            np.testing.assert_allclose(
                np.r_[out.splats.sh0[p], out.splats.shN[p]], sh, rtol=0, atol=1e-5
            )
            areas = [
                np.sort(np.linalg.eigvalsh(c))[1:].prod() ** 0.5
                for c in (naive.covariance(out.splats, p), cov)
            ]
            np.testing.assert_allclose(areas[0] / areas[1], wanted / held, rtol=1e-3)


def test_no_merged_cluster_is_dropped():
    rng = np.random.default_rng(4)
    prior = Splats.create(
        rng.uniform(0, 100, (2000, 3)),
        scales=np.full((2000, 3), 0.01),
        logit_opacities=np.full(2000, 2),
    )
    out = simplify(prior, 200, visibility=all_alike)
    assert_sound(out, 2000, 200)
    assert (out.parents >= 0).all()


@pytest.mark.parametrize(("method", "count"), [("default", 90), ("default", 40), ("fast", 80)])
@pytest.mark.parametrize("scale", [1.0, 2.0**-10])
def test_visibility_does_not_depend_on_the_order_of_rows(method, count, scale):
    wall, cameras = opaque_wall()
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] *= scale
    cameras = replace(cameras, viewmats=viewmats)
    wall = replace(
        wall, means=wall.means * np.float32(scale), scales=wall.scales * np.float32(scale)
    )
    shuffled = np.random.default_rng(8).permutation(len(wall))
    a = simplify(wall, count, method=method, visibility=visibility_source(cameras))
    b = simplify(wall.take(shuffled), count, method=method, visibility=visibility_source(cameras))
    assert_same_bits(a.splats, b.splats)
    np.testing.assert_array_equal(a.parents[shuffled], b.parents)
    assert a.report.fitted > count / 2


def test_clusters_of_many_get_the_colours_that_views_show():
    """The members behind the front of a ball hardly count, though they have as much mass."""
    front = checkered_ball(4000).with_sh_degree(0)
    red, views = np.array([3.0, -1.0, -1.0], np.float32), around(12)
    behind = replace(
        front, means=front.means * np.float32(0.97), sh0=np.broadcast_to(red, (4000, 1, 3))
    )
    both = join([front, behind])

    def off(count):
        small = simplify(both, count, visibility=visibility_source(views)).splats
        return np.mean(
            [np.abs(render(small, v).image - render(both, v).image).mean() for v in views]
        )

    assert off(400) < 0.7 * off(401)


def test_bands_of_zeros_are_not_stored():
    prior = scene(600).with_sh_degree(1)
    padded = prior.with_sh_degree(3)
    a, b = simplify(prior, 60), simplify(padded, 60)
    np.testing.assert_array_equal(a.splats.shN, b.splats.shN[:, :3])
    assert b.splats.shN.shape == (60, 15, 3)
    assert not b.splats.shN[:, 3:].any()
    assert (a.report.skipped["sh_bands"], b.report.skipped["sh_bands"]) == (0, 2)
    assert b.report.skipped["alone"] == (np.bincount(b.parents[b.parents >= 0]) == 1).sum()


def test_the_constants_are_the_core_s() -> None:
    default, fast = (SimplifyConfig(method).resolved() for method in ("default", "fast"))
    assert (default.morton_premerge_ratio, default.morton_premerge_steps) == (3.0, 1)
    assert (fast.morton_premerge_ratio, fast.morton_premerge_steps) == (1.0, 2)
    core = _core.defaults()["default"]
    assert {name: getattr(default, name) for name in core} == core


def test_without_a_premerge_pairs_alone_merge() -> None:
    scene = checkered_ball(600)
    never = simplify(scene, 60, config=SimplifyConfig(morton_premerge_ratio=np.inf))
    always = simplify(scene, 60, config=SimplifyConfig(morton_premerge_ratio=1.0))
    assert len(always.report.rounds) == 1 < len(never.report.rounds)
    assert all(r.merged <= r.before // 2 for r in never.report.rounds)  # a pair becomes one


def test_a_scene_is_put_in_order_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def counted(splats: Splats) -> Any:
        made.append(len(splats))
        return core_scene(splats)

    core_scene = _core.Scene
    monkeypatch.setattr(_core, "Scene", counted)
    simplify(checkered_ball(600), 60, visibility=visibility_source(around(4)))
    assert made == [600, 60]  # the input, then the result whose opacities are fitted


def _fitted(alphas: list[float], members: int, wanted: float, now: float) -> tuple[Splats, Splats]:
    """Return Gaussians with one short axis, before and after a fit of their opacities."""
    alpha, count = np.array(alphas), len(alphas)
    before = Splats.create(
        np.eye(3)[:count],
        scales=np.tile([0.2, 0.1, 0.3], (count, 1)),
        logit_opacities=np.log(alpha / (1 - alpha)),
    )
    rows = np.ones(count)
    return before, fit_opacities(before, members * rows, wanted * rows, now * rows, 1.0)


def test_fits_keep_gaussians_of_one_row() -> None:
    before, after = _fitted([0.3, 0.6], 1, 2.0, 1.0)
    assert_same_bits(before, after)
    before, after = _fitted([0.3, 0.6], 2, 2.0, 1.0)
    assert (after.opacities > 1.1 * before.opacities).all()


def test_fits_let_no_gaussian_vanish() -> None:
    """Below 1/255 renderers draw nothing: a row just above stays, one well above is fitted."""
    before, after = _fitted([1.01 / 255, 0.5], 3, 0.2, 1.0)
    assert after.logit_opacities[0] == before.logit_opacities[0]
    assert after.opacities[1] < 0.9 * before.opacities[1]


def test_what_opacity_cannot_hold_widens_the_longer_axes() -> None:
    before, after = _fitted([0.98], 3, 16.0, 1.0)
    growth = 0.98 * 2**0.25 / 0.99  # the ratio of visibility is limited to 2
    np.testing.assert_allclose(after.opacities, 0.99, rtol=1e-5)
    np.testing.assert_allclose(
        after.scales / before.scales, [[growth**0.5, 1, growth**0.5]], rtol=1e-5
    )
