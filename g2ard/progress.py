"""One way to report progress: a callback. Only the command line draws bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol


class Progress(Protocol):
    """Called with the stage's name, units done, units in all (0 if unknown) and figures worth showing."""

    def __call__(self, stage: str, done: int, total: int, info: Mapping[str, Any] = ...) -> None: ...


def silent(stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
    """Report nothing."""


def counter(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """The `(done, total)` callback that Rust kernels take, bound to one stage.

    >>> seen = []
    >>> tell = counter(lambda *a: seen.append(a), "simplify")
    >>> tell(3, 10)
    >>> seen
    [('simplify', 3, 10)]
    """
    return lambda done, total: progress(stage, done, total)


Say = Callable[[str], None]
"""Called with a line of status: what was noticed in the data, what was decided and why."""


def unsaid(text: str) -> None:
    """Say nothing."""


def plural(count: int, one: str, many: str | None = None) -> str:
    """A count with its noun.

    >>> plural(1, "row"), plural(1234, "row"), plural(2, "vertex", "vertices")
    ('1 row', '1,234 rows', '2 vertices')
    """
    return f"{count:,} {one if count == 1 else many or one + 's'}"
