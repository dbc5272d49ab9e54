"""The recovery benchmark: its rows, resuming, and what it makes of them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks import rows
from benchmarks.recover import Look, RecoverBench, bench_recover
from benchmarks.speedup import speedups
from g2ard import io
from g2ard.errors import InputError
from helpers.commands import CommandLine
from helpers.scenes import around, checkered_ball


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> RecoverBench:
    folder = tmp_path_factory.mktemp("bench")
    io.write_splats(folder / "ball.ply", checkered_ball(1500))
    io.write_views(folder / "views.json", around(16))
    return RecoverBench(folder / "ball.ply", folder / "views.json")


def test_regularizer_rows_are_whole_and_not_measured_twice(bench: RecoverBench, tmp_path: Path) -> None:
    csv = tmp_path / "f.csv"
    ask = partial(bench_recover, bench, "regularizers", csv, ratios=[5], seeds=[0, 1], steps=[120])
    found = ask(variants=["full", "-anchor"])
    final = [look for look in found if look.final]
    pairs = [("full", 0), ("full", 1), ("-anchor", 0), ("-anchor", 1)]
    assert [(look.variant, look.seed) for look in final] == pairs
    for look in final:
        assert (look.count, look.budget, look.step, look.skipped) == (300, 300, 120, 0)
        assert look.drift95 is not None
        assert look.psnr > 10
    assert [look.step for look in found if look.key == final[0].key] == [25, 50, 100, 120]
    assert final[0].psnr != final[1].psnr  # another order of views
    before = csv.read_text()
    assert [look.key for look in ask(variants=["full", "-anchor"])] == [look.key for look in found]
    assert csv.read_text() == before

    stopped = [line for line in before.splitlines() if not (",-anchor," in line and ",120," in line)]
    csv.write_text("\n".join(stopped) + "\n")
    ask(variants=["full"])
    assert "-anchor" not in csv.read_text()  # the looks of runs without an end are gone


def test_curves_compare_schedules(bench: RecoverBench, tmp_path: Path) -> None:
    names = ["default@50", "default@200"]
    found = bench_recover(bench, "curves", tmp_path / "f.csv", ratios=[2], steps=[50, 200], variants=names)
    ends = [look for look in found if look.final]
    assert ends[1].psnr > ends[0].psnr
    assert ends[1].seconds > ends[0].seconds
    slow = replace(ends[0], variant="paper/10", seconds=100.0, psnr=ends[0].psnr - 0.01)
    (faster,) = speedups([*found, slow])
    assert faster.reached_s is not None
    assert faster.reached_s <= ends[0].seconds
    assert faster.share == faster.reached_s / 100
    (never,) = speedups([*found, replace(slow, psnr=99.0)])
    assert never.share is None


def test_rounds_take_the_time_they_are_given(bench: RecoverBench, tmp_path: Path) -> None:
    found = bench_recover(bench, "rounds", tmp_path / "f.csv", ratios=[3], seconds=1.0)
    ends = [look for look in found if look.final]
    assert [look.variant for look in ends] == ["one-shot", "rounds", "light-rounds"]
    assert {look.count for look in ends} == {500}
    for look in ends:
        assert 0.9 <= look.seconds < 1.6  # a round that only loses ends at three quarters of its time
    assert any(look.count > 500 for look in found)  # looks within rounds


def test_standing_views_are_looked_at_beside_the_pools(bench: RecoverBench, tmp_path: Path) -> None:
    csv = tmp_path / "f.csv"
    both = RecoverBench(bench.scene, bench.views, size=48, protocol="both")
    ask = partial(
        bench_recover, study="curves", csv_path=csv, ratios=[5], steps=[50], variants=["default@50"]
    )
    ask(replace(both, protocol="pool"))
    found = ask(both)
    kinds = ["pool", "near", "standing"]
    assert [look.views_kind for look in found if look.final] == kinds
    on_the_way = [(look.views_kind, look.step) for look in found if not look.final]
    assert sorted(on_the_way) == [(kind, step) for kind in sorted(kinds) for step in (25, 50)]
    assert len({look.psnr for look in found if look.final}) == 3
    before = csv.read_text()
    standing = ask(replace(both, protocol="standing"))
    assert csv.read_text() == before  # nothing was run again
    assert {look.views_kind for look in standing} == {"near", "standing"}
    slow = [
        replace(look, variant="paper/10", seconds=100.0, psnr=look.psnr - 0.01)
        for look in found
        if look.final
    ]
    assert [s.views_kind for s in speedups([*found, *slow])] == kinds
    with pytest.raises(InputError, match="protocol"):
        ask(replace(both, protocol="sitting"))
    with pytest.raises(InputError, match="trained scene is needed"):
        ask(replace(both, photos=True))


def test_bad_wishes_are_named(bench: RecoverBench, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="study"):
        bench_recover(bench, "speed", tmp_path / "f.csv")
    with pytest.raises(InputError, match="variants: expected some of full"):
        bench_recover(bench, "regularizers", tmp_path / "f.csv", variants=["half"])
    (tmp_path / "f.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="columns"):
        rows.read(tmp_path / "f.csv", Look)


def test_command(bench: RecoverBench, tmp_path: Path, command_line: CommandLine) -> None:
    asked = ("--study", "multiplier", "--variants", "×1,chosen", "--steps", "30", "--ratios", "5")
    place = ("bench", "recover", bench.scene, "--views", str(bench.views))
    status, _, told = command_line(*place, *asked, cwd=tmp_path)
    assert status == 0, told
    assert "×1" in told
    assert "chosen" in told
    looks = rows.read(tmp_path / "bench_recover.csv", Look)
    assert np.isfinite([look.psnr for look in looks]).all()
