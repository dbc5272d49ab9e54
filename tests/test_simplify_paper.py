"""The paper's policy: merging, trimming, dropping and flags against their float64 twins."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from simplify_cases import ARRAYS, assert_sound, scene

from g2ard.scene.splats import Splats, unit_quats
from g2ard.stages.simplify import SimplifyConfig, flag, schedule, simplify

sys.path.insert(0, str(Path(__file__).parent))
from reference import simplify as naive


def one_round(prior, budget, flags, **options):
    config = SimplifyConfig(retention=1e-9, **options)
    return simplify(prior, budget, method="paper", protected=flags, config=config)


def test_paper_goes_by_the_schedule():
    out = simplify(scene(5000), 600, method="paper")
    assert [r.after for r in out.report.rounds] == schedule(5000, 600)


def test_paper_merges_as_the_naive_twin_and_conserves_moments():
    prior = scene(3000, dtype=np.float64)
    flags = flag(prior, 1000)
    out = one_round(prior, 1000, flags, max_energy=10, min_coverage=0)
    small = out.splats
    groups = {p: np.flatnonzero(out.parents == p) for p in np.unique(out.parents) if p >= 0}
    assert sum(len(rows) > 1 for rows in groups.values()) > 100
    for p, rows in groups.items():
        if len(rows) == 1:
            for name in ARRAYS:
                before = getattr(prior, name)[rows[0]]
                before = before if name != "quats" else unit_quats(before[None])[0]
                np.testing.assert_array_equal(getattr(small, name)[p], before)
            continue
        mean, cov, alpha, sh, _ = naive.merge(prior, rows)
        np.testing.assert_allclose(small.means[p], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(naive.covariance(small, p), cov, rtol=0, atol=1e-6 * np.trace(cov))
        np.testing.assert_allclose(small.opacities[p], alpha, rtol=1e-5)
        np.testing.assert_allclose(np.r_[small.sh0[p], small.shN[p]], sh, rtol=0, atol=1e-5)


def test_paper_trims_by_priority():
    prior = scene(1000)
    flags = np.random.default_rng(4).random(1000) < 0.3
    # Nothing may merge: all is trimming.
    out = one_round(prior, 200, flags, max_energy=0, min_coverage=2, min_opacity=0)
    score = naive.priority(prior, flags)
    want = np.zeros(1000, bool)
    want[np.argsort(-score)[:200]] = True
    np.testing.assert_array_equal(out.parents >= 0, want)


def test_paper_drops_the_transparent_but_never_below_the_budget():
    prior = scene(1000)
    prior.logit_opacities[::5] = -6
    visible = int((prior.opacities >= 0.01).sum())
    out = one_round(prior, visible - 50, np.zeros(1000, bool))
    assert out.report.rounds[0].dropped == 1000 - visible
    assert_sound(one_round(prior, visible + 10, np.zeros(1000, bool)), 1000, visible + 10)


def test_flags_find_texture_and_borrow_in_sparse_cells():
    prior = scene(4000)
    flags = flag(prior, 400)
    noisy = prior.means[:, 0] > 0
    assert flags[noisy].mean() > 0.95
    assert flags[prior.means[:, 0] < -0.5].mean() < 0.05
    few = flag(prior, 1500)  # two or three members a cell: all borrow
    assert few[noisy].mean() > 0.9


def test_flag_residual_equals_the_naive_twin():
    rng = np.random.default_rng(5)
    for n in (5, 8, 9, 30):
        points, colors = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) * 0.2
        prior = Splats.create(points, scales=np.ones((n, 3)), sh0=colors[:, None] / naive.C0)
        energy = naive.affine_energy(prior.means.astype(np.float64), naive.color(prior), n)
        for factor, want in ((0.98, True), (1.02, False)):
            config = SimplifyConfig(flag_threshold=factor * energy)
            assert flag(prior, 1, config=config).all() == want, n


def test_coverage_equals_the_naive_twin():
    rng = np.random.default_rng(6)
    partly = 0
    for n in (2, 3, 5, 9, 17, 30):
        prior = Splats.create(
            rng.normal(size=(n, 3)) * [1, 1, 0.1],
            quats=rng.normal(size=(n, 4)) * [3, 1, 1, 1],
            scales=np.exp(rng.normal(-2, 0.7, (n, 3))) * [1, 1, 0.3],
            logit_opacities=rng.normal(size=n),
        )
        covered = naive.coverage(prior, np.arange(n))
        partly += 0.1 < covered < 0.9
        for margin, refused in ((-0.06, 0), (0.06, 1)):
            least = max(0, covered + margin)
            out = one_round(prior, 1, np.zeros(n, bool), min_opacity=0, max_energy=10, min_coverage=least)
            assert out.report.rounds[0].refused == {"energy": 0, "coverage": refused}, n
    assert partly > 3
