"""Memory of a device's steps, in a process of its own because allocations of other tests would count."""

import subprocess
import sys

import pytest

from g2ard.system.peak_memory import peak_rss
from helpers.gpus import skip_without_gpu
from helpers.project import ROOT, environment

_PROGRAM = """
from g2ard.rendering.targets import TeacherRenders
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.system import devices
from g2ard.system.peak_memory import peak_rss
from helpers.scenes import around, checkered_ball

devices.use("gpu")
peaks = {}
recover(
    checkered_ball(40, seed=3),
    TeacherRenders(checkered_ball(90), around(7, (24, 18))),
    RecoverConfig(steps=1100),
    watch=lambda step, *_: peaks.update({step: peak_rss()}),
)
assert devices.state().served > 0
print(peaks[1100] - peaks[100])
"""


@pytest.mark.skipif(peak_rss() is None, reason="peak memory cannot be read on this system")
def test_steps_keep_no_memory() -> None:
    skip_without_gpu()
    program, tests = [sys.executable, "-c", _PROGRAM], ROOT / "tests"
    done = subprocess.run(
        program, cwd=tests, env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 32e6
