"""Simplification: its parts against their float64 twins, and what must hold whatever the policy."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard import _core
from g2ard.errors import InputError
from g2ard.simplify import METHODS, SimplifyConfig, flag, schedule, simplify
from g2ard.splats import Splats

sys.path.insert(0, str(Path(__file__).parent))
from reference import simplify as naive


def scene(n=2000, rest=3, seed=0, dtype=np.float32):
    """Discs on a wavy surface, smooth in colour on one half, noisy on the other, on a dyadic lattice."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4, 4, (2, n))
    means = np.stack([x, y, 0.3 * np.sin(x)], 1)
    color = np.stack([0.1 * x, 0.1 * y, 0 * x], 1) + (x > 0)[:, None] * rng.normal(size=(n, 3))
    return Splats.create(
        (np.round(means * 2**12) / 2**12).astype(dtype),
        quats=rng.normal(size=(n, 4)),
        scales=np.exp(rng.normal(-2.5, 0.3, (n, 3))) * [1, 1, 0.2],
        logit_opacities=rng.normal(0, 2, n),
        sh0=color[:, None],
        shN=rng.normal(0, 0.1, (n, rest, 3)),
    )


def one_round(prior, budget, flags, **options):
    config = SimplifyConfig(retention=1e-9, **options)
    return simplify(prior, budget, method="paper", protected=flags, config=config)


ARRAYS = ("means", "quats", "scales", "logit_opacities", "sh0", "shN")


def assert_same(a, b):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def assert_sound(result, count, budget):
    """What every result must be, on any input."""
    out = result.splats
    assert len(out) == budget
    assert np.isfinite(out.logit_opacities).all()
    assert out.finite_rows().all()
    assert (out.scales > 0).all()
    assert result.parents.shape == (count,)
    assert result.parents.dtype == np.int64
    used = np.unique(result.parents[result.parents >= 0])
    np.testing.assert_array_equal(used, np.arange(budget))
    assert result.protected.shape == (budget,)
    assert result.report["output_count"] == budget


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("budget", [1, 2, 77, 500, 1234, 1999, 2000])
def test_exact_count(method, budget):
    assert_sound(simplify(scene(), budget, method=method), 2000, budget)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_any_sh_degree(method, rest):
    assert simplify(scene(300, rest), 40, method=method).splats.shN.shape == (40, rest, 3)


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_matter(method):
    prior = scene(20_000)
    results = []
    for threads in (1, 2, 8):
        _core.set_num_threads(threads)
        results.append(simplify(prior, 3000, method=method))
    _core.set_num_threads(0)
    for other in results[1:]:
        assert_same(results[0].splats, other.splats)
        np.testing.assert_array_equal(results[0].parents, other.parents)


@pytest.mark.parametrize("method", METHODS)
def test_row_order_does_not_matter(method):
    prior = scene()
    rows = np.random.default_rng(1).permutation(len(prior))
    here, there = simplify(prior, 300, method=method), simplify(prior.take(rows), 300, method=method)
    assert_same(here.splats, there.splats)
    np.testing.assert_array_equal(here.parents[rows], there.parents)
    np.testing.assert_array_equal(here.protected, there.protected)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("factor", "shift"), [(1.0, 2.0**20), (2.0**-7, 0.0), (2.0**9, -(2.0**15))])
