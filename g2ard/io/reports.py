"""Base class of reports: dataclasses that convert to and from JSON."""

import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, Self, Union, get_args, get_origin, get_type_hints

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
        kinds = get_type_hints(cls)
        names = [f.name for f in fields(cls) if f.name in data or f.default is MISSING]
        return cls(**{name: _read(kinds[name], data[name]) for name in names})


def plain(value: Any) -> Any:
    """Return a report or array as JSON values, and anything else as text, for `json.dumps`."""
    if isinstance(value, Report):
        return value.as_dict()
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _nested(value: Any) -> Any:
    if isinstance(value, Report):
        return value.as_dict()
    return [_nested(item) for item in value] if isinstance(value, list | tuple) else value


def _read(kind: Any, value: Any) -> Any:
    if value is None:
        return None
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(option for option in get_args(kind) if option is not type(None))
    if isinstance(kind, type) and issubclass(kind, Report):
        return kind.of(value)
    if get_origin(kind) is tuple:
        return tuple(_read(get_args(kind)[0], item) for item in value)
    return value
