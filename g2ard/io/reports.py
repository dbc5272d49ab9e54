"""Base class of reports: dataclasses that convert to and from JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import Any, Self

import msgspec

from g2ard.progress import plural
from g2ard.system.shown import Shown

LEFT_OUT = {"left_out": True}
"""Metadata of an optional field that JSON omits without a value."""

_LINE = 90  # most characters of a report in one line

_VALUE = 40  # most characters of a value in a line of others

_ROW = 120  # most characters of a value in a row of its own


@dataclass(frozen=True)
class Report(Shown):
    """A dataclass of numbers, strings, lists of these, and nested reports.

    >>> from dataclasses import field
    >>> @dataclass(frozen=True)
    ... class Pair(Report):
    ...     before: float
    ...     after: float
    ...     note: str | None = field(default=None, metadata=LEFT_OUT)
    >>> Pair(1.0, 2.0).as_dict(), Pair.of({"before": 1.0, "after": 2.0}) == Pair(1.0, 2.0)
    ({'before': 1.0, 'after': 2.0}, True)
    """

    def __init_subclass__(cls) -> None:
        # `dataclass` would write one that spells out nested reports
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = Report.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        told = [f"{name}={_brief(value, _VALUE)}" for name, value in self._values()]
        ends = accumulate(len(text) + 2 for text in told)
        fitting = [text for text, end in zip(told, ends, strict=True) if end <= _LINE]
        if len(fitting) < len(told):
            fitting.append("…")
        return f"{type(self).__name__}({', '.join(fitting)})"

    def rows(self) -> list[tuple[str, str]]:
        """Return the names of fields with a value, and that in at most a line."""
        return [(name, _brief(value, _ROW)) for name, value in self._values()]

    def _values(self) -> list[tuple[str, Any]]:
        values = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return [(name, value) for name, value in values if value is not None]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values: fields by name, nested reports as dicts."""
        values = ((f, getattr(self, f.name)) for f in fields(self))
        return {
            f.name: _nested(v) for f, v in values if v is not None or "left_out" not in f.metadata
        }

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """Restore a report from `as_dict`."""
        return msgspec.convert(data, cls)


def plain(value: Any) -> Any:
    """Return a report or array as JSON values, and anything else as text, for `json.dumps`."""
    if isinstance(value, Report):
        return value.as_dict()
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)


def _nested(value: Any) -> Any:
    if isinstance(value, Report):
        return value.as_dict()
    if isinstance(value, list | tuple):
        return [_nested(item) for item in value]
    return value


def _brief(value: Any, most: int) -> str:
    """Return a value in at most `most` characters, collections by their length if they need more."""
    if isinstance(value, float):
        text = f"{value:.6g}"
    else:
        text = repr(value)
    if len(text) <= most:
        return text
    if isinstance(value, Report):
        return f"{type(value).__name__}(…)"
    if isinstance(value, list | tuple | dict):
        return plural(len(value), "item")
    return f"{text[: most - 1]}…"
