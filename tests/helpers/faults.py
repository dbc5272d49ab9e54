"""Checks of what an `InputError` names, and errors injected into commands."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import pytest

from g2ard.errors import InputError

Fault = tuple[str | None, int | None] | str
"""The property and index that an error must name, or words that its message must hold."""

INJECTED = "injected fault"
_STAGES = tuple(
    f"g2ard.{name}"
    for name in (
        "io.",
        "jobs.",
        "levels.",
        "pipeline.",
        "rendering.",
        "report.",
        "stages.",
        "viewer.",
    )
)
"""Packages whose functions are stages of a command."""


def check_fault(error: InputError, path: Path, fault: Fault) -> None:
    """Check that an error is one line that names a file, and in it a property and an index."""
    assert error.path == path, error
    assert "\n" not in str(error)
    if isinstance(fault, str):
        assert re.search(fault, str(error)), error
    else:
        assert (error.property, error.index) == fault, error


@contextmanager
def faulty(path: Path, fault: Fault) -> Iterator[None]:
    """Expect an `InputError` that names a file, and in it a property and an index."""
    with pytest.raises(InputError) as caught:
        yield
    check_fault(caught.value, path, fault)


@contextmanager
def stages_after(output: Path, failing: str | None = None) -> Iterator[list[str]]:
    """Collect the functions of other packages that the command line calls once `output` exists.

    Args:
        failing: the function whose first call raises an `InputError`; None lets all pass.
    """
    stages: list[str] = []

    def watch(frame: FrameType, event: str, _: object) -> None:
        caller, name = frame.f_back, frame.f_code.co_qualname
        if event != "call" or caller is None or name.startswith(("_", "<")) or "._" in name:
            return
        module, by = (str(f.f_globals.get("__name__")) for f in (frame, caller))
        if not by.startswith("g2ard.cli") or not module.startswith(_STAGES):
            return
        stage = f"{module}.{name}"
        if stage not in stages:
            stages.append(stage)
            if stage == failing:
                raise InputError(INJECTED)

    def placing(function: Callable[..., object]) -> Callable[..., object]:
        """Watch from when `output` exists: a watched program is several times slower."""

        def placed(*given: Any, **named: Any) -> object:
            try:
                return function(*given, **named)
            finally:
                if output.exists():
                    sys.setprofile(watch)

        return placed

    names = ("replace", "rename", "link", "mkdir")
    with patch.multiple("os", **{name: placing(getattr(os, name)) for name in names}):
        try:
            yield stages
        finally:
            sys.setprofile(None)