def test_moving_and_scaling_by_powers_of_two_is_exact(method, factor, shift):
    prior = scene(dtype=np.float64)
    moved = replace(prior, means=prior.means * factor + shift, scales=prior.scales * np.float32(factor))
    here, there = (simplify(s, 300, method=method) for s in (prior, moved))
    np.testing.assert_array_equal(there.splats.means, here.splats.means * factor + shift)
    np.testing.assert_array_equal(there.splats.scales, here.splats.scales * np.float32(factor))
    for name in ("quats", "logit_opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(there.splats, name), getattr(here.splats, name), err_msg=name)
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
    endless = np.where(np.arange(500) % 3 == 0, np.inf, np.where(np.arange(500) % 3 == 1, -np.inf, 0.3))
    return {
        "identical": base.take(one),
        "one": base.take([0]),
        "two": base.take([0, 1]),
        "coplanar": flat,
        "collinear": line,
        "floaters": replace(base, means=far),
        "tiny": replace(base, scales=scales),
        "huge": replace(base, scales=huge.astype(np.float32)),
        "logits": replace(base, logit_opacities=logits.astype(np.float32)),
        "infinite": replace(base, logit_opacities=endless.astype(np.float32)),
        "transparent": replace(base, logit_opacities=np.full(500, -np.inf, np.float32)),
    }


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", odd_scenes())
def test_odd_scenes(method, name):
    prior = odd_scenes()[name]
    for budget in {1, max(1, len(prior) // 10), len(prior)}:
        out = simplify(prior, budget, method=method)
        assert_sound(out, len(prior), budget)
        infinite = int(np.isinf(prior.logit_opacities).sum())
        assert out.report["infinite_logits"] == infinite


@pytest.mark.parametrize("method", METHODS)
def test_identical_gaussians_keep_their_shape(method):
    prior = scene(500).take(np.zeros(1000, int))
    out = simplify(prior, 1, method=method, config=SimplifyConfig(max_growth=1)).splats
    np.testing.assert_array_equal(out.means, prior.means[:1])
    np.testing.assert_allclose(np.sort(out.scales[0]), np.sort(prior.scales[0]), rtol=1e-5)
    np.testing.assert_allclose(out.sh0, prior.sh0[:1], rtol=1e-6)
    grown = simplify(prior, 1, method=method).splats  # α = 0.99 cannot hold the mass of a thousand
    factors = np.sort(grown.scales[0]) / np.sort(prior.scales[0])
    growth = 1.0 if method == "paper" else 1.25**0.5
    np.testing.assert_allclose(factors, [1, growth, growth], rtol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_non_finite_rows_are_dropped_and_counted(method):
    prior = scene(400)
    prior.means[5, 0], prior.scales[9, 1], prior.shN[30, 1, 2] = np.nan, np.inf, np.nan
    out = simplify(prior, 100, method=method)
    assert_sound(out, 400, 100)
    assert out.report["nonfinite_rows"] == 3
    assert (out.parents[[5, 9, 30]] == -1).all()


def test_bad_input_is_named():
    prior = scene(50)
    for budget, message in ((0, "at least 1, got 0"), (51, "at most the 50 Gaussians there are, got 51")):
        with pytest.raises(InputError, match=message):
            simplify(prior, budget)
    with pytest.raises(InputError, match="method: expected one of"):
        simplify(prior, 5, method="best")
    with pytest.raises(InputError, match=r"protected: expected bool of shape \(50,\)"):
        simplify(prior, 5, protected=np.zeros(49, bool))
    with pytest.raises(InputError, match="none of 50 rows is finite"):
        simplify(replace(prior, means=prior.means * np.nan), 5)
    with pytest.raises(InputError, match="retention: expected"):
        SimplifyConfig(retention=1.0)


def test_schedule():
    rounds = schedule(500_000, 50_000)
    assert len(rounds) == 8
    assert rounds[-1] == 50_000
    for before, after in zip([500_000, *rounds], rounds, strict=False):
        assert after < before
    assert schedule(100, 1, 0.999)[-1] == 1


@pytest.mark.parametrize("method", METHODS)
def test_the_report_adds_up(method):
    prior = scene(5000)
    out = simplify(prior, 600, method=method, visibility=None if method == "paper" else all_alike)
    rounds = out.report["rounds"]
    for r, before in zip(rounds, [5000, *(r["after"] for r in rounds)], strict=False):
        assert r["before"] == before
        assert r["after"] == r["before"] - r["dropped"] - r["merged"] - r["trimmed"]
    assert rounds[-1]["after"] == 600
    members = [np.count_nonzero(out.parents == p) for p in range(600)]
    assert out.report["merged_members"] == sum(m for m in members if m > 1)
    assert out.report["skipped"]["alone"] == members.count(1)
    assert sum(r["merged"] for r in rounds) >= out.report["merged_members"] - sum(m > 1 for m in members)


def test_paper_goes_by_the_schedule():
    out = simplify(scene(5000), 600, method="paper")
    assert [r["after"] for r in out.report["rounds"]] == schedule(5000, 600)


@pytest.mark.parametrize("logit", [-16, -1e4, -np.inf])
@pytest.mark.parametrize("method", METHODS)
def test_a_scene_of_which_nothing_shows_shrinks_evenly(method, logit):
    rng = np.random.default_rng(6)
    prior = Splats.create(
        rng.uniform(-1, 1, (2000, 3)), scales=np.full((2000, 3), 0.05), logit_opacities=np.full(2000, logit)
    )
    out = simplify(prior, 1000, method=method)
    assert_sound(out, 2000, 1000)
    octants = np.bincount((out.splats.means > 0) @ [1, 2, 4], minlength=8)
    assert octants.min() > 80  # of 125


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
                np.testing.assert_array_equal(getattr(small, name)[p], getattr(prior, name)[rows[0]])
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
    assert out.report["rounds"][0]["dropped"] == 1000 - visible
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
    for n in (2, 5, 8, 9, 30):
        points, colors = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) * 0.05
        prior = Splats.create(points, scales=np.ones((n, 3)), sh0=colors[:, None] / naive.C0)
        colors = 0.5 + naive.C0 * prior.sh0[:, 0].astype(np.float64)
        energy = naive.affine_energy(prior.means.astype(np.float64), colors, n)
        for factor, want in ((0.98, True), (1.02, False)):
            config = SimplifyConfig(flag_threshold=factor * energy)
            assert flag(prior, 1, config=config).all() == want, n


def test_command_line(tmp_path, command_line):
    from g2ard.io import read_splats, write_splats

    write_splats(tmp_path / "prior.ply", scene(1000))

    def run(*arguments):
        return command_line("simplify", "prior.ply", *arguments, cwd=tmp_path)

    status, out, err = run("-r", "10", "-o", "small.ply", "--no-views", "--json", "-")
    assert status == 0, err
    report = json.loads(out)
    assert (report["input_count"], report["output_count"]) == (1000, 100)
    assert set(report["seconds"]) == {"read", "simplify", "write", "total"}
    assert report["peak_rss_bytes"] > 1e6
    small, want = (
        read_splats(tmp_path / "small.ply"),
        simplify(read_splats(tmp_path / "prior.ply"), 100).splats,
    )
    for name in ARRAYS:  # files hold logarithms of the scales
        np.testing.assert_allclose(getattr(small, name), getattr(want, name), rtol=1e-5, err_msg=name)
    status, _, err = run("-r", "10", "-o", "seen.ply", "-q")
    assert status == 0, err
    assert len(read_splats(tmp_path / "seen.ply")) == 100
    for arguments, want, part in (
        (("-r", "10", "-o", "small.ply"), 1, "small.ply"),  # exists
        (("-n", "5", "-o", "b.ply", "--no-views", "--views", "x"), 2, "exclude"),
        (("-n", "1001", "-o", "b.ply"), 1, "prior.ply: the budget of 1001"),
        (("-n", "0", "-o", "b.ply"), 2, "positive count"),
        (("-o", "b.ply"), 2, "either -n COUNT or -r RATIO"),
        (("-n", "5", "-o", "b.ply", "--method", "best"), 2, "method"),
    ):
        status, _, err = run(*arguments)
        assert (status, part in err) == (want, True), (arguments, err)
        assert len(err.splitlines()) == 1
        assert not (tmp_path / "b.ply").exists()


class Views:
    """What a caller's views see, as `g2ard.render.visibility` returns it."""

    def __init__(self, weight, pixel_size):
        self.weight, self.pixel_size = np.asarray(weight), np.asarray(pixel_size)


@pytest.mark.parametrize("method", ["default", "fast"])
def test_what_is_seen_is_kept_finer(method):
    prior = scene(4000)
    left = prior.means[:, 0] < 0
    seen = Views(np.where(left, 100.0, 0.0), np.where(left, 0.01, np.inf))
    out = simplify(prior, 400, method=method, visibility=seen)
    assert_sound(out, 4000, 400)
    blind = simplify(prior, 400, method=method).splats
    share, unguided = (np.mean(s.means[:, 0] < 0) for s in (out.splats, blind))
    assert share > 0.6
    assert share > 5 * unguided  # detail draws the blind one to the other half
    with pytest.raises(InputError, match=r"visibility.weight: expected shape \(4000,\)"):
        simplify(prior, 400, method=method, visibility=Views(np.ones(3), np.ones(4000)))


def test_a_function_of_visibility_is_asked_again_as_the_scene_shrinks():
    prior, asked = scene(4000), []

    def look(splats):
        asked.append(len(splats))
        return Views(np.ones(len(splats)), np.full(len(splats), 0.01))

    out = simplify(prior, 100, visibility=look, protected=np.ones(4000, bool))
    assert_sound(out, 4000, 100)
    assert asked == [4000, 1200, 360, 100]  # the last to resize what was merged
    assert out.protected.all()


@pytest.mark.parametrize("growth", [1.0, 1.5])
@pytest.mark.parametrize("method", ["default", "fast"])
def test_clusters_conserve_mass_mean_and_covariance(method, growth):
    prior = scene(3000, dtype=np.float64)
    config = SimplifyConfig(max_growth=growth)
    e2 = (0.4 * 0.01) ** 2
    seen = Views(np.ones(3000), np.full(3000, 0.01))
    out = simplify(prior, 1500, method=method, visibility=seen, config=config)
    small = out.splats
    for p in range(0, 1500, 7):
        rows = np.flatnonzero(out.parents == p)
        if len(rows) == 1:
            for name in ARRAYS:
                np.testing.assert_array_equal(getattr(small, name)[p], getattr(prior, name)[rows[0]])
            continue
        mean, cov, alpha, sh = naive.merge_as_rendered(prior, rows, e2, growth)
        np.testing.assert_allclose(small.means[p], mean, rtol=0, atol=1e-7)  # blur and α are float32
        np.testing.assert_allclose(naive.covariance(small, p), cov, rtol=0, atol=1e-6 * np.trace(cov))
        np.testing.assert_allclose(small.opacities[p], alpha, rtol=1e-4)
        np.testing.assert_allclose(np.r_[small.sh0[p], small.shN[p]], sh, rtol=0, atol=1e-5)


def opaque_wall():
    """1,600 opaque discs, thin along z, that overlap into a wall; a view of it."""
    from g2ard.cameras import Cameras, look_at

    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], 1)
    wall = Splats.create(
        points, scales=np.tile([0.04, 0.04, 0.002], (1600, 1)), logit_opacities=np.full(1600, 6)
    )
    eyes = [[0, 0, -3], [0.5, 0.2, -3], [-0.4, 0.3, -2.8]]
    pose = [look_at(eye, [0, 0, 0], up=(0, -1, 0)) for eye in eyes]
    K = [[150, 0, 40], [0, 150, 30], [0, 0, 1]]
    return wall, Cameras.from_lists(pose, [K] * 3, [(80, 60)] * 3, ["a", "b", "c"])


@pytest.mark.parametrize("method", ["default", "fast"])
def test_an_opaque_wall_stays_opaque_and_thin(method):
    from g2ard.render import looker, render

    wall, cameras = opaque_wall()
    alpha = {}
    for growth in (1.0, 1.5):
        out = simplify(wall, 80, method=method, config=SimplifyConfig(max_growth=growth)).splats
        alpha[growth] = render(out, cameras, 0).alpha[15:45, 20:60].mean()
        assert out.scales.min(axis=1).max() < 0.0025
    assert alpha[1.5] > alpha[1.0] + 0.05
    seen = simplify(wall, 80, method=method, visibility=looker(cameras)).splats
    assert render(seen, cameras, 0).alpha[15:45, 20:60].mean() > alpha[1.5]


def all_alike(splats):
    """Views that see every Gaussian alike."""
    return Views(np.ones(len(splats)), np.full(len(splats), 0.01))


def test_stages_join_raw_members():
    prior = scene(4000, dtype=np.float64)
    config = SimplifyConfig(max_growth=1)
    out = simplify(prior, 100, visibility=all_alike, config=config)
    assert out.report["resized"] > 50
    for p in range(0, 100, 7):
        rows = np.flatnonzero(out.parents == p)
        if len(rows) > 1:
            mean, _, alpha, sh = naive.merge_as_rendered(prior, rows, (0.4 * 0.01) ** 2, 1.0)
            np.testing.assert_allclose(out.splats.means[p], mean, rtol=0, atol=1e-7)
            np.testing.assert_allclose(out.splats.opacities[p], alpha, rtol=1e-4)
            np.testing.assert_allclose(np.r_[out.splats.sh0[p], out.splats.shN[p]], sh, rtol=0, atol=1e-5)


def test_stages_drop_no_merged_cluster():
    rng = np.random.default_rng(4)
    prior = Splats.create(
        rng.uniform(0, 100, (2000, 3)), scales=np.full((2000, 3), 0.01), logit_opacities=np.full(2000, 2)
    )
    out = simplify(prior, 200, visibility=all_alike)
    assert_sound(out, 2000, 200)
    assert (out.parents >= 0).all()


@pytest.mark.parametrize("method", ["default", "fast"])
@pytest.mark.parametrize("scale", [1.0, 2.0**-10])
def test_what_is_seen_does_not_depend_on_the_order_of_rows(method, scale):
    from g2ard.render import looker

    wall, cameras = opaque_wall()
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] *= scale
    cameras = replace(cameras, viewmats=viewmats)
    wall = replace(wall, means=wall.means * np.float32(scale), scales=wall.scales * np.float32(scale))
    shuffled = np.random.default_rng(8).permutation(len(wall))
    a = simplify(wall, 80, method=method, visibility=looker(cameras))
    b = simplify(wall.take(shuffled), 80, method=method, visibility=looker(cameras))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a.splats, name), getattr(b.splats, name), err_msg=name)
    np.testing.assert_array_equal(a.parents[shuffled], b.parents)
    assert a.report["resized"] > 40


def test_bands_of_zeros_are_skipped_and_come_back():
    prior = scene(600).with_sh_degree(1)
    padded = prior.with_sh_degree(3)
    a, b = simplify(prior, 60), simplify(padded, 60)
    np.testing.assert_array_equal(a.splats.shN, b.splats.shN[:, :3])
    assert b.splats.shN.shape == (60, 15, 3)
    assert not b.splats.shN[:, 3:].any()
    assert (a.report["skipped"]["sh_bands"], b.report["skipped"]["sh_bands"]) == (0, 2)
    assert b.report["skipped"]["alone"] == (np.bincount(b.parents[b.parents >= 0]) == 1).sum()
