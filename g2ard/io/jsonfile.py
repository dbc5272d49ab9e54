"""JSON files with typed access; errors name the file and the property."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError

_LARGEST_NUMBER = sys.float_info.max
_LONGEST_SHOWN_VALUE = 40
"""Longest value in a message, characters."""


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    content = read_any_json(path)
    if not isinstance(content, dict):
        raise InputError("expected a JSON object", path=path)
    return content


def read_json_list(path: Path) -> list[Any]:
    content = read_any_json(path)
    if not isinstance(content, list):
        raise InputError("expected a JSON list", path=path)
    return content


def read_any_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(error.strerror or str(error), path=path) from error
    return parse_json(path, data)


def parse_json(path: str | Path, data: bytes) -> Any:
    """Return the content of JSON text; `path` is for errors."""
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError("not a text file", path=path) from error
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON ({error.msg})", path=path, index=error.lineno, item="line") from error
    except RecursionError as error:
        raise InputError("is nested too deeply", path=path) from error
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"not JSON ({error})", path=path) from error


@dataclass(frozen=True, slots=True)
class Place:
    """Location of a value in a JSON file: an entry of the file and a property, such as a.b[2]."""

    path: Path | None = None
    index: int | None = None
    item: str = "entry"
    property: str = ""

    def to(self, key: str | int) -> Place:
        """Return the place of a property, or of an entry of a list."""
        deeper = f"{self.property}[{key}]" if isinstance(key, int) else f"{self.property}.{key}"
        return replace(self, property=deeper.removeprefix("."))

    def error(self, message: str) -> InputError:
        return InputError(
            message, path=self.path, property=self.property or None, index=self.index, item=self.item
        )

    def unexpected(self, value: Any, expected: str) -> InputError:
        """Return the error for a value of another kind."""
        return self.error(f"is {_found(value)}, expected {expected}")


class Fields(dict[str, Any]):
    """A JSON object that knows its place in the file, as do the objects and lists in it.

    >>> fields = Fields({"means": {"shape": [3, "four"]}})
    >>> fields["means"]["shape"].place.property
    'means.shape'
    >>> fields["scales"]
    Traceback (most recent call last):
    ...
    g2ard.errors.InputError: property 'scales' is missing
    """

    def __init__(self, entry: dict[str, Any], place: Place | None = None) -> None:
        super().__init__(entry)
        self.place = place or Place()

    def __getitem__(self, key: str) -> Any:
        if key not in self:
            raise self.place.to(key).error("is missing")
        return _placed(super().__getitem__(key), self.place.to(key))

    def get(self, key: str, default: Any = None) -> Any:
        return _placed(super().get(key, default), self.place.to(key))


class Items(list[Any]):
    """A JSON list that knows its place in the file; negative indices are invalid."""

    def __init__(self, entries: list[Any], place: Place) -> None:
        super().__init__(entries)
        self.place = place

    def __getitem__(self, at: Any) -> Any:
        if not 0 <= at < len(self):
            raise self.place.to(at).error("is missing")
        return _placed(super().__getitem__(at), self.place.to(at))

    def __iter__(self) -> Iterator[Any]:
        return (self[at] for at in range(len(self)))


def _placed(value: Any, place: Place) -> Any:
    if isinstance(value, dict):
        return Fields(value, place)
    return Items(value, place) if isinstance(value, list) else value


def fields_of(path: str | Path, entry: Any, index: int | None = None, item: str = "entry") -> Fields:
    """Return `entry` as `Fields`, or raise an error if it is not an object.

    Args:
        index: index of the entry in the file; None for the whole document.
        item: unit of `index`.
    """
    place = Place(Path(path), index, item)
    if not isinstance(entry, dict):
        raise place.unexpected(entry, "an object")
    return Fields(entry, place)


def numbers(holder: Fields, key: str, *shape: int, most: float = _LARGEST_NUMBER, gaps: bool = False) -> Any:
    """Return a number, or nested lists of numbers, as floats.

    Args:
        shape: lengths of the lists, outermost first; empty for one number.
        most: largest magnitude.
        gaps: whether null (which becomes NaN), NaN and infinities are allowed.
    """

    def taken(value: Any, place: Place, shape: tuple[int, ...]) -> Any:
        if shape:
            if not isinstance(value, list) or len(value) > shape[0]:
                raise place.unexpected(value, f"a list of {shape[0]}")
            return [taken(value[at], place.to(at), shape[1:]) for at in range(shape[0])]
        if gaps and (value is None or (isinstance(value, float) and not math.isfinite(value))):
            return math.nan if value is None else value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise place.unexpected(value, "a number")
        if not -most <= value <= most:
            limit = "a finite number" if most == _LARGEST_NUMBER else f"a number within ±{most:.6g}"
            raise place.unexpected(value, limit)
        return float(value)

    return taken(holder[key], holder.place.to(key), shape)


def number(holder: Fields, key: str, default: float | None = None) -> float:
    """Return a number, or the default if the property is missing."""
    if default is not None and key not in holder:
        return default
    return float(numbers(holder, key))


def matrix(holder: Fields, key: str) -> NDArray[np.float64]:
    """Return a matrix of 3×4 or 4×4 numbers."""
    rows = 3 if len(listed(holder, key)) == 3 else 4
    return np.array(numbers(holder, key, rows, 4))


def text(holder: Fields, key: str, default: str | None = None) -> str:
    """Return a string, or the default if the property is missing."""
    value = holder[key] if default is None else holder.get(key, default)
    if not isinstance(value, str):
        raise holder.place.to(key).unexpected(value, "a string")
    return value


def optional_text(holder: Fields, key: str) -> str | None:
    """Return a string, or None if the property is missing or null."""
    return None if holder.get(key) is None else text(holder, key)


def objects(holder: Fields, key: str) -> list[Fields]:
    """Return a list of objects, empty if the property is missing."""
    entries = listed(holder, key)
    return [object_of(entries, at) for at in range(len(entries))]


def listed(holder: Fields, key: str) -> Items:
    """Return a list, empty if the property is missing."""
    value = holder.get(key, Items([], holder.place.to(key)))
    if not isinstance(value, Items):
        raise holder.place.to(key).unexpected(value, "a list")
    return value


def names_of(holder: Fields, key: str, count: int) -> list[str]:
    """Return the `count` file names that a format prescribes, from the list `holder[key]`.

    Raises:
        InputError: no list, too few items, or a name that is empty or not printable.
    """
    value, found = holder[key], []
    if not isinstance(value, Items):
        raise holder.place.to(key).unexpected(value, "a list")
    for at in range(count):
        name = value[at]
        if not isinstance(name, str) or not name or not name.isprintable():
            raise value.place.to(at).unexpected(name, "the name of a file")
        found.append(name)
    return found


def object_of(holder: Fields | Items, key: Any) -> Fields:
    """Return an object from a property or a list."""
    value = holder[key]
    if not isinstance(value, Fields):
        raise holder.place.to(key).unexpected(value, "an object")
    return value


def index_of(holder: Fields | Items, key: Any, count: int) -> int:
    """Return an index below `count` from a property or a list."""
    value = holder[key]
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
        expected = f"an index from 0 to {count - 1}" if count else "no index of an empty list"
        raise holder.place.to(key).unexpected(value, expected)
    return value


def whole(holder: Fields | Items, key: Any, default: int | None = None) -> int:
    """Return a whole number ≥ 0 (80 or 80.0), or the default if the property is missing."""
    value = holder[key] if default is None or key in holder else default
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and 0 <= value <= _LARGEST_NUMBER and value % 1 == 0):
        raise holder.place.to(key).unexpected(value, "a whole number ≥ 0")
    return int(value)


def _found(value: Any) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int) and abs(value) >= 10**_LONGEST_SHOWN_VALUE:
        return "an integer of many digits"
    return f"the string {_short(repr(value))}" if isinstance(value, str) else repr(value)


def _short(text: str) -> str:
    return (
        text
        if len(text) <= _LONGEST_SHOWN_VALUE
        else f"{text[: _LONGEST_SHOWN_VALUE // 2]}…{text[-_LONGEST_SHOWN_VALUE // 4 :]}"
    )
