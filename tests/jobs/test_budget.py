"""Budgets: counts and ratios, several in one call, and budgets in bytes, devices and quality."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.cli.budget_options import Count, Counts
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.jobs.budget import DEVICES, LAYERS, Budget
from g2ard.jobs.budget_search import (
    Quality,
    ResolvedBudget,
    find_count_for_bytes,
    find_count_for_quality,
    measure_file,
    render_clipped,
)
from g2ard.jobs.close_up import close_up
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import GivenViews
from g2ard.jobs.simplify import Reduction
from g2ard.pipeline.dense import InMemory
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import simplify
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball


def fast(splats: Splats, count: int) -> Splats:
    return simplify(splats, count, method="fast").splats


def test_bytes_too_few_for_a_gaussian_in_tiles() -> None:
    with pytest.raises(InputError, match=r"a\.ply: 100 bytes are too few"):
        find_count_for_bytes(
            checkered_ball(9), 100, "a.ply", partial(fast, checkered_ball(9)), total=6000
        )


def test_a_small_file_of_a_format_with_a_head_takes_few_trials() -> None:
    scene, tried = checkered_ball(6000), []

    def reduce(count: int) -> Splats:
        tried.append(count)
        return fast(scene, count)

    count = find_count_for_bytes(scene, 20_000, "a.sog", reduce)
    assert 0.97 * 20_000 < measure_file(fast(scene, count), "a.sog") <= 20_000
    assert len(tried) <= 6


def test_a_file_that_fills_nearly_all_bytes_ends_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """98 % do, 97 % do not; here every trial has the same size."""
    for most, last in ((98.0, 1), (97.0, 6)):
        tried: list[int] = []

        def size(splats: Splats, name: str, tried: list[int] = tried, most: float = most) -> int:
            return len(splats) if not tried else round(100 * most)

        def reduce(count: int, tried: list[int] = tried) -> Splats:
            tried.append(count)
            return checkered_ball(count)

        monkeypatch.setattr("g2ard.jobs.budget_search.measure_file", size)
        assert find_count_for_bytes(checkered_ball(40_000), 10_000, "a.sog", reduce) > 0
        assert len(tried) == last, most


@pytest.mark.parametrize("name", ["a.ply", "a.SOG", "a.spz", "a.compressed.ply", "x/meta.json"])
def test_the_count_fills_the_bytes(name: str) -> None:
    scene = checkered_ball(6000)
    whole = measure_file(scene, name)
    count = find_count_for_bytes(scene, whole // 3, name, partial(fast, scene))
    got = measure_file(fast(scene, count), name)
    assert 0.9 * whole / 3 < got <= whole // 3
    assert find_count_for_bytes(scene, 2 * whole, name, partial(fast, scene)) == 6000
    with pytest.raises(InputError, match="bytes are too few"):
        find_count_for_bytes(scene, 900, name, partial(fast, scene))


def test_the_count_keeps_the_quality() -> None:
    scene, views = checkered_ball(4000), around(6)
    dense, counts, looked = (render_clipped(scene, views), 4000), [], []

    def reduce(count: int) -> Splats:
        looked.append(count)
        return fast(scene, count)

    for wanted in (Quality(22, 0), Quality(26, 0), Quality(0, 0.9), Quality(22, 0.9)):
        looked.clear()
        count, found = find_count_for_quality(*dense, wanted, views, reduce)
        assert found.meets(wanted)
        assert found.over(wanted) < 0.3
        assert len(looked) <= 8
        counts.append(count)
    assert counts[0] < counts[1]
    assert counts[3] == max(counts[0], counts[2])
    assert find_count_for_quality(*dense, Quality(200, 0), views, reduce)[0] == 4000
    looked.clear()
    count, found = find_count_for_quality(
        *dense, Quality(41, 0), views, reduce
    )  # far above what a quarter keeps
    assert 2000 < count < 4000
    assert found.psnr >= 41
    assert find_count_for_quality(*dense, Quality(1, 0), views, reduce)[0] == 64


def test_simplify_fits(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(2000))
    fast_simplify = ("simplify", "a.ply", "--method", "fast")
    told = succeeds(command_line, tmp_path, *fast_simplify, "--fit", "20kB", "-o", "b.sog").err
    assert "20kB: about" in told
    assert f"b.sog: {(tmp_path / 'b.sog').stat().st_size:,} of 20,000 bytes" in told
    assert 16_000 < (tmp_path / "b.sog").stat().st_size <= 20_000
    told = succeeds(command_line, tmp_path, *fast_simplify, "--fit", "quest3", "-o", "c.ply").err
    assert "quest3: nothing to do, all 2,000 Gaussians already fit" in told
    assert len(read_splats(tmp_path / "c.ply")) == 2000 < DEVICES["quest3"]


@pytest.mark.parametrize("recovered", [False, True])
def test_quest3_bounds_overdraw(recovered: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, said = checkered_ball(3000), []
    reduce = Reduction(
        InMemory(scene), GivenViews(say=said.append), blind=True, recovered=recovered
    )
    plain = reduce.resolve(Budget(fit="quest3"), "a", "a.ply")
    assert plain.count == reduce.resolve(Budget(fit="web"), "a", "a.ply").count == 3000
    dense = close_up(scene)
    assert dense is not None
    monkeypatch.setitem(LAYERS, "quest3", dense["mean"] / 1.3)
    found = reduce.resolve(Budget(fit="Quest3"), "a", "a.ply").count
    near = close_up(fast(scene, found) if recovered else reduce(found).splats)
    assert near is not None
    assert dense["mean"] / 4 < near["mean"] <= dense["mean"] / 1.3
    assert f"at {found:,}" in " ".join(said)
    # out of reach: the search ends, and says what it has
    monkeypatch.setitem(LAYERS, "quest3", 1e-3)
    assert reduce.resolve(Budget(fit="quest3"), "a", "a.ply").count < found


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "fast"},
        {"method": "paper"},
        {"method": "default"},
        {"keep_region": ((0, 0, 1, 0.5),)},
    ],
)
def test_distill_measures_the_simplification_that_it_makes(settings: dict[str, Any]) -> None:
    said: list[str] = []
    # no views of other kinds, which take longest
    settings = {"steps": 1, "focus": "far", **settings}
    options = DistillOptions(
        views=around(16, (48, 36)), size=48, settings=settings, say=said.append
    )
    job = prepare(checkered_ball(800), Budget(min_psnr=24), options)
    judged = job.budget.judge(job.run().simplified)
    assert judged is not None
    kept = judged[1].partition(" in the 12 views")[0]
    assert f"{kept} before recovery, in 12 views generated to choose the count" in said


def test_a_result_that_is_too_large_is_merged_further() -> None:
    first, said = fast(checkered_ball(3000), 1000), []
    most = measure_file(first, "a.ply") // 2
    small = ResolvedBudget(1000, bytes=most, file="a.ply").shrink(first, said.append)
    assert measure_file(small, "a.ply") <= most
    assert 0.9 * 500 < len(small) < 510
    assert "merging 1,000 to " in said[0]


@pytest.mark.parametrize("count", [2, 3, 40])
def test_a_size_that_no_count_fits_leaves_one_gaussian(count: int) -> None:
    assert len(ResolvedBudget(count, bytes=1, file="a.ply").shrink(checkered_ball(count))) == 1


def test_bytes_are_of_the_degree_that_is_written() -> None:
    scene, said = checkered_ball(3000), []
    given = {"views": around(8), "settings": {"focus": "far"}}
    small = g2ard.distill(scene, fit="300kB", sh_degree=3, steps=3, say=said.append, **given)
    assert small.splats.sh_degree == 3
    assert not [line for line in said if "bytes are too many" in line]
    assert 0.95 * 300_000 < measure_file(small.splats, "a.ply") <= 300_000


def test_decibels_are_of_the_file(tmp_path: Path, command_line: CommandLine) -> None:
    scene = checkered_ball(800)
    write_splats(tmp_path / "a.ply", replace(scene, shN=8 * scene.shN))
    counts, ask = {}, ("simplify", "a.ply", "--method", "fast", "--min-psnr")
    for name in ("b.ply", "b.splat"):
        told = succeeds(command_line, tmp_path, *ask, "24", "-o", name).err
        counts[name] = len(read_splats(tmp_path / name))
        assert told.splitlines()[-1].endswith(
            " in the 12 views that chose the count; requested: 24.00 dB"
        )
    assert counts["b.splat"] > counts["b.ply"]
    code, _, told = command_line(*ask, "90", "-o", "c.splat", cwd=tmp_path)
    assert code == 3
    assert "no smaller count was found that keeps the quality; keeping all 800 Gaussians" in told
    assert ".splat cannot store more" in told.splitlines()[-1]


BALL = checkered_ball(400)


@pytest.mark.parametrize(
    ("name", "value"), [("ratio", [5, 10]), ("count", (9, 8)), ("min_psnr", "high")]
)
def test_a_budget_is_one_number(name: str, value: object) -> None:
    words = f"{name}: expected " + (
        "a number or none, got 'high'" if value == "high" else "one value, got "
    )
    with pytest.raises(InputError, match=f"^{words}"):
        g2ard.distill(BALL, **{name: value})  # type: ignore[arg-type]


def test_several_budgets_equal_single_runs(command_line: CommandLine, folder: Path) -> None:
    several = (
        "simplify",
        "ball.ply",
        "-r",
        "4,5",
        "-r",
        10,
        "-o",
        "s_{ratio}x_{count}.ply",
        "--json",
        "-",
    )
    out = succeeds(command_line, folder, *several).out
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [100, 80, 40]
    for ratio, count in ((4, 100), (5, 80), (10, 40)):
        command_line("simplify", "ball.ply", "-r", ratio, "-o", f"one_{ratio}.ply", cwd=folder)
        one = (folder / f"one_{ratio}.ply").read_bytes()
        assert (folder / f"s_{ratio}x_{count}.ply").read_bytes() == one


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("1,000", [1000]),
        ("1_100", [1100]),
        ("300", [300]),
        ("0.2k,10%", [200, 120]),
        ("200,100", [200, 100]),
    ],
)
def test_counts_take_separators(text: str, counts: list[int]) -> None:
    assert [count.budget().of(1200) for count in Counts.parse(text)] == counts


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("9.000", "write 9000 or 9_000"),
        ("1.234.567", "write 1234567 or 1_234_567"),
        ("9.0", "expected a whole number"),
        ("0.500", "expected a whole number"),
        ("5,000,4,000", "5_000,4_000 or 5k,4k"),
        ("5,000,10k", "5_000,4_000 or 5k,4k"),
    ],
)
def test_counts_that_could_be_others_are_refused(text: str, words: str) -> None:
    with pytest.raises(Exception, match=r"expected|dots|commas") as refusal:
        Counts.parse(text)
    assert words in str(refusal.value)
    assert Count.parse("1.500M").value == 1_500_000
