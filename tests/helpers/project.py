"""The repository's folder, and processes that run its sources."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def environment(**more: str) -> dict[str, str]:
    """Return the variables of a process that runs these sources, where numpy's warnings are errors."""
    paths = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    warned = {"PYTHONWARNINGS": "ignore,error::RuntimeWarning"}
    return {**os.environ, **warned, "PYTHONPATH": os.pathsep.join(paths), **more}
