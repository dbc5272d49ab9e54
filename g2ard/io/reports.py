"""Base class of reports: dataclasses that convert to and from JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import msgspec

LEFT_OUT = {"left_out": True}
"""Metadata of an optional field that JSON omits without a value."""


@dataclass(frozen=True)
class Report:
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

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values: fields by name, nested reports as dicts."""
        values = ((f, getattr(self, f.name)) for f in fields(self))
        return {f.name: _nested(v) for f, v in values if v is not None or "left_out" not in f.metadata}

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """Restore a report from `as_dict`."""
        return msgspec.convert(data, cls)


def plain(value: Any) -> Any:
    """Return a report or array as JSON values, and anything else as text, for `json.dumps`."""
    if isinstance(value, Report):
        return value.as_dict()
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _nested(value: Any) -> Any:
    if isinstance(value, Report):
        return value.as_dict()
    return [_nested(item) for item in value] if isinstance(value, list | tuple) else value
