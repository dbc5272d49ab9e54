"""Status on stderr: progress bars on a terminal, plain lines elsewhere, nothing with --quiet."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_PLAIN_PERIOD = 10.0
"""Seconds between progress lines of a stage when stderr is not a terminal."""


def duration(seconds: float) -> str:
    """Format a duration.

    >>> duration(3.14159), duration(75), duration(4000)
    ('3.1 s', '1 min 15 s', '1 h 06 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
    return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"


class Console:
    """Progress callback (see `g2ard.progress`) that draws bars."""

    def __init__(self, *, quiet: bool = False) -> None:
        self.quiet = quiet
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._plain: dict[str, tuple[float, float]] = {}  # stage → (began, last line)
        self._done: dict[str, int] = {}

    def say(self, text: str) -> None:
        if self.quiet:
            return
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def error(self, text: str) -> None:
        self.close()
        print(f"g2ard: {text}", file=sys.stderr, flush=True)

    def table(self, title: str, columns: list[str], rows: list[list[str]], *, stdout: bool = False) -> None:
        """Print a table; columns with a header are right-aligned, except the first."""
        if self.quiet:
            return
        self.close()
        from rich.console import Console as Rich
        from rich.table import Table

        table = Table(title=title, title_justify="left", show_header=any(columns))
        for i, name in enumerate(columns):
            table.add_column(name, justify="right" if i and name else "left")
        for row in rows:
            table.add_row(*row)
        stream = sys.stdout if stdout else sys.stderr
        Rich(file=stream, width=None if stream.isatty() else 120).print(table, markup=False, highlight=False)

    def __call__(self, stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
        """Show the progress of a stage, with the figures of `info`."""
        if self.quiet:
            return
        figures = "  ".join(f"{k} {v}" for k, v in (info or {}).items())
        if done < self._done.get(stage, 0):  # the next part of a job runs this stage anew
            self._plain.pop(stage, None)
            if self._bars is not None and stage in self._tasks:
                self._bars.reset(self._tasks[stage])
        self._done[stage] = done
        if sys.stderr.isatty():
            self._draw(stage, done, total, figures)
        else:
            self._print(stage, done, total, figures)

    def _draw(self, stage: str, done: int, total: int, figures: str) -> None:
        if self._bars is None:
            from rich.console import Console as Rich
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.table import Column

            def whole() -> Column:
                return Column(min_width=len("0:00:00"))  # narrow windows cut the figures instead

            self._bars = Progress(
                TextColumn("{task.description:<12}"),
                BarColumn(),
                TextColumn("{task.fields[count]}"),
                TimeElapsedColumn(table_column=whole()),
                TextColumn("ETA"),
                TimeRemainingColumn(table_column=whole()),
                TextColumn("{task.fields[figures]}", table_column=Column(no_wrap=True)),
                console=Rich(stderr=True),
            )
            self._bars.start()
        count = f"{done}/{total}" if total else f"{done}"  # a format of the column would meet a total of None
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total or None, figures="", count="")
        task = self._tasks[stage]
        self._bars.update(task, completed=done, total=total or None, figures=figures, count=count)

    def _print(self, stage: str, done: int, total: int, figures: str) -> None:
        now = time.monotonic()
        began, last = self._plain.setdefault(stage, (now, now))
        finished = bool(total) and done >= total
        if now - last < _PLAIN_PERIOD and not finished:
            return
        if finished and now - began < 1.0:
            del self._plain[stage]  # too short for a line
            return
        elapsed = now - began
        parts = [f"{stage}: {done}/{total}" if total else f"{stage}: {done}", duration(elapsed)]
        if total and 0 < done < total:
            parts.append(f"ETA {duration(elapsed / done * (total - done))}")
        if figures:
            parts.append(figures)
        print("  ".join(parts), file=sys.stderr, flush=True)
        if finished:
            del self._plain[stage]
        else:
            self._plain[stage] = (began, now)

    def close(self) -> None:
        """End all bars."""
        if self._bars is not None:
            self._bars.stop()
            self._bars = None
            self._tasks.clear()
