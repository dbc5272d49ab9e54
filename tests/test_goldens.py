"""The slice of the golden record that `make test` compares; see `goldens.py`."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import goldens

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the runner forks")


def runner(*words: object) -> subprocess.CompletedProcess[str]:
    asked = [sys.executable, goldens.__file__, *map(str, words), "--jobs", "1"]
    return subprocess.run(asked, capture_output=True, text=True)


def test_commands_write_what_the_record_says() -> None:
    done = runner("compare", "--slice")
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    if goldens.ELSEWHERE in done.stdout:
        pytest.skip(f"the golden record is of another machine: {goldens.COMPARED}")


def test_a_record_made_here_is_compared_whole(tmp_path: Path) -> None:
    record = tmp_path / "here.json"
    poses = ("--only", "^poses/kinds$")
    assert runner("record", *poses, "--to", record).returncode == 0
    same = runner("compare", *poses, "--with", record)
    assert (same.returncode, goldens.ELSEWHERE in same.stdout) == (0, False), same.stdout
    known = json.loads(record.read_text())
    known["cases"]["poses/kinds"]["files"]["cameras.json"] = "another"
    record.write_text(json.dumps(known))
    changed = runner("compare", *poses, "--with", record)
    assert changed.returncode == 1
    assert changed.stdout.splitlines()[-1] == "poses/kinds: cameras.json"
    other = runner("compare", *poses, "--with", record, "--isa", "portable")
    assert (other.returncode, goldens.ELSEWHERE in other.stdout) == (0, True), other.stdout


LINE: goldens.Found = {
    "status": [1],
    "errors": ["g2ard: 3 views lost"],
    "out": "o",
    "err": "e",
    "keys": "k",
    "files": {"a": "1", "b-0123456789abcdef.npz": "2"},
    "again": ["same"],
}


@pytest.mark.parametrize(
    ("change", "anywhere"),
    [
        ({}, None),
        ({"status": [0]}, True),
        ({"keys": "other"}, True),
        ({"files": {}}, True),
        ({"files": {"a": "1"}}, True),
        ({"files": LINE["files"] | {"c": "3"}}, True),
        ({"again": ["killed after 1 of 2 files"]}, True),
        ({"files": LINE["files"] | {"a": "2"}}, False),
        ({"files": {"a": "1", "b-fedcba9876543210.npz": "2"}}, False),
        ({"out": "other"}, False),
        ({"err": "other"}, False),
        ({"errors": ["g2ard: 4 views lost"]}, False),
    ],
)
def test_what_depends_on_a_processor_counts_on_the_same_alone(
    change: dict[str, Any], anywhere: bool | None
) -> None:
    there, here = (
        bool(goldens.differences(LINE, LINE | change, elsewhere)) for elsewhere in (True, False)
    )
    assert (there, here) == (anywhere or False, anywhere is not None)


def test_a_failure_is_recorded_only_where_one_is_expected() -> None:
    misspelt = LINE | {"status": [2], "errors": ["g2ard simplify: No such option: --no-pages"]}
    assert not goldens.refusals({"a": LINE | {"status": [0, 0], "errors": []}, "errors/a": LINE})
    assert len(goldens.refusals({"simplify/a": LINE})) == 1
    assert len(goldens.refusals({"errors/a": misspelt})) == 1
    assert not goldens.refusals(json.loads(goldens.RECORD.read_text(encoding="utf-8"))["cases"])


def test_keys_are_those_outside_lists() -> None:
    text = '{"b": {"c": 1, "a": [{"d": 2}]}, "a": null}'
    assert list(goldens.keys(text, "f")) == ["f.a", "f.b", "f.b.a", "f.b.c"]
    assert not list(goldens.keys("no JSON"))
