"""`bench ship` on a small scene."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from benchmarks.process import measured
from benchmarks.ship import bench_ship
from g2ard.errors import G2ardError, InputError
from g2ard.io import write_splats
from helpers.commands import CommandLine
from helpers.scenes import checkered_ball


def test_formats_lose_what_their_quanta_say(tmp_path: Path) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(600))
    cells = bench_ship([tmp_path / "ball.ply"], tmp_path / "f.csv", ratios=[1, 5], formats=["sog", "splat"])
    pool = {(c.ratio, c.format): c for c in cells if c.views_kind == "pool"}
    assert set(pool) == {(r, f) for r in (1, 5) for f in ("ply", "sog", "splat")}
    assert pool[1, "ply"].psnr > 90
    assert pool[1, "sog"].bytes < pool[1, "ply"].bytes / 2
    assert pool[5, "ply"].lost == 0
    assert abs(pool[5, "sog"].lost) < 0.1
    assert pool[1, "splat"].psnr < pool[1, "sog"].psnr  # no harmonics, coarse rotations
    assert len((tmp_path / "f.csv").read_text().splitlines()) == len(cells) + 1


def test_what_cannot_be_measured_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command_line: CommandLine
) -> None:
    """As on Windows, which has no such call."""
    write_splats(tmp_path / "ball.ply", checkered_ball(100))
    monkeypatch.delattr(os, "posix_spawnp", raising=False)
    for ask in (
        ("simplify", "ball.ply", "--methods", "fast", "--csv", "f.csv"),
        ("run", "--scene", "ball.ply", "-o", "out"),
        ("ship", "ball.ply", "--csv", "f.csv", "--splat-transform", sys.executable),
    ):
        status, _, error = command_line("bench", *ask, cwd=tmp_path)
        assert status == 1
        assert error.splitlines()[-1] == (
            "g2ard: this benchmark measures processes by POSIX's calls, which Windows lacks"
        )
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]
    with pytest.raises(G2ardError, match="POSIX"):
        measured([sys.executable, "-c", ""], tmp_path / "log")


def test_bad_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="formats: expected"):
        bench_ship([], tmp_path / "f.csv", formats=["ksplat"])
    with pytest.raises(InputError, match="ratios: expected"):
        bench_ship([], tmp_path / "f.csv", ratios=[0.5])
