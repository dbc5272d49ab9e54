"""Progress and status callbacks, and helpers for messages."""

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol


class Progress(Protocol):
    """Callback with the stage's name, units done, total units (0 if unknown) and figures to show."""

    def __call__(
        self, stage: str, done: int, total: int, info: Mapping[str, Any] = ...
    ) -> None: ...


def silent(stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
    """Report nothing."""


_WIDTH = 60
"""Characters of the line that `show_progress` redraws."""
_BAR = 20
"""Characters of its bar in a notebook."""


class _Line:
    """The line that `show_progress` redraws, and when its stage began."""

    def __init__(self) -> None:
        self.stage = ""
        self.began = 0.0
        self.drawn = 0.0
        # of a notebook: number, and handle of the line in it
        self.cell: tuple[int, Any] | None = None

    def show(self, text: str, shell: Any) -> None:
        """Redraw the line: by its handle in the cell of a notebook, otherwise on stderr."""
        if shell is None:
            print(f"\r{text:{_WIDTH}.{_WIDTH}}", end="", file=sys.stderr, flush=True)
            return
        from IPython.display import display

        content = {"text/plain": text}
        if self.cell is None or self.cell[0] != shell.execution_count:
            self.cell = shell.execution_count, display(content, raw=True, display_id=True)
        else:
            self.cell[1].update(content, raw=True)


_line = _Line()


def show_progress(stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
    """Show the stage in one line that is redrawn, on stderr or, with a bar, in the cell of a notebook.

    Pass it to any function of g2ard that takes `progress`.

    Args:
        stage: name of the stage.
        done: units done.
        total: all units; 0 if unknown.
        info: further figures, not shown.

    >>> import g2ard
    >>> small = g2ard.distill("scene.ply", ratio=10, progress=g2ard.show_progress)  # doctest: +SKIP
    """
    now = time.monotonic()
    ended = 0 < total <= done
    shell = kernel()
    if shell is None and sys.stderr is None:  # a program without a console
        return
    terminal = getattr(sys.stderr, "isatty", bool)()
    if stage != _line.stage:
        _line.stage = stage
        _line.began = now
        _line.drawn = 0.0
    if ended and shell is None:
        print(f"\r{'':{_WIDTH}}\r", end="", file=sys.stderr, flush=True)
    elif ended or now - _line.drawn >= (0.1 if terminal else 1):
        _line.drawn = now
        text = f"{stage}: {done:,}/{total:,}" if total > 1 else stage
        if shell is not None and total:
            filled = _BAR * done // total
            spent = now - _line.began
            left = (
                f"{spent * (total - done) / done:.0f} s left"
                if 0 < done < total
                else f"{spent:.1f} s"
            )
            text = f"{text} {'█' * filled}{'░' * (_BAR - filled)} {left}"
        _line.show(text, shell)


def kernel() -> Any:
    """Return the shell of a notebook's kernel, whose cells show HTML; None elsewhere."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell if getattr(shell, "kernel", None) is not None else None


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


class Detail(str):
    """A message that commands print with -v only."""


def unsaid(text: str) -> None:
    """Say nothing."""


def some(names: Sequence[Any], most: int = 3) -> str:
    """Return the first names or numbers, and … if there are more.

    >>> some([1, 2, 3]), some("abcd")
    ('1, 2, 3', 'a, b, c, …')
    """
    return ", ".join([*map(str, names[:most]), *(["…"] if len(names) > most else [])])


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
