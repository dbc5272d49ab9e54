"""No damaged file ends in a traceback: every reader answers with its data or with one line of InputError."""

from pathlib import Path

import pytest

from fuzz_readers import fuzz
from g2ard.errors import InputError
from g2ard.io import kind, read_cloud, read_scene, read_view_set
from helpers.project import ROOT
from helpers.reader_cases import MAKERS, READ


def attempt(path: Path) -> str | None:
    """Read a file; return the error line, if any."""
    try:
        {"splats": read_scene, "points": read_cloud, "views": read_view_set}[kind(path)](path)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_mutated_files_give_sound_data_or_one_error_line(tmp_path: Path, what: str) -> None:
    tally = fuzz(what, MAKERS[what], tmp_path, runs=100, seed=0)
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
