"""Budgets on the command line: counts, ratios, and several in one call."""

import json
from pathlib import Path

import pytest

import g2ard
from g2ard.cli.budget_options import Count, Counts
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import checkered_ball


def test_several_budgets_equal_single_runs(command_line: CommandLine, folder: Path) -> None:
    several = ("simplify", "ball.ply", "-r", "4,5", "-r", 10, "-o", "s_{ratio}x_{count}.ply", "--json", "-")
    out = succeeds(command_line, folder, *several).out
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [100, 80, 40]
    for ratio, count in ((4, 100), (5, 80), (10, 40)):
        command_line("simplify", "ball.ply", "-r", ratio, "-o", f"one_{ratio}.ply", cwd=folder)
        one = (folder / f"one_{ratio}.ply").read_bytes()
        assert (folder / f"s_{ratio}x_{count}.ply").read_bytes() == one


@pytest.mark.parametrize(
    ("text", "counts"),
    [("1,000", [1000]), ("1_100", [1100]), ("300", [300]), ("0.2k,10%", [200, 120]), ("200,100", [200, 100])],
)
def test_counts_take_separators(text: str, counts: list[int]) -> None:
    assert [count.budget().of(1200) for count in Counts.parse(text)] == counts


def test_a_count_may_have_commas(command_line: CommandLine, folder: Path) -> None:
    g2ard.save(folder / "larger.ply", checkered_ball(1200))
    assert (
        "1,000 of 1,200 Gaussians"
        in succeeds(command_line, folder, "simplify", "larger.ply", "-n", "1,000", "-o", "s.ply").err
    )


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


def test_budgets_that_share_an_output_are_rejected(command_line: CommandLine, folder: Path) -> None:
    ask = ("simplify", "ball.ply", "--json", "-")
    for budgets, name in (("20,20", "{ratio}"), ("20,20", "{count}"), ("20,20.01", "{count}")):
        error = refused(command_line, folder, *ask, "-r", budgets, "-o", name)
        assert "given twice" in error or "the same output" in error
    assert "poses" not in error


@pytest.mark.parametrize("budgets", [("-r", "4,5"), ("-n", "9,20"), ("-r", "4", "-r", "5"), ("-n", "5,4")])
def test_distill_takes_one_budget(budgets: tuple[str, ...], command_line: CommandLine, folder: Path) -> None:
    assert "give one budget" in refused(command_line, folder, "distill", "ball.ply", *budgets, "-o", "run")
