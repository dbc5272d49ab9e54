"""Budgets in bytes, devices and quality."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from scenes import around, checkered_ball

from g2ard.budget import DEVICES, Quality, count_for_bytes, count_for_quality, file_bytes
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.simplify import simplify
from g2ard.splats import Splats

CommandLine = Callable[..., tuple[int, str, str]]


def fast(splats: Splats, count: int) -> Splats:
    return simplify(splats, count, method="fast").splats


@pytest.mark.parametrize("name", ["a.ply", "a.SOG", "a.spz", "a.compressed.ply", "x/meta.json"])
def test_the_count_fills_the_bytes(name: str) -> None:
    scene = checkered_ball(6000)
    whole = file_bytes(scene, name)
    count = count_for_bytes(scene, whole // 3, name, fast)
    got = file_bytes(fast(scene, count), name)
    assert 0.85 * whole / 3 < got < 1.05 * whole / 3
    assert count_for_bytes(scene, 2 * whole, name, fast) == 6000
    with pytest.raises(InputError, match="hold hardly a Gaussian"):
        count_for_bytes(scene, 900, name, fast)


def test_the_count_keeps_the_quality() -> None:
    scene, views = checkered_ball(4000), around(6)
    counts = []
    for wanted in (Quality(22, 0), Quality(26, 0), Quality(0, 0.9)):
        count, found = count_for_quality(scene, wanted, views, fast)
        assert found.meets(wanted)
        assert count < 4000
        counts.append(count)
    assert counts[0] < counts[1]
    assert count_for_quality(scene, Quality(200, 0), views, fast)[0] == 4000


def test_simplify_fits(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(6000))
    code, _, told = command_line("simplify", "a.ply", "--fit", "60kB", "-o", "b.sog", cwd=tmp_path)
    assert code == 0, told
    assert "--fit 60kB: about" in told
    assert 50_000 < (tmp_path / "b.sog").stat().st_size <= 60_000
    assert command_line("simplify", "a.ply", "--fit", "quest3", "-o", "c.ply", cwd=tmp_path)[0] == 0
    assert len(read_splats(tmp_path / "c.ply")) == 6000 < DEVICES["quest3"]
    code, _, told = command_line("simplify", "a.ply", "--min-psnr", "25", "-o", "d.ply", cwd=tmp_path)
    assert code == 0, told
    assert "should keep 2" in told
    assert " dB, SSIM " in told.splitlines()[-1]


@pytest.mark.parametrize(
    "words", [["--fit", "5"], ["--fit", "5MB", "-n", "10"], ["--fit", "web", "--min-psnr", "30"], []]
)
def test_one_budget_that_makes_sense(words: list[str], tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(50))
    code, _, told = command_line("simplify", "a.ply", *words, "-o", "b.ply", cwd=tmp_path)
    assert (code, told.count("\n")) == (2, 1), told
