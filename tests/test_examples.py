"""The examples run as they stand."""

import runpy

from helpers.project import ROOT

EXAMPLES = ROOT / "examples"


def test_from_python() -> None:
    before, after = runpy.run_path(str(EXAMPLES / "02_from_python.py"))["main"]()
    assert after > before + 1
