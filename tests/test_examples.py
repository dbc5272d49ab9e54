"""The examples run as they stand."""

from __future__ import annotations

import runpy
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_from_python() -> None:
    before, after = runpy.run_path(str(EXAMPLES / "02_from_python.py"))["main"]()
    assert after > before + 1
