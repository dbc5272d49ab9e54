"""No damaged file ends in a traceback: readers answer with sound data or one line of InputError."""

import gzip
import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from fuzz_readers import fuzz, read_checked
from helpers.malformations import malformed
from helpers.project import ROOT
from helpers.reader_cases import MAKERS, READ

NAMED = ["transforms", "cameras.json", "views", "ns-export", "meta.json", "lod-meta.json"]
"""Files of JSON: if a property becomes the word x, the error names the property, its holder or x."""


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
        name, is_word, _ = how.partition(" is 'x'")
        keys = [key.removesuffix("s") for key in name.split(".") if not key.isdigit()]
        if line is not None and is_word and keys and what in NAMED:
            told = line.replace(str(tmp_path), "")
            assert any(key in told for key in keys) or re.search(r"\bx\b", told), f"{how}: {line}"
    assert refused >= 40, f"{refused} of {len(files)}"


def packed(head: bytes) -> bytes:
    """Return an .spz of version 3 that begins like this."""
    return gzip.compress(head + bytes(200))


PLY = b"ply\nformat ascii 1.0\n"
DAMAGES: list[tuple[str, Callable[[bytes], bytes], str]] = [
    ("ksplat", lambda data: data[:100], "cut off within its header"),
    ("ksplat", lambda data: data[:4200], "cut off within the headers of 1 sections"),
    ("ksplat", lambda data: data[:-1], "section 0 is cut off"),
    ("ksplat", lambda data: b"\1" + data[1:], "unsupported version 1.1"),
    ("ksplat", lambda data: data[:20] + b"\7" + data[21:], "unsupported compression level 7"),
    ("ksplat", lambda data: data[:4136] + b"\4" + data[4137:], "section 0 .*SH degree 4"),
    ("ksplat", lambda data: data[:4128] + b"\xff" + data[4129:], "section 0 has inconsistent buckets"),
    ("ksplat", lambda data: data[:5120] + bytes(4) + data[5124:], "section 0 has more rows"),
    ("glb", lambda data: data[:10], "not a .glb"),
    ("glb", lambda data: data[: len(data) // 2], "truncated|broken"),
    ("glb", lambda data: data.replace(b'"ellipse"', b'"boxes!!"'), "kernel"),
    ("glb", lambda data: data.replace(b"splatting:SCALE", b"splatting:SCALY"), "SCALE.* is missing"),
    (
        "glb",
        lambda data: data.replace(b'"count":9,', b'"count":99,', 1).replace(b"g2ard", b"g2ar"),
        "truncated",
    ),
    ("spz 3", lambda data: packed(b"NOPE"), "not an SPZ"),
    ("spz 3", lambda data: b"", "not an SPZ"),
    ("spz 3", lambda data: packed(b"NGSP" + struct.pack("<IIBBBB", 9, 1, 0, 12, 0, 0)), "version 9"),
    *(("splat", lambda data, size=size: bytes(size), "multiple of 32") for size in (0, 33)),
    ("sog", lambda data: b"PK\x03\x04nonsense", "not a complete .sog archive"),
    ("poses_bounds.npy", lambda data: b"no array", "not a NumPy array"),
    *(
        (what, lambda data, keep=keep: data[:keep], "cannot be read as LAS|truncated|broken")
        for what in ("las", "laz")
        for keep in (0, 20, 300, -30)
    ),
    ("scene", lambda data: b"", "is empty"),
    ("scene", lambda data: b"PK\x03\x04 a zip", "an archive"),
    ("scene", lambda data: b"plywood\n", "not a PLY"),
    ("scene", lambda data: PLY + b"element vertex 3\n", "end_header"),
    ("scene", lambda data: PLY + b"element vertex many\nend_header\n", "line 3"),
    ("scene", lambda data: PLY + b"property float x\nend_header\n", "line 3"),
    ("scene", lambda data: PLY + b"element face 0\nend_header\n", "no 'vertex' element"),
]


@pytest.mark.parametrize(("what", "damage", "words"), DAMAGES)
def test_damage_is_named(tmp_path: Path, what: str, damage: Callable[[bytes], bytes], words: str) -> None:
    path = MAKERS[what](tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    line = read_checked(path)
    assert line is not None
    assert path.name in line
    assert re.search(words, line)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_mutated_files_give_sound_data_or_one_error_line(tmp_path: Path, what: str) -> None:
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
    line = read_checked(tmp_path / READ[what] if what in READ else path)
    assert line is not None
    assert "\n" not in line
    assert str(tmp_path) in line
