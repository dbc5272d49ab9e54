"""Simplification: properties of every method, and the command."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from g2ard.config.choices import Method
from g2ard.errors import InputError
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import SimplifyConfig, round_counts, simplify
from helpers.scenes import assert_same_bits
from helpers.simplify_cases import Views, all_alike, assert_sound, scene
from helpers.threads import on_threads

METHODS = get_args(Method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("budget", [1, 2, 500, 1999, 2000])
def test_exact_count(method, budget):
    assert_sound(simplify(scene(), budget, method=method), 2000, budget)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_any_sh_degree(method, rest):
    assert simplify(scene(300, rest), 40, method=method).splats.shN.shape == (40, rest, 3)


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_matter(method):
    prior = scene(9_000)
    first, *others = on_threads(lambda: simplify(prior, 1000, method=method))
    for other in others:
        assert_same_bits(first.splats, other.splats)
        np.testing.assert_array_equal(first.parents, other.parents)


@pytest.mark.parametrize("method", METHODS)
def test_row_order_does_not_matter(method):
    prior = scene()
    rows = np.random.default_rng(1).permutation(len(prior))
    here, there = (
        simplify(prior, 300, method=method),
        simplify(prior.take(rows), 300, method=method),
    )
    assert_same_bits(here.splats, there.splats)
    np.testing.assert_array_equal(here.parents[rows], there.parents)
    np.testing.assert_array_equal(here.protected, there.protected)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("factor", "shift"), [(1.0, 2.0**20), (2.0**-7, 0.0), (2.0**9, -(2.0**15))]
)
def test_moving_and_scaling_by_powers_of_two_is_exact(method, factor, shift):
    prior = scene(dtype=np.float64)
    moved = replace(
        prior, means=prior.means * factor + shift, scales=prior.scales * np.float32(factor)
    )
    here, there = (simplify(s, 300, method=method) for s in (prior, moved))
    np.testing.assert_array_equal(there.splats.means, here.splats.means * factor + shift)
    np.testing.assert_array_equal(there.splats.scales, here.splats.scales * np.float32(factor))
    for name in ("quats", "logit_opacities", "sh0", "shN"):
        np.testing.assert_array_equal(
            getattr(there.splats, name), getattr(here.splats, name), err_msg=name
        )
    np.testing.assert_array_equal(there.parents, here.parents)


@pytest.mark.parametrize("method", METHODS)
def test_flags_are_inherited_by_or(method):
    prior = scene()
    flags = np.random.default_rng(2).random(len(prior)) < 0.2
    out = simplify(prior, 400, method=method, protected=flags)
    want = np.zeros(400, bool)
    alive = out.parents >= 0
    np.logical_or.at(want, out.parents[alive], flags[alive])
    np.testing.assert_array_equal(out.protected, want)


def odd_scenes():
    rng = np.random.default_rng(3)
    base = scene(500)
    one = np.zeros(1000, int)
    flat = replace(base, means=base.means * np.float32([1, 1, 0]))
    line = replace(base, means=base.means * np.float32([1, 0, 0]))
    far = base.means.copy()
    far[[3, 77, 400]] = 8 * 20_000 * np.float32([[1, 0, 0], [0, -1, 1], [1, 1, 1]])
    scales = base.scales.copy()
    scales[::7] = 3e-10
    huge = base.scales.astype(np.float64)
    huge[5] = np.exp(43)  # files' clamp of e^100
    logits = np.where(rng.random(500) < 0.5, 1e4, -1e4)
    points, dots, most = (base.scales.copy() for _ in range(3))
    points[:], dots[:], most[rng.random(500) < 0.6] = 0, np.exp(-30), np.exp(-30)
    endless = np.where(
        np.arange(500) % 3 == 0, np.inf, np.where(np.arange(500) % 3 == 1, -np.inf, 0.3)
    )
    return {
        "identical": base.take(one),
        "one": base.take([0]),
        "two": base.take([0, 1]),
        "coplanar": flat,
        "collinear": line,
        "floaters": replace(base, means=far),
        "tiny": replace(base, scales=scales),
        "huge": replace(base, scales=huge.astype(np.float32)),
        "too large to square": replace(base, scales=np.full((500, 3), 1e30, np.float32)),
        "points of size zero": replace(base, scales=points),
        "points": replace(base, scales=dots),
        "mostly points": replace(base, scales=most),
        "spread out": replace(base, means=1e11 * base.means),
        "as far as float32 goes": replace(base, means=np.float32(8e37) * base.means),
        "logits": replace(base, logit_opacities=logits.astype(np.float32)),
        "infinite": replace(base, logit_opacities=endless.astype(np.float32)),
        "transparent": replace(base, logit_opacities=np.full(500, -np.inf, np.float32)),
    }


def near_and_far(splats):
    """Visibility from views whose pixels have very different sizes."""
    rows = np.arange(len(splats))
    return Views(np.where(rows % 5, 1.0, 1e30), np.choose(rows % 4, [0.01, 1e-30, 1e30, np.inf]))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seen", [None, near_and_far], ids=["unseen", "seen"])
@pytest.mark.parametrize("name", odd_scenes())
def test_odd_scenes(method, seen, name):
    prior = odd_scenes()[name]
    for budget in {1, max(1, len(prior) // 10), len(prior)}:
        out = simplify(prior, budget, method=method, visibility=seen)
        assert_sound(out, len(prior), budget, least=0 if name == "points of size zero" else 1e-45)
        infinite = int(np.isinf(prior.logit_opacities).sum())
        assert out.report.infinite_logits == infinite


@pytest.mark.parametrize("method", ["default", "fast"])
def test_a_floater_swallows_nothing_that_shows(method):
    prior = scene(1000)
    far = prior.means.copy()
    far[7] = [160_000, 0, 0]
    out = simplify(replace(prior, means=far), 100, method=method)
    assert out.report.faded == 0
    assert (out.parents == out.parents[7]).sum() == 1


def test_floaters_that_fade_are_counted():
    prior = replace(scene(500), logit_opacities=np.full(500, 3, np.float32))
    assert simplify(prior, 50).report.faded == 0
    far = prior.means.copy()
    far[:40] += 160_000 * np.random.default_rng(5).normal(size=(40, 3)).astype(np.float32)
    out = simplify(replace(prior, means=far), 12)
    faint = out.splats.opacities < 1 / 255
    assert out.report.faded == np.count_nonzero(faint) > 0
    assert set(np.flatnonzero(faint)) == set(out.parents[:40][faint[out.parents[:40]]])


def test_the_papers_schedule_reports_skipped_steps():
    prior = scene(2000)
    out = simplify(prior, 1500, method="paper")
    assert out.report.skipped["coverages"] == sum(r.refused["energy"] for r in out.report.rounds)
    faint = replace(
        prior, logit_opacities=np.where(np.arange(2000) < 1500, 0, -9).astype(np.float32)
    )
    dropped = simplify(faint, 1500, method="paper").report.skipped
    assert (dropped["binnings"], dropped["trims"]) == (1, 1)
    assert "binnings" not in simplify(prior, 200).report.skipped


@pytest.mark.parametrize("method", METHODS)
def test_dropped_rows_are_reported_even_if_nothing_merges(method):
    faint = replace(
        scene(1000), logit_opacities=np.where(np.arange(1000) < 300, -9, 3).astype(np.float32)
    )
    out = simplify(faint, 700, method=method)
    assert (out.parents == -1).tolist() == [True] * 300 + [False] * 700
    rounds = out.report.rounds
    assert (rounds[0].before, rounds[-1].after) == (1000, 700)
    assert (sum(r.dropped for r in rounds), sum(r.merged for r in rounds)) == (300, 0)


@pytest.mark.parametrize("method", METHODS)
def test_identical_gaussians_keep_their_shape(method):
    prior = scene(500).take(np.zeros(1000, int))
    out = simplify(prior, 1, method=method, config=SimplifyConfig(max_growth=1)).splats
    np.testing.assert_array_equal(out.means, prior.means[:1])
    np.testing.assert_allclose(np.sort(out.scales[0]), np.sort(prior.scales[0]), rtol=1e-5)
    np.testing.assert_allclose(out.sh0, prior.sh0[:1], rtol=1e-6)
    grown = simplify(prior, 1, method=method).splats  # α = 0.99 cannot hold the mass of a thousand
    factors = np.sort(grown.scales[0]) / np.sort(prior.scales[0])
    growth = 1.0 if method == "paper" else (3 / 0.99) ** 0.5
    np.testing.assert_allclose(factors, [1, growth, growth], rtol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_non_finite_rows_are_dropped_and_counted(method):
    prior = scene(400)
    prior.means[5, 0], prior.scales[9, 1], prior.shN[30, 1, 2] = np.nan, np.inf, np.nan
    out = simplify(prior, 100, method=method)
    assert_sound(out, 400, 100)
    assert out.report.nonfinite_rows == 3
    assert (out.parents[[5, 9, 30]] == -1).all()


def test_bad_input_is_named():
    prior = scene(50)
    for budget, message in ((0, "at least 1, got 0"), (51, "expected at most 50 ")):
        with pytest.raises(InputError, match=message):
            simplify(prior, budget)
    with pytest.raises(InputError, match="method: expected one of"):
        simplify(prior, 5, method="best")
    with pytest.raises(InputError, match=r"protected: expected bool of shape \(50,\)"):
        simplify(prior, 5, protected=np.zeros(49, bool))
    with pytest.raises(InputError, match="none of the 50 rows is finite"):
        simplify(replace(prior, means=prior.means * np.nan), 5)
    for wrong in (
        {"retention": 1.0},
        {"morton_premerge_ratio": np.nan},
        {"morton_premerge_steps": 0},
    ):
        with pytest.raises(InputError, match=next(iter(wrong))):
            SimplifyConfig(**wrong)


def test_schedule():
    rounds = round_counts(500_000, 50_000)
    assert len(rounds) == 8
    assert rounds[-1] == 50_000
    for before, after in zip([500_000, *rounds], rounds, strict=False):
        assert after < before
    assert round_counts(100, 1, 0.999)[-1] == 1


@pytest.mark.parametrize("method", METHODS)
def test_the_report_adds_up(method):
    prior = scene(5000)
    out = simplify(prior, 600, method=method, visibility=None if method == "paper" else all_alike)
    rounds = out.report.rounds
    for r, before in zip(rounds, [5000, *(r.after for r in rounds)], strict=False):
        assert r.before == before
        assert r.after == r.before - r.dropped - r.merged - r.trimmed
    assert rounds[-1].after == 600
    members = [np.count_nonzero(out.parents == p) for p in range(600)]
    assert out.report.merged_members == sum(m for m in members if m > 1)
    assert out.report.skipped["alone"] == members.count(1)
    assert sum(r.merged for r in rounds) >= out.report.merged_members - sum(m > 1 for m in members)


@pytest.mark.parametrize("logit", [-16, -1e4, -np.inf])
@pytest.mark.parametrize("method", METHODS)
def test_an_invisible_scene_shrinks_evenly(method, logit):
    rng = np.random.default_rng(6)
    prior = Splats.create(
        rng.uniform(-1, 1, (2000, 3)),
        scales=np.full((2000, 3), 0.05),
        logit_opacities=np.full(2000, logit),
    )
    out = simplify(prior, 1000, method=method)
    assert_sound(out, 2000, 1000)
    octants = np.bincount((out.splats.means > 0) @ [1, 2, 4], minlength=8)
    assert octants.min() > 80  # of 125
