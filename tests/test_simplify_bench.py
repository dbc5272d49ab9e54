"""The simplifiers' benchmark: rows, resuming, failures."""

from __future__ import annotations

from pathlib import Path

import pytest
from scenes import around, checkered_ball

from g2ard import io
from g2ard.bench import rows as table
from g2ard.bench.simplify import Cell, bench_simplify, find_splat_transform
from g2ard.errors import InputError

METHODS = ("default", "fast", "paper", "nanogs", "lightgaussian")


def test_measures_writes_and_resumes(tmp_path: Path) -> None:
    scene, views, csv = tmp_path / "ball.ply", tmp_path / "views.json", tmp_path / "figures.csv"
    io.write_splats(scene, checkered_ball(2000))
    io.write_views(views, around(16))
    cells = bench_simplify([scene], csv, ratios=[4], methods=METHODS, views=views)
    assert table.read(csv, Cell) == [_rounded(c) for c in cells]
    assert [c.key for c in cells] == [("ball", 4.0, m) for m in METHODS]
    for c in cells:
        assert (c.error, c.input_count, c.budget, c.count, c.views) == ("", 2000, 500, 500, 2)
        assert 8 < c.psnr < 60
        assert 0 < c.cpu_s < 60
        assert 20 < c.peak_mb < 2000

    lines = csv.read_text().splitlines()
    again = bench_simplify([scene], csv, ratios=[4], methods=[*METHODS, "splat-transform"], views=views)
    assert csv.read_text().splitlines()[: len(lines)] == lines  # nothing was measured twice
    assert again[:5] == [_rounded(c) for c in cells]
    assert again[5].error == "splat-transform: not found"
    assert again[5].psnr is None

    program = tmp_path / "broken"
    program.write_text("#!/bin/sh\necho it broke 1.2 >&2\nexit 7\n")
    program.chmod(0o755)
    (failed,) = bench_simplify(
        [scene], csv, ratios=[4], methods=["splat-transform"], views=views, splat_transform=program
    )
    assert failed.error == "exit status 7: it broke 1.2"
    assert failed.version == "it broke 1.2"
    assert len(table.read(csv, Cell)) == 6  # in the old failure's place


def _rounded(cell: Cell) -> Cell:
    return Cell(**{k: round(v, 6) if isinstance(v, float) else v for k, v in vars(cell).items()})


def test_refuses_a_foreign_file_an_unknown_method_and_an_absent_program(tmp_path: Path) -> None:
    csv = tmp_path / "mine.csv"
    csv.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="other columns"):
        bench_simplify([], csv)
    assert csv.read_text() == "a,b\n1,2\n"
    with pytest.raises(InputError, match="magic"):
        bench_simplify([], csv, methods=["magic"])
    with pytest.raises(InputError, match="no such program"):
        find_splat_transform(tmp_path / "nothing")
