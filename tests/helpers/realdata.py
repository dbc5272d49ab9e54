"""Real scenes for tests that can use them: $G2ARD_DATA, else ../shared/data beside the repository."""

import os
from pathlib import Path

import pytest

from helpers import project

ROOT = Path(os.environ.get("G2ARD_DATA", project.ROOT.parent / "shared" / "data"))


def real(*parts: str) -> Path:
    """Return the path of a real file or folder; skip the test if it is missing."""
    path = ROOT.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"no real data at {path} (set G2ARD_DATA)")
    return path
