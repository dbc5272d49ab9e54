"""Where real data is, and what tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DATA = Path(os.environ.get("G2ARD_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real scenes; a test that needs it is skipped where there is none."""
    if not _DATA.is_dir():
        pytest.skip(f"no real data at {_DATA} (set G2ARD_DATA)")
    return _DATA
