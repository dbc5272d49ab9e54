"""No damaged file ends in a traceback: every reader answers with its data or with one line of InputError."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import kind, read_cloud, read_scene, read_view_set
from helpers.project import ROOT
from helpers.reader_cases import (
    MAKERS,
    READ,
)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes changed, a piece cut out or doubled, or the end cut off; the front half more often."""
    data = bytearray(content)
    at = int(len(data) * rng.random() ** 2)
    match rng.integers(4):
        case 0:
            for _ in range(rng.integers(1, 5)):
                data[int(len(data) * rng.random() ** 2)] = rng.integers(256)
        case 1:
            del data[at : at + rng.integers(1, 40)]
        case 2:
            data[at:at] = data[at : at + rng.integers(1, 40)]
        case _:
            del data[at:]
    return bytes(data)


def attempt(path: Path) -> str | None:
    """Read a file; the error line, if there is one."""
    try:
        {"splats": read_scene, "points": read_cloud, "views": read_view_set}[kind(path)](path)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_damage_is_an_input_error_at_worst(tmp_path: Path, what: str) -> None:
    path = MAKERS[what](tmp_path)
    content = path.read_bytes()
    asked = tmp_path / READ[what] if what in READ else path
    assert attempt(asked) is None
    rng = np.random.default_rng(sum(map(ord, what)))
    refused = 0
    for _ in range(150):
        path.write_bytes(damaged(content, rng))
        line = attempt(asked)
        refused += line is not None
        assert line is None or ("\n" not in line and str(tmp_path) in line)
    assert refused > 20


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_readers_keep_their_word_on_mutated_files(tmp_path: Path, what: str) -> None:
    from fuzz_readers import fuzz

    tally = fuzz(what, MAKERS[what], tmp_path, runs=40, seed=0)
    assert set(tally) <= {"read", "refused"}, tally


ONCE_BROKEN = sorted((ROOT / "tests" / "fuzz_corpus").iterdir())
"""Files that a reader once answered otherwise, as CASE--WHAT."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("file", ONCE_BROKEN, ids=lambda file: file.name)
def test_files_that_once_broke_a_reader_end_in_one_line(tmp_path: Path, file: Path) -> None:
    what = file.name.partition("--")[0]
    path = MAKERS[what](tmp_path)
    path.write_bytes(file.read_bytes())
    line = attempt(tmp_path / READ[what] if what in READ else path)
    assert line is not None
    assert "\n" not in line
    assert str(tmp_path) in line
