"""Tests that `machines.py` lists all traits of machines and hides each from the tests that depend on it."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import machines
from helpers.project import ROOT

SOURCES = [
    path
    for folder in ("g2ard", "tests", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if "node_modules" not in path.parts and path.stem not in ("machines", "test_machines")
]
TEXTS = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in SOURCES}
DEVELOPERS = {"jedi", "packaging", "pty", "pyte", "torch"}
"""Modules that are there wherever the tests run, or that only the system decides on."""
SWITCHES = {"G2ARD_REQUIRE_GPU", "G2ARD_SCENE", "G2ARD_COMPLETE", "G2ARD_NOWHERE"}
"""Variables that request something and describe no machine."""


def _found(pattern: str) -> Iterator[tuple[str, str]]:
    for name, text in TEXTS.items():
        for found in re.findall(pattern, text):
            yield name, found


def test_programs_that_are_looked_for_are_listed() -> None:
    hidden = {name for trait in machines.TRAITS.values() for name in trait.hide}
    looked_for = {*_found(r"""which\(["']([\w-]+)["']\)""")}
    assert len(looked_for) >= 4
    assert {(name, program) for name, program in looked_for if program not in hidden} == set()


def test_packages_that_tests_skip_without_are_listed() -> None:
    modules = {name.partition(".")[0] for name in machines.EXTRAS} | DEVELOPERS
    wanted = {(name, module) for name, module in _found(r"""importorskip\(["'](\w+)""")}
    assert len(wanted) >= 8
    assert {(name, module) for name, module in wanted if module not in modules} == set()


def test_variables_that_tell_of_a_machine_are_listed() -> None:
    known = {name for trait in machines.TRAITS.values() for name in trait.variables} | SWITCHES
    read = {(name, variable) for name, variable in _found(r"""\b(G2ARD_(?!TEST_)[A-Z_]+)""")}
    assert len(read) >= 8
    assert {(name, variable) for name, variable in read if variable not in known} == set()


@pytest.mark.parametrize(("pattern", "trait"), [("geteuid", "root"), ("umask", "umask")])
def test_tests_that_ask_who_they_are_run_as_another(pattern: str, trait: str) -> None:
    asking = {name for name, _ in _found(f"({pattern})") if name.startswith("tests/")}
    assert asking
    assert asking <= {*machines.slice_of(machines.TRAITS[trait])}


@pytest.mark.parametrize("name", machines.TRAITS)
def test_a_slice_exists(name: str) -> None:
    tests = machines.slice_of(machines.TRAITS[name])
    assert tests
    assert all((ROOT / re.split(r"::| ", test)[0]).is_file() for test in tests)


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
def test_what_is_hidden_is_not_found(tmp_path: Path) -> None:
    traits = [trait for trait in machines.TRAITS.values() if trait.hide or trait.modules]
    assert traits
    asking = """
import json, shutil, sys
from importlib.util import find_spec
programs, modules = json.loads(sys.argv[1])
found = [p for p in programs if shutil.which(p)], [m for m in modules if find_spec(m)]
print(json.dumps([*found, shutil.which("env")]))
"""
    programs = [name for trait in traits for name in trait.hide]
    modules = [name for trait in traits for name in trait.modules if "." not in name]
    done = subprocess.run(
        [sys.executable, "-c", asking, json.dumps([programs, modules])],
        env=machines.other_machine(traits, tmp_path),
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout)[:2] == [[], []]
    assert json.loads(done.stdout)[2], "other programs are still found"


def test_every_trait_is_tried_both_ways() -> None:
    script, makefile = (ROOT / name for name in (".ci/run", "Makefile"))
    assert "tests/machines.py each" in script.read_text(encoding="utf-8")
    assert "tests/machines.py without" in makefile.read_text(encoding="utf-8")
    assert {*machines.FRESH} <= machines.TRAITS.keys()
