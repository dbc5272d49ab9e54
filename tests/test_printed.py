"""Pages show what the program prints; `make printed` also runs their slow commands."""

from pathlib import Path

import pytest

import g2ard
import printed
from helpers import notebooks
from helpers.project import ROOT

PASSAGES = [passage for page in printed.pages() for passage in printed.passages(page)]


def test_pages_print_what_the_program_prints() -> None:
    """Runs the quick commands; `make printed` runs all."""
    assert PASSAGES
    for passage in PASSAGES:
        if not (passage.slow or passage.missing):
            assert passage.renewed(printed.printed_by(passage.commands))[1] == [], passage.page


def test_every_table_of_scores_names_its_command() -> None:
    """A block with the table of `distill` stands below a comment, so that it can be recorded anew."""
    marked = "".join(passage.text for passage in PASSAGES)
    for page in printed.pages():
        for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
            if line.startswith("│") and "→" in line:
                assert line in marked, f"{page}: {line}"


BLOCK = "```\nmade 20,000 of 90,854 in 3.1 s\n┃ view ┃\n│ 0110.jpg 28.24 │\n```"


@pytest.mark.parametrize(
    ("told", "differences"),
    [
        ("warmed up\nmade 20,000 of 90,854 in 9 s\n┃ view  ┃\n│ 0093.jpg 28.31 │", 0),
        ("made 20,001 of 90,854 in 3.1 s\n┃ view ┃\n│ 0110.jpg 28.24 │", 1),
        ("made 20,000 of 90,854 in 3.1 s\n┃ view ┃\n│ 0110.jpg 29.24 │", 1),
        ("made 20,000 from 90,854 in 3.1 s\n┃ view ┃\n│ 0110.jpg 28.24 │", 1),
    ],
)
def test_lines_and_figures_that_differ_are_found(told: str, differences: int) -> None:
    text, wrong = printed.Passage("a.md", "", False, BLOCK).renewed(told)
    assert len(wrong) == differences
    if "from" not in told:
        assert text.splitlines()[1:-1] == told.splitlines()[-3:]


def test_figures_of_a_sentence_are_found_and_renewed() -> None:
    sentence = printed.Passage(
        "a.md", "", False, "*fox* rises from 15.37 to 31.29 dB with 20,000 in 24 s.\n"
    )
    assert sentence.renewed("43 photos → 20,000\n15.37 → 27.54 dB\n15.41 → 31.20 dB") == (
        "*fox* rises from 15.41 to 31.20 dB with 20,000 in 24 s.\n",
        [],
    )
    assert len(sentence.renewed("43 photos → 30,000\n15.41 → 32.20 dB")[1]) == 2


def test_the_notebook_runs_without_its_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small ball prints the same lines with other figures."""
    notebook = notebooks.read()
    first = notebooks.code_of(notebook)[0]
    first["source"] = "".join(first["source"]).replace("20_000", "600")
    for variable in ("G2ARD_SCENE", "G2ARD_DATA"):
        monkeypatch.delenv(variable, raising=False)
    distill = g2ard.distill
    few = {"settings": {"focus": "far"}, "steps": 5, "size": 48}
    monkeypatch.setattr(
        g2ard, "distill", lambda *given, **named: distill(*given, **{**named, **few})
    )
    outputs = notebooks.execute(notebook, names := {}, tmp_path)
    assert len(names["result"].splats) == 60
    for cell, found in zip(notebooks.code_of(notebook), outputs, strict=True):
        lines = [printed._shape(line) for line in notebooks.text_of(cell["outputs"])]
        assert [printed._shape(line) for line in notebooks.text_of(found)] == lines


def test_the_notebook_holds_all_its_outputs() -> None:
    cells = notebooks.code_of(notebooks.read())
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)]
    assert all(cell["outputs"] for cell in cells)
    assert notebooks.QUICKSTART.stat().st_size < 100_000
