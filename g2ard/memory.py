"""Memory of this process."""

from __future__ import annotations

__all__ = ["peak_rss"]


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
