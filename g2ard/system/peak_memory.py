"""Peak memory of this process and its workers."""

_WORKERS: dict[int, int] = {}
"""Worker process ID → peak bytes."""


def peak_rss() -> int | None:
    """Return the peak resident memory in bytes, or None if the system does not report it (Windows).

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
    """Record a worker's `peak_rss`."""
    if peak is not None:
        _WORKERS[process] = max(peak, _WORKERS.get(process, 0))


def forget_workers() -> None:
    _WORKERS.clear()


def peak_rss_of_all() -> int | None:
    """Return the sum of the peaks of this process and its workers: an upper bound of their joint peak."""
    own = peak_rss()
    return None if own is None else own + sum(_WORKERS.values())
