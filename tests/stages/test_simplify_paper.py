"""The paper's method: merging, trimming, dropping and flags against their float64 twins."""

import numpy as np
import pytest

from g2ard.scene.splats import ARRAYS, Splats
from g2ard.scene.transform import join
from g2ard.stages.simplify import SimplifyConfig, round_counts, simplify
from helpers.simplify_cases import assert_kept, assert_sound, flag, scene
from reference import simplify as naive


def one_round(prior, budget, flags=None, **options):
    config = SimplifyConfig("paper", retention=1e-9, **options)
    return simplify(prior, budget, method="paper", protected=flags, config=config)


def test_paper_goes_by_the_schedule():
    out = simplify(scene(5000), 600, method="paper")
    assert [r.after for r in out.report.rounds] == round_counts(5000, 600)


def test_paper_merges_as_the_naive_twin_and_conserves_moments():
    prior = scene(3000, dtype=np.float64)
    flags = flag(prior, 1000)
    out = one_round(prior, 1000, flags, max_energy=10, min_coverage=0)
    small = out.splats
    groups = {p: np.flatnonzero(out.parents == p) for p in np.unique(out.parents) if p >= 0}
    assert sum(len(rows) > 1 for rows in groups.values()) > 100
    for p, rows in groups.items():
        if len(rows) == 1:
            assert_kept(prior, rows[0], small, p)
            continue
        mean, cov, alpha, sh, _ = naive.merge(prior, rows)
        np.testing.assert_allclose(small.means[p], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            naive.covariance(small, p), cov, rtol=0, atol=1e-6 * np.trace(cov)
        )
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
            config = SimplifyConfig("paper", flag_threshold=factor * energy)
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
            out = one_round(
                prior, 1, np.zeros(n, bool), min_opacity=0, max_energy=10, min_coverage=least
            )
            assert out.report.rounds[0].refused == {"energy": 0, "coverage": refused}, n
    assert partly > 3


def discs(points, colors=0.4, width=0.6, thickness=0.02, **options):
    """Discs that lie flat on z, of these colours (0–1)."""
    n = len(points)
    color = np.broadcast_to(np.asarray(colors, np.float64), (n, 3))
    scales = np.tile([width, width, thickness], (n, 1))
    return Splats.create(points, scales=scales, sh0=(color[:, None] - 0.5) / naive.C0, **options)


def sheet(side, height=0.0):
    """(side², 3) points a unit apart."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x.ravel(), y.ravel(), np.full(side**2, height)], 1).astype(np.float64)


def one_group(points, colors, **options):
    """Reduce to one cell in one round; return the round's report."""
    return one_round(discs(points, colors), 1, **options).report.rounds[0]


def shed(result, how):
    return sum(getattr(r, how) for r in result.report.rounds)


# "Locality cells: adaptive voxels, |C| ≈ N_S … one cell per retained primitive" (tab:s_config).


def test_one_cell_for_each_retained_primitive_in_every_round():
    rounds = simplify(discs(sheet(60)), 360, method="paper").report.rounds
    assert len(rounds) == 8
    for r in rounds:
        assert abs(r.cells - 360) <= 0.03 * 360, r


def test_a_round_on_the_way_has_the_cells_of_the_final_budget():
    prior = discs(sheet(60))
    config = SimplifyConfig("paper", retention=1e-9)
    out = simplify(prior, 2700, method="paper", final_budget=360, config=config)
    assert abs(out.report.rounds[0].cells - 360) <= 0.03 * 360


# "Third, if the count still exceeds the round budget, primitives are ranked": merging comes first, and ends
# there.


def test_flat_smooth_discs_reach_the_budget_by_merging():
    points = sheet(60)
    smooth = np.stack(
        [0.3 + 0.002 * points[:, 0], 0.3 + 0.002 * points[:, 1], 0 * points[:, 0] + 0.4], 1
    )
    out = simplify(discs(points, smooth), 360, method="paper")
    assert shed(out, "merged") >= 0.98 * (3600 - 360)
    assert [r.after for r in out.report.rounds][-1] == 360


def test_merging_ends_at_the_round_budget():
    first = simplify(discs(sheet(60)), 360, method="paper").report.rounds[0]
    assert first.after == 2700
    assert first.trimmed <= 8  # a group that is taken back returns all of its members
    assert first.undone_groups > 100


# "A surface-coverage guard prevents merging across incompatible geometric support" (section 3.2), ">= 0.6 of
# member footprint area" (tab:s_config).


@pytest.mark.parametrize("gap", [0.13, 0.2, 0.5, 1.0, 2.0, 3.0])
def test_two_parallel_sheets_do_not_merge(gap):
    for side in (1, 2, 4):
        pair = np.concatenate([sheet(side), sheet(side, gap)])
        assert one_group(pair, 0.4).refused == {"energy": 0, "coverage": 1}, side
    prior = discs(np.concatenate([sheet(30), sheet(30, gap)]))
    of = one_round(prior, 180).parents
    both = np.intersect1d(of[:900][of[:900] >= 0], of[900:][of[900:] >= 0])
    assert both.size == 0


def test_one_sheet_twice_as_dense_does():
    prior = discs(np.concatenate([sheet(30), sheet(30, 0.01)]))
    out = simplify(prior, 180, method="paper")
    assert shed(out, "merged") >= 0.95 * (1800 - 180)


def test_a_wall_does_not_merge_with_a_floor_it_stands_on():
    floor = sheet(4)
    wall = discs(sheet(4)[:, [0, 2, 1]] + [0, 1.5, 0.5], width=0.6)
    wall.quats[:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]  # about x: the normal along y
    report = one_round(join([discs(floor), wall]), 1).report.rounds[0]
    assert report.refused["coverage"] == 1


