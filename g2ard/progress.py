"""Progress and status callbacks, and helpers for messages."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol


class Progress(Protocol):
    """Callback with the stage's name, units done, total units (0 if unknown) and figures to show."""

    def __call__(self, stage: str, done: int, total: int, info: Mapping[str, Any] = ...) -> None: ...


def silent(stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
    """Report nothing."""


def counter(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """Return the `(done, total)` callback that Rust kernels take, for one stage.

    >>> seen = []
    >>> tell = counter(lambda *a: seen.append(a), "simplify")
    >>> tell(3, 10)
    >>> seen
    [('simplify', 3, 10)]
    """
    return lambda done, total: progress(stage, done, total)


Say = Callable[[str], None]
"""Callback with a line of status, such as a warning or a decision and its reason."""


def unsaid(text: str) -> None:
    """Say nothing."""


def plural(count: int, one: str, many: str | None = None) -> str:
    """Format a count with its noun.

    >>> plural(1, "row"), plural(1234, "row"), plural(2, "vertex", "vertices")
    ('1 row', '1,234 rows', '2 vertices')
    """
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def direction(axis: Iterable[float]) -> str:
    """Format a direction as options take it.

    >>> direction([-0.0, -0.9999, -0.001])
    '0,-1,0'
    """
    return ",".join(f"{round(float(value), 2) + 0.0:g}" for value in axis)
