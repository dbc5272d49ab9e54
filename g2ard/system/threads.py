"""Python work on several threads, beside kernels that leave some of them idle."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_MOST = 4
"""Most items at a time: each may hold a few images."""


def threads_used() -> int:
    """Return the number of threads of `in_threads`."""
    import g2ard._core as _core

    return min(_core.num_threads(), _MOST)


def in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Call a function for every item, on at most four threads, and yield the results in order.

    It pays for functions that release the GIL: kernels, and numpy on large arrays. With one kernel thread it
    is `map`.

    >>> list(in_threads(str, range(3)))
    ['0', '1', '2']
    """
    threads = threads_used()
    if threads == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(threads)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