# "E_j = (1/|C_j|) Σ ‖c_i − ĉ_i‖²" (eq. frequency): in-sample.


@pytest.mark.parametrize(("count", "least"), [(2, 1.0), (3, 1.0), (4, 1.0), (10, 0.5)])
def test_groups_of_one_color_bin_pass_the_energy(count, least):
    rng = np.random.default_rng(count)
    passed = 0
    for _ in range(100):
        points = np.c_[rng.uniform(0, 2, (count, 2)), rng.uniform(0, 0.04, count)]
        report = one_group(points, rng.uniform(0.25, 0.5, (count, 3)), min_coverage=0)
        passed += report.merged == count - 1
    assert passed >= 100 * least


def test_a_colour_ramp_is_not_texture():
    points = sheet(4)
    ramp = 0.26 + 0.05 * points[:, :1]
    assert one_group(points, ramp).merged == 15
    assert not flag(discs(points, ramp), 1).any()


# "Cell × color bin, bin size 0.25": of colours, which end at 0 and 1.


def test_colors_beyond_white_are_white():
    points = sheet(4)
    bright = np.linspace(0.8, 3, 16)[:, None]
    assert one_group(points, bright).merged == 15
    assert not flag(discs(points, 1 + bright), 1).any()
    assert one_group(points, -bright).merged == 15


def test_bins_part_a_cell():
    points = sheet(4)
    halves = np.where(points[:, :1] < 2, 0.2, 0.3)
    out = one_round(discs(points, halves), 2)
    for rows in (points[:, 0] < 2, points[:, 0] >= 2):
        assert np.unique(out.parents[rows]).size == 1


# "When any guard fails, the originals are retained"; "p_i is inherited … (logical OR)".


def test_refused_groups_keep_their_originals():
    prior = discs(sheet(20), np.random.default_rng(0).uniform(0, 1, (400, 3)))
    out = one_round(prior, 40, min_coverage=2)
    kept = np.flatnonzero(out.parents >= 0)
    assert shed(out, "merged") == 0
    for name in ARRAYS:
        np.testing.assert_array_equal(
            getattr(out.splats, name)[out.parents[kept]], getattr(prior, name)[kept]
        )


# The table's constants (tab:s_config), each from both sides. E_j sums over channels: a checker of ±d: 3·d².


@pytest.mark.parametrize(("other", "passes"), [(0.372, True), (0.378, False), (0.40, False)])
def test_energy_and_flags_part_at_a_hundredth_summed_over_channels(other, passes):
    points = sheet(4)
    checks = np.where((points[:, 0] + points[:, 1]) % 2 == 0, 0.26, other)[:, None]
    found = one_group(points, checks)
    assert found.refused == {"energy": 0 if passes else 1, "coverage": 0}
    assert found.merged == (15 if passes else 0)
    assert flag(discs(points, checks), 1).any() != passes


@pytest.mark.parametrize(("flat", "passes"), [(61, True), (59, False)])
def test_coverage_parts_at_six_tenths_of_the_footprint_area(flat, passes):
    points = sheet(10)
    # edge-on: no footprint on the floor
    upright = np.random.default_rng(3).permutation(100) >= flat
    prior = discs(points, width=0.1, thickness=0.002)
    prior.quats[upright] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    out = one_round(prior, 1)
    assert out.report.rounds[0].refused == {"energy": 0, "coverage": 0 if passes else 1}


def thinned(areas, alphas, budget, flags=None):
    """Return which of some distant discs, with given areas and opacities, a trim to `budget` keeps."""
    areas, alphas = np.asarray(areas, np.float64), np.asarray(alphas, np.float64)
    points = sheet(20)[: len(areas)] * 5
    # not square: A is the product of the two largest scales
    scales = np.stack([np.sqrt(areas) * 1.5, np.sqrt(areas) / 1.5, np.full(len(areas), 1e-3)], 1)
    prior = Splats.create(points, scales=scales, logit_opacities=np.log(alphas / (1 - alphas)))
    flags = np.zeros(len(areas), bool) if flags is None else flags
    # nothing merges, so trims decide
    return one_round(prior, budget, flags, min_coverage=2).parents >= 0


@pytest.mark.parametrize("by", ["area", "opacity"])
def test_protection_multiplies_priority_by_eleven_and_exempts_nothing(by):
    """(1 + λ_h p), λ_h = 10; "softly boosts optical mass … rather than granting a hard exemption"."""
    times = np.repeat([1.0, 10.5, 11.5], 20)
    flags = times == 1
    base = 0.02
    areas = base * times if by == "area" else np.full(60, 0.2)
    alphas = np.full(60, 0.5) if by == "area" else 1 - np.exp(-0.1 * times)
    np.testing.assert_array_equal(thinned(areas, alphas, 20, flags), times == 11.5)
    np.testing.assert_array_equal(thinned(areas, alphas, 40, flags), times != 10.5)
    np.testing.assert_array_equal(thinned(areas, alphas, 40), times != 1)


def test_opacity_below_a_hundredth_is_dropped_first():
    alphas = np.repeat([0.009, 0.011, 0.5], 40)
    areas = np.where(alphas == 0.5, 0.001, 1.0)
    areas[alphas == 0.009] = 4
    np.testing.assert_array_equal(thinned(areas, alphas, 40), alphas == 0.011)
    np.testing.assert_array_equal(thinned(areas, alphas, 80), alphas >= 0.011)
