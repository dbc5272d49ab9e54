"""No damaged file ends in a traceback: readers answer with sound data or one line of InputError."""

import re
from pathlib import Path

import pytest

from fuzz_readers import fuzz, read_checked
from helpers.malformations import malformed
from helpers.project import ROOT
from helpers.reader_cases import MAKERS, READ


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_malformed_files_end_in_one_line_that_names_them(tmp_path: Path, what: str) -> None:
    path = MAKERS[what](tmp_path)
    asked = tmp_path / READ[what] if what in READ else path
    content = path.read_bytes()
    files = {data: how for how, data in malformed(content) if data != content}
    refused = 0
    for data, how in files.items():
        path.write_bytes(data)
        try:
            line = read_checked(asked)
        except Exception as error:
            raise AssertionError(f"{how}: {error!r}") from error
        refused += line is not None
        assert line is None or ("\n" not in line and str(tmp_path) in line), how
    assert refused >= 50, f"{refused} of {len(files)}"


NAMED = ["transforms", "cameras.json", "views", "ns-export", "meta.json", "lod-meta.json"]


@pytest.mark.parametrize("what", NAMED)
def test_a_property_of_another_kind_is_named(tmp_path: Path, what: str) -> None:
    """If a property becomes the word x, the error names the property, its holder or x."""
    path = MAKERS[what](tmp_path)
    for how, data in malformed(path.read_bytes()):
        name, is_word, _ = how.partition(" is 'x'")
        if not is_word:
            continue
        path.write_bytes(data)
        line = read_checked(path)
        keys = [key.removesuffix("s") for key in name.split(".") if not key.isdigit()]
        told = (line or "").replace(str(tmp_path), "")
        named = any(key in told for key in keys) or re.search(r"\bx\b", told)
        assert line is None or not keys or named, f"{how}: {line}"


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
    line = read_checked(tmp_path / READ[what] if what in READ else path)
    assert line is not None
    assert "\n" not in line
    assert str(tmp_path) in line
