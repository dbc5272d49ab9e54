"""Runs on different numbers of threads."""

from collections.abc import Callable
from typing import TypeVar

import g2ard._core as _core

T = TypeVar("T")


def on_threads(run: Callable[[], T], counts: tuple[int, ...] = (1, 2, 8)) -> list[T]:
    """Return what a function returns on each number of threads."""
    before = _core.num_threads()
    results = []
    try:
        for count in counts:
            _core.set_num_threads(count)
            results.append(run())
    finally:
        _core.set_num_threads(before)
    return results
