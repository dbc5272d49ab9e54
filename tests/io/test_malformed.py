"""Over fifty malformed files for each reader: each is read as data that make sense, or ends in one line."""

import re
from pathlib import Path

import pytest

from fuzz_readers import read_checked
from helpers.malformations import malformed
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
