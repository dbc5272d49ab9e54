"""The study of selection policies: pools, arms, resuming, and gains over random."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kinds.select import ARMS, Universe, pool_of
from benchmarks.rows import Row
from benchmarks.runner import run
from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from helpers.studies import ball_of

FEW = {"percents": "25", "seeds": "0", "draws": "2", "steps": "4"}
SMALL = {"count": "150", "size": "48", "candidates": "16", "tests": "4"}
STUDY = read_study(DEFINITIONS / "select.toml").narrowed({**FEW, **SMALL})


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    return ball_of(tmp_path_factory.mktemp("study"), 1200, views=False)


@pytest.fixture(scope="module")
def ball(scene: SceneSpec, tmp_path_factory: pytest.TempPathFactory) -> Universe:
    return Universe(tmp_path_factory.mktemp("work"), STUDY, scene)


def test_no_pool_holds_what_is_scored(ball: Universe) -> None:
    for kind in ("even", "biased"):
        for seed in range(5):
            pool = pool_of(ball, kind, seed)
            assert len(set(pool.rows.tolist())) == len(pool.rows) == 16
            assert not set(pool.rows) & (set(ball.held) | set(pool.crowd))
            assert not set(ball.held) & set(pool.crowd)
            np.testing.assert_array_equal(pool.rows, pool_of(ball, kind, seed).rows)


def test_a_biased_pool_is_crowded(ball: Universe) -> None:
    def spread(kind: str, seed: int) -> float:
        places = ball.shown.cameras.positions[pool_of(ball, kind, seed).rows]
        return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))

    ratios = [spread("biased", seed) / spread("even", seed) for seed in range(8)]
    assert np.mean(ratios) < 0.7


def test_every_arm_runs_once_and_never_again(scene: SceneSpec, tmp_path: Path) -> None:
    made = replace(STUDY, scenes=(scene,))
    trials = run([made], tmp_path)
    assert len(trials) == 2 * (2 + (len(ARMS) - 1))  # two pools; random is drawn twice
    assert {t["arm"] for t in trials} == set(ARMS)
    for t in trials:
        assert (t["k"], t["percent"]) == ((16, 100) if t["arm"].startswith("pool") else (4, 25))
        assert 0 < t["psnr_in"] < 100
        assert ("psnr_crowd" in t) == (t["pool"] == "biased")
    lines = (tmp_path / "rows.csv").read_text().splitlines(keepends=True)
    assert run([made], tmp_path) == trials
    assert (tmp_path / "rows.csv").read_text() == "".join(lines)
    # as if stopped, three trials short
    (tmp_path / "rows.csv").write_text("".join(lines[:1] + lines[4:]))
    again = run([made], tmp_path)
    for name in ("arm", "psnr_in", "ssim_out"):
        assert [t[name] for t in again] == [t[name] for t in trials]


def test_gains_are_over_random_on_the_same_pool() -> None:
    base: Row = {"scene": "s", "pool": "even", "arm": "random", "percent": 10.0, "seed": 0}
    base |= {"psnr_in": 20.0, "psnr_out": 18.0}
    rows = [
        base,
        {**base, "draw": 1, "psnr_in": 22.0},
        {**base, "seed": 1, "psnr_in": 30.0},
        {**base, "arm": "auto", "psnr_in": 22.5, "psnr_out": 19.0},
        {**base, "arm": "auto", "seed": 1, "psnr_in": 30.5, "psnr_out": 18.0},
        {**base, "arm": "pool", "percent": 100.0, "psnr_in": 24.0},
    ]
    summary = STUDY.summary(rows)
    found = {line[3]: line[4:] for line in summary[2]}
    assert found["random"][0] == f"{(21 + 30) / 2:.2f}"
    assert found["auto"] == ["1.00", f"{np.std([1.5, 0.5], ddof=1):.2f}", "0.50", "0.71"]
    assert found["pool"][0] == "3.00"
