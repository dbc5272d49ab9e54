"""Signals that arrive where Python ignores exceptions."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PLACES = {
    "a finaliser": """
class Falls:
    def __del__(self): signal.raise_signal(number); time.sleep(0)
one = Falls(); del one
""",
    "a weak reference's callback": """
class Falls: pass
one = Falls(); held = weakref.ref(one, lambda _: (signal.raise_signal(number), time.sleep(0))); del one
""",
    "a collection of cycles": """
class Falls:
    def __del__(self): signal.raise_signal(number); time.sleep(0)
one = Falls(); one.me = one; del one; gc.collect()
""",
    "many finalisers": """
def late():
    class Falls:
        def __del__(self): signal.raise_signal(number); time.sleep(0)
    return [Falls() for _ in range(3)]
late()
""",
}


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("place", _PLACES)
def test_no_signal_is_lost(place: str, name: str) -> None:
    program = f"""
import gc, signal, time, weakref
from g2ard.system import interrupt
interrupt.ends_the_program()
number = signal.{name}
try:
    with interrupt.RaisesInterrupt():
        {_PLACES[place].strip().replace(chr(10), chr(10) + " " * 8)}
        for _ in range(1000): time.sleep(0.01)
        print("lost")
except KeyboardInterrupt:
    print("stopped")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert (done.stdout, done.stderr) == ("stopped\n", "")
