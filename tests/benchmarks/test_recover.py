"""The study of recovery: its rows, resuming and summary."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.rows import Row
from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from g2ard.errors import InputError
from helpers.studies import ball_of, measured


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    return ball_of(tmp_path_factory.mktemp("bench"), 1500)


def ask(scene: SceneSpec, out: Path, name: str, **options: str) -> list[Row]:
    rows = measured(f"recover-{name}", scene, out, **{"protocol": "pool", **options})
    assert [row["error"] for row in rows if "error" in row] == []
    return rows


def test_regularizer_rows_are_whole_and_not_measured_twice(
    scene: SceneSpec, tmp_path: Path
) -> None:
    options = {"methods": "full,-anchor", "ratios": "5", "seeds": "0,1", "steps": "120"}
    found = ask(scene, tmp_path, "regularizers", **options)
    final = [row for row in found if row["final"]]
    pairs = [("full", 0), ("full", 1), ("-anchor", 0), ("-anchor", 1)]
    assert [(row["variant"], row["seed"]) for row in final] == pairs
    for row in final:
        assert (row["count"], row["budget"], row["step"], row["skipped"]) == (300, 300, 120, 0)
        assert row["drift95"] > 0
        assert row["psnr"] > 10
    assert [r["step"] for r in found if r["cell"] == final[0]["cell"]] == [25, 50, 100, 120]
    assert final[0]["psnr"] != final[1]["psnr"]  # another order of views
    before = (tmp_path / "rows.csv").read_text()
    assert ask(scene, tmp_path, "regularizers", **options) == found
    assert (tmp_path / "rows.csv").read_text() == before


def test_curves_compare_schedules(scene: SceneSpec, tmp_path: Path) -> None:
    found = ask(scene, tmp_path, "curves", methods="default", ratios="10", steps="50,200")
    ends = [row for row in found if row["final"]]
    assert [row["variant"] for row in ends] == ["default@50", "default@200"]
    for end in ends:
        assert end["psnr"] > next(row["psnr"] for row in found if row["variant"] == end["variant"])
    assert ends[1]["seconds"] > ends[0]["seconds"]
    slow = {**ends[0], "variant": "paper/10", "seconds": 100.0, "psnr": ends[0]["psnr"] - 0.01}
    summary = read_study(DEFINITIONS / "recover-curves.toml").summary
    faster, never = summary([*found, slow]), summary([*found, {**slow, "psnr": 99.0}])
    assert float(faster[2][0][-2]) <= round(ends[0]["seconds"], 1)
    assert never[2][0][-2:] == ["never", "–"]


def test_a_preset_distils_anew_in_as_many_steps(scene: SceneSpec, tmp_path: Path) -> None:
    found = ask(scene, tmp_path, "rounds", ratios="3", steps="60", seeds="0")
    assert [row["variant"] for row in found] == ["one-shot", "rounds", "one-shot twice as long"]
    assert [row["step"] for row in found] == [60, 60, 800]
    assert {row["count"] for row in found} == {500}
    assert found[0]["psnr"] != found[1]["psnr"]


def test_every_kind_of_view_is_scored(scene: SceneSpec, tmp_path: Path) -> None:
    options = {"methods": "default", "ratios": "5", "steps": "50", "size": "48"}
    found = ask(scene, tmp_path, "curves", **options, protocol="all")
    kinds = ["pool", "near", "standing", "anywhere"]
    ends = [row for row in found if row["final"]]
    assert [row["views_kind"] for row in ends] == kinds
    assert {row["scene"] for row in found} == {"ball 48px"}
    on_the_way = [(row["views_kind"], row["step"]) for row in found if not row["final"]]
    assert sorted(on_the_way) == [(kind, step) for kind in sorted(kinds) for step in (25, 50)]
    assert len({row["psnr"] for row in ends}) == 4
    assert all(row["psnr_worst"] < row["psnr"] for row in ends)
    before = (tmp_path / "rows.csv").read_text()
    ask(scene, tmp_path, "curves", **options, protocol="standing")
    assert (tmp_path / "rows.csv").read_text() == before  # nothing was run again
    with pytest.raises(InputError, match="need a trained scene"):
        ask(replace(scene, targets="photos"), tmp_path, "curves", protocol="standing")
