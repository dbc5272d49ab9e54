"""Kernels in a forked child, which inherits no thread of its parent."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.project import ROOT, environment

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="systems without fork")

_SCRIPT = """
import os, signal, sys, threading, warnings
warnings.simplefilter("ignore")
sys.path.insert(0, sys.argv[2])
from helpers.forked import digests, gpu_digest

def in_child(work, *wanted):
    child = os.fork()
    if child == 0:
        signal.alarm(100)  # ends a child that hangs
        try:
            os._exit(0 if work() in wanted else 7)
        except BaseException as error:
            print(type(error).__name__, error, file=sys.stderr, flush=True)
            os._exit(8)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status:
        sys.exit(f"the child ended with {status}")

import g2ard._core as _core
"""

_CASES = {
    "a child of a child": """
here = digests()
def deeper():
    in_child(digests, here)
    return digests()
in_child(deeper, here)
""",
    "a number of threads": """
_core.set_num_threads(3)
digests()
in_child(_core.num_threads, 3)
def others():
    _core.set_num_threads(2)
    digests()
    _core.set_num_threads(5)
    digests()
    return _core.num_threads()
in_child(others, 5)
""",
    "while a kernel runs": """
here = digests()
busy = threading.Thread(target=lambda: [digests() for _ in range(3)], daemon=True)
busy.start()
for _ in range(3):
    in_child(digests, here)
busy.join()
""",
    "with a device": """
cpu = gpu_digest()
if _core.adapters():
    _core.set_device("gpu")
    gpu_digest()
    assert _core.device_state()["adapter"], _core.device_notes()
    def answered():
        got = gpu_digest()
        notes = _core.device_notes()
        assert len(notes) == 1 and "spawn" in notes[0], notes
        assert _core.device_state()["adapter"] is None
        _core.set_device("cpu")
        return got
    in_child(answered, cpu)
""",
    "with a scene on a device": """
from helpers.forked import image_digest, renderer_of_a_ball
cpu = image_digest(renderer_of_a_ball())
if _core.adapters():
    _core.set_device("gpu")
    held = [renderer_of_a_ball()]
    gpu = image_digest(held[0])
    assert _core.device_state()["served"] == 1, _core.device_notes()
    def answered():
        got = image_digest(held[0])
        notes = _core.device_notes()
        assert len(notes) == 1 and "spawn" in notes[0], notes
        held.clear()
        return got
    in_child(answered, cpu)
    assert image_digest(held[0]) == gpu
""",
}


@pytest.mark.parametrize("case", _CASES)
def test_kernels_work_in_forked_children(case: str, tmp_path: Path) -> None:
    script = tmp_path / "forks.py"
    script.write_text(_SCRIPT + _CASES[case] + "print('done')\n")
    command = [sys.executable, str(script), str(ROOT), str(ROOT / "tests")]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
    assert done.stdout == "done\n", done.stderr
    assert done.returncode == 0
