"""The slice of the golden record that `make test` compares; see `goldens.py`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the runner forks")
def test_commands_write_what_the_record_says() -> None:
    runner = Path(__file__).with_name("goldens.py")
    words = [sys.executable, str(runner), "compare", "--slice", "--jobs", "1"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
