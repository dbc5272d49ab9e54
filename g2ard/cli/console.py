"""Status on stderr: one live line in a terminal, plain lines elsewhere, nothing with --quiet."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live
    from rich.table import Table

_PLAIN_PERIOD = 10.0
"""Seconds between lines of a stage when stderr is not a terminal that can redraw its last line."""
_LIVE_LINE_DELAY = 0.4
"""Seconds before the live line appears: short commands never import rich."""
_LIVE_LINE_PERIOD = 0.125
"""Seconds between updates of the live line."""
_SILENT_SECONDS = 1.0
"""Seconds after the end of a stage until the live line says that the command is still working."""
_STEADY = 1.5
"""Largest ratio of two estimates of a stage's duration, the second after twice the time, that are alike."""
_ECHO = 5
"""Characters left free at the right for ^C, which terminals echo; a line that wraps cannot be removed."""
_NAME = 10
"""Fewest characters of the first column of a table, which continues on the next line."""
_BAR = 12, 40
"""Fewest and most characters of a bar."""


def format_duration(seconds: float) -> str:
    """Format a duration.

    >>> format_duration(3.14159), format_duration(75), format_duration(4000)
    ('3.1 s', '1 min 15 s', '1 h 06 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
    return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"


def _format_clock(seconds: float) -> str:
    """Format a duration as on a clock.

    >>> _format_clock(75.2), _format_clock(4000)
    ('1:15', '1:06:40')
    """
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _format_figure(name: str, cell: str) -> str:
    """Format a cell of a table outside of it, with the unit of its header behind.

    >>> _format_figure("PSNR, dB", "31.20"), _format_figure("views", "8")
    ('PSNR 31.20 dB', 'views 8')
    """
    what, _, unit = name.partition(", ")
    return f"{what} {cell} {unit}".rstrip()


def wrap(text: str) -> str:
    """Break lines between words where a terminal would break them within; paths stay whole."""
    if not sys.stderr.isatty():
        return text
    from textwrap import TextWrapper

    try:
        columns = (
            int(os.environ.get("COLUMNS") or 0) or os.get_terminal_size(sys.stderr.fileno()).columns
        )
    except (OSError, ValueError):
        return text
    wrapper = TextWrapper(columns or 80, break_long_words=False, break_on_hyphens=False)
    return "\n".join(wrapper.fill(line) for line in text.split("\n"))


@dataclass
class _Stage:
    """The current stage; `first` units were done when it began, as after --resume."""

    name: str
    began: float
    first: int = 0
    done: int = 0
    total: int = 0
    figures: list[str] = field(default_factory=list)
    ended: float | None = None
    printed: float = 0.0
    settled: bool = False
    noted: tuple[float, float] | None = None

    def note(self, now: float) -> None:
        """Compare the estimated duration with that at half of the time so far; alike, they are settled."""
        elapsed = now - self.began
        share = self.share
        if share <= 0 or elapsed < 1 or (self.noted is not None and elapsed < 2 * self.noted[0]):
            return
        whole = elapsed / share
        if self.noted is not None and self.noted[1] / _STEADY <= whole <= self.noted[1] * _STEADY:
            self.settled = True
        self.noted = elapsed, whole

    @property
    def share(self) -> float:
        """Share of this call's units that are done; 0 if their number is unknown."""
        if self.total <= self.first:
            return 0.0
        return (self.done - self.first) / (self.total - self.first)

    def left(self, now: float) -> float | None:
        """Return the estimated seconds to the end, or None if they are unknown, or not yet settled."""
        share = self.share
        if not self.settled or share <= 0:
            return None
        return (now - self.began) / share * (1 - share)


