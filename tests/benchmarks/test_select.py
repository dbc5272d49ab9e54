"""The study of selection policies: what it compares, that it goes on where it stopped, and its summary."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import rows as table
from benchmarks.select import ARMS, Trial, bench_select, summary
from benchmarks.select_workspaces import Size, Workspace, pool_of, workspace_of
from g2ard.errors import InputError
from g2ard.io import write_splats
from helpers.commands import CommandLine
from helpers.scenes import checkered_ball

SIZE = Size(gaussians=150, pixels=48, candidates=16, tests=4)
FEW = {"percents": (25.0,), "seeds": 1, "draws": 2, "steps": 4, "size": SIZE}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "ball.ply"
    write_splats(path, checkered_ball(1200))
    return path


@pytest.fixture(scope="module")
def ball(scene: Path) -> Workspace:
    return workspace_of(scene, SIZE)


def test_no_pool_holds_what_is_scored(ball: Workspace) -> None:
    for kind in ("even", "biased"):
        for seed in range(5):
            pool = pool_of(ball, kind, seed)
            assert len(set(pool.rows.tolist())) == len(pool.rows) == 16
            assert not set(pool.rows) & (set(ball.tests) | set(pool.crowd))
            assert not set(ball.tests) & set(pool.crowd)
            np.testing.assert_array_equal(pool.rows, pool_of(ball, kind, seed).rows)


def test_a_biased_pool_is_crowded(ball: Workspace) -> None:
    def spread(kind: str, seed: int) -> float:
        places = ball.targets.cameras.positions[pool_of(ball, kind, seed).rows]
        return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))

    ratios = [spread("biased", seed) / spread("even", seed) for seed in range(8)]
    assert np.mean(ratios) < 0.7


def test_every_arm_runs_once_and_never_again(scene: Path, tmp_path: Path) -> None:
    path, cache = tmp_path / "study.csv", tmp_path / "cache"
    trials = bench_select([scene], path, cache=cache, **FEW)  # type: ignore[arg-type]
    assert len(trials) == 2 * (2 + (len(ARMS) - 1))  # two pools; random is drawn twice
    assert {t.arm for t in trials} == set(ARMS)
    for t in trials:
        assert (t.k, t.percent) == ((16, 100) if t.arm.startswith("pool") else (4, 25))
        assert 0 < t.psnr_in < 100
        assert (t.psnr_crowd is None) == (t.pool == "even")
    assert any(cache.rglob("*.npy"))
    before = path.read_bytes()
    assert bench_select([scene], path, **FEW) == table.read(path, Trial)  # type: ignore[arg-type]
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="4 steps at 48 pixels"):
        bench_select([scene], path, **{**FEW, "steps": 5})  # type: ignore[arg-type]
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:1] + lines[4:]))  # as if stopped, three trials short
    again = bench_select([scene], path, cache=cache, **FEW)  # type: ignore[arg-type]
    assert len(table.read(path, Trial)) == len(trials)
    figures = [(t.key, round(t.psnr_in, 4), round(t.ssim_out, 4)) for t in trials]
    assert [(t.key, round(t.psnr_in, 4), round(t.ssim_out, 4)) for t in again] == figures


def test_gains_are_over_random_on_the_same_pool() -> None:
    base = Trial(
        "s", "even", "random", 10.0, 0, 0, 40, 4, 20.0, 0.5, 18.0, 0.5, None, 0.0, 1.0, 5, 9, 48, "m"
    )  # fmt: skip
    rows = [
        base,
        replace(base, draw=1, psnr_in=22.0),
        replace(base, seed=1, psnr_in=30.0),
        replace(base, arm="auto", psnr_in=22.5, psnr_out=19.0),
        replace(base, arm="auto", seed=1, psnr_in=30.5, psnr_out=18.0),
        replace(base, arm="pool", percent=100.0, psnr_in=24.0),
    ]
    found = {row["arm"]: row for row in summary(rows)}
    assert found["random"]["in"] == pytest.approx((21 + 30) / 2)
    assert found["auto"]["in"] == pytest.approx((1.5 + 0.5) / 2)
    assert found["auto"]["out"] == pytest.approx(0.5)
    assert found["auto"]["noise_in"] == pytest.approx(np.std([1.5, 0.5], ddof=1))
    assert found["pool"]["in"] == pytest.approx(3.0)


def test_refuses_what_it_does_not_know(scene: Path, tmp_path: Path, command_line: CommandLine) -> None:
    with pytest.raises(InputError, match="arms"):
        bench_select([scene], tmp_path / "a.csv", arms=["best"])
    with pytest.raises(InputError, match="pools"):
        bench_select([scene], tmp_path / "a.csv", pools=["odd"])
    with (tmp_path / "other.csv").open("w", newline="") as file:
        csv.writer(file).writerow(["scene", "ratio"])
    status, _, error = command_line("bench", "select", scene, "--csv", "other.csv", cwd=tmp_path)
    assert status == 1
    assert "other.csv" in error
    status, _, error = command_line("bench", "select", scene, "--percents", "10,120", cwd=tmp_path)
    assert status == 2
    assert "120" in error


def test_the_command_prints_gains(scene: Path, tmp_path: Path, command_line: CommandLine) -> None:
    status, out, error = command_line(
        "bench", "select", scene, "--csv", "s.csv", "--pools", "even", "--arms", "random,auto", "--percents",
        "25%", "--seeds", 1, "--draws", 2, "--steps", 3, "-n", 100, "--candidates", 12, "--size", 32,
        cwd=tmp_path,
    )  # fmt: skip
    assert status == 0, error
    assert "auto" in out + error
    assert len(table.read(tmp_path / "s.csv", Trial)) == 3
