"""Memory of this process, and of its workers."""

from __future__ import annotations

_WORKERS: dict[int, int] = {}
"""Worker processes → their peaks, in bytes."""


def peak_rss() -> int | None:
    """The most bytes of memory that were resident so far; None where the system does not tell (Windows).

    >>> peak_rss() is None or peak_rss() > 1_000_000
    True
    """
    import sys

    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def note_worker(process: int, peak: int | None) -> None:
    """Note what `peak_rss` says in a worker."""
    if peak is not None:
        _WORKERS[process] = max(peak, _WORKERS.get(process, 0))


def forget_workers() -> None:
    """Those of another run."""
    _WORKERS.clear()


def peak_rss_of_all() -> int | None:
    """The peaks of this process and of each worker here, summed: no less than they held at once."""
    own = peak_rss()
    return None if own is None else own + sum(_WORKERS.values())