class Console:
    """Progress callback (see `g2ard.progress`) and printer of messages.

    In a terminal, a thread redraws one line for the current stage, which disappears with it. Otherwise, the
    thread prints a line every 10 s.
    """

    def __init__(self, *, quiet: bool = False, name: str = "") -> None:
        self.quiet = quiet
        self._name = name
        self._began = time.monotonic()
        self._stage: _Stage | None = None
        self._live: Live | None = None
        self._drawn = sys.stderr.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
        self._ended = threading.Event()
        self._lock = threading.RLock()

    def __enter__(self) -> Console:
        if not self.quiet:
            threading.Thread(target=self._keep_telling, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the live line: the work is done, and what follows waits."""
        self._ended.set()
        self._clear()

    def say(self, text: str, *, asked: bool = False) -> None:
        """Print a line of status. --quiet hides it, but not an answer (`asked`), such as an estimate."""
        if self.quiet and not asked:
            return
        with self._lock:
            if self._stage is not None and not self._stage.total:
                self._end_stage()  # its length was unknown; the message tells its result
            text = wrap(text)
            if self._live is not None:
                self._live.console.print(text, markup=False, highlight=False, soft_wrap=True)
            else:
                print(text, file=sys.stderr, flush=True)

    def error(self, text: str) -> None:
        with self._lock:
            self._clear()
            print(wrap(f"g2ard: {text}"), file=sys.stderr, flush=True)

    def table(
        self, title: str, columns: list[str], rows: list[list[str]], *, stdout: bool = False
    ) -> None:
        """Print a table; columns with a header are right-aligned, except the first.

        Figures stay on one line: a table that is too wide for its terminal becomes a list.
        """
        if self.quiet:
            return
        from rich.console import Console as Rich
        from rich.table import Table

        table = Table(show_header=any(columns))
        for i, name in enumerate(columns):
            number = bool(i and name)
            table.add_column(
                name, justify="right" if number else "left", overflow="fold", no_wrap=number
            )
        for row in rows:
            table.add_row(*row)
        stream = sys.stdout if stdout else sys.stderr
        screen = Rich(file=stream, width=None if stream.isatty() else 120)
        first, *others = (max(map(len, column)) for column in zip(columns, *rows, strict=True))
        with self._lock:
            self._clear()
            screen.print(title, markup=False, highlight=False, soft_wrap=not stream.isatty())
            if (
                table.show_header
                and min(first, _NAME) + sum(others) + 3 * len(columns) + 1 > screen.width
            ):
                for row in rows:
                    figures = zip(columns[1:], row[1:], strict=True)
                    told = [_format_figure(name, cell) for name, cell in figures if cell]
                    screen.print(f"{row[0]}: {', '.join(told)}", markup=False, highlight=False)
            else:
                screen.print(table, markup=False, highlight=False)

    def print(self, text: str) -> None:
        """Print to stdout, also with --quiet."""
        with self._lock:
            self._clear()
            print(text, flush=True)

    def __call__(
        self, stage: str, done: int, total: int, info: Mapping[str, Any] | None = None
    ) -> None:
        """Show the progress of a stage, with the figures of `info`; a total of 0 is unknown."""
        if self.quiet:
            return
        with self._lock:
            now = time.monotonic()
            current = self._stage
            if current is None or current.name != stage or done < current.done or current.ended:
                self._end_stage()
                current = self._stage = _Stage(stage, now, done if done < total else 0, printed=now)
            current.done = done
            current.total = total
            current.note(now)
            current.figures = [f"{name} {value}" for name, value in (info or {}).items()]
            if total and done >= total:
                self._end_stage()

    def _end_stage(self) -> None:
        """Finish the current stage; without a terminal, print its last line unless it was short."""
        stage = self._stage
        if stage is not None and stage.ended is None:
            stage.ended = time.monotonic()
            long = stage.ended - stage.began >= (1 if stage.total > 1 else _PLAIN_PERIOD)
            if long and not (self._drawn or self.quiet):
                self._print(stage, stage.ended)

    def _keep_telling(self) -> None:
        """Draw the live line, or print lines, until the command ends."""
        if self._ended.wait(_LIVE_LINE_DELAY):
            return
        while True:
            with self._lock:
                if self._ended.is_set():
                    return
                self.tick()
            if self._ended.wait(_LIVE_LINE_PERIOD if self._drawn else 1.0):
                return

    def tick(self) -> None:
        """Draw the live line, or print a line if there has been none about this stage for a while."""
        if self._drawn:
            self._draw()
            return
        stage = self._stage
        now = time.monotonic()
        if stage is not None and stage.ended is None and now - stage.printed >= _PLAIN_PERIOD:
            stage.printed = now
            self._print(stage, now)

    def _print(self, stage: _Stage, now: float) -> None:
        count = f"{stage.done}/{stage.total}" if stage.total > 1 else str(stage.done or "")
        parts = [f"{stage.name}: {count}".rstrip(), format_duration(now - stage.began)]
        if stage.ended is None and (left := stage.left(now)) is not None:
            parts.append(f"ETA {format_duration(left)}")
        print("  ".join([*parts, *stage.figures]), file=sys.stderr, flush=True)

    def _draw(self) -> None:
        if self._live is None:
            from rich.console import Console as Rich
            from rich.live import Live

            screen = Rich(stderr=True)
            self._live = Live(
                console=screen,
                get_renderable=lambda: self._line(screen.width - _ECHO),
                auto_refresh=False,
                transient=True,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._live.start()
            screen.show_cursor(True)  # so that no end of the process can leave it hidden
        self._live.refresh()

    def _line(self, free: int) -> Table:
        """Return the live line: what matters most of the current stage in as many characters as are free."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        stage = self._stage
        now = time.monotonic()
        if stage is None or (stage.ended is not None and now - stage.ended > _SILENT_SECONDS):
            stage = _Stage(f"{self._name}: working", self._began)
        total = f"{stage.total:,}"
        cells = [stage.name]
        if stage.total > 1:
            cells.append(f"{stage.done:,}".rjust(len(total)) + f"/{total}")
        elif stage.done:
            cells.append(f"{stage.done:,}")
        if stage.ended is None and (left := stage.left(now)) is not None:
            cells.append(f"ETA {_format_clock(left)}")
        cells.append(_format_clock((stage.ended or now) - stage.began))
        while len(cells) > 1 and len("  ".join(cells)) > free:
            cells.pop()
        free -= len("  ".join([*cells, ""]))
        bar = _BAR[0] if free >= _BAR[0] else 0
        for figure in stage.figures:
            if len(figure) + 2 <= free - bar - 2:
                cells.append(figure)
                free -= len(figure) + 2
        row: list[RenderableType] = [
            Text(cell, no_wrap=True, overflow="ellipsis") for cell in cells
        ]
        if bar:
            width = min(free, _BAR[1])
            row.insert(
                1, ProgressBar(stage.total or None, stage.done, width=width, pulse=stage.total < 2)
            )
        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_row(*row)
        return table

    def _clear(self) -> None:
        """Remove the live line; the next update of a stage draws it again."""
        with self._lock:
            if self._live is not None:
                self._live.stop()
                self._live = None
