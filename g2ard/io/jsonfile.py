"""JSON files, read with errors that name the file and the line."""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from g2ard.errors import InputError

__all__ = [
    "Fields",
    "fields_of",
    "index_of",
    "listed",
    "names_of",
    "numbers",
    "object_of",
    "objects",
    "parse_json",
    "read_any_json",
    "read_json",
    "read_json_list",
    "whole",
]

_LARGEST = sys.float_info.max
_SHOWN = 40
"""Characters of a value that a message tells."""


def read_json(path: Path) -> dict[str, Any]:
    """The object a JSON file holds.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than an object.
    """
    content = read_any_json(path)
    if not isinstance(content, dict):
        raise InputError("expected a JSON object", path=path)
    return content


def read_json_list(path: Path) -> list[Any]:
    """The list a JSON file holds.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than a list.
    """
    content = read_any_json(path)
    if not isinstance(content, list):
        raise InputError("expected a JSON list", path=path)
    return content


def read_any_json(path: Path) -> Any:
    """Whatever a JSON file holds.

    Raises:
        InputError: the file is absent or is not JSON.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{error.strerror}", path=path) from error
    return parse_json(str(path), data)


def parse_json(where: str, data: bytes) -> Any:
    """Whatever some JSON text holds; `where` names it in errors.

    Raises:
        InputError: it is not JSON, or nested deeper than Python follows.
    """
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError("not a text file", path=where) from error
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg} (line {error.lineno})", path=where) from error
    except RecursionError as error:
        raise InputError("JSON nested too deeply", path=where) from error
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"not JSON: {error}", path=where) from error


class _Asked:
    """Which property of a JSON document was asked for last."""

    def __init__(self, root: dict[str, Any]) -> None:
        self.root, self.path = root, _Path()

    def value(self, path: _Path) -> Any:
        """What stands at a path; a KeyError or IndexError where nothing does."""
        value: Any = self.root
        for key in path:
            value = dict.__getitem__(value, key) if isinstance(value, dict) else list.__getitem__(value, key)
        return value


class _Path(tuple[Any, ...]):
    """Keys and indices from the document's root, written a.b[2]."""

    __slots__ = ()

    def __str__(self) -> str:
        return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in self).removeprefix(".")

    def to(self, *keys: Any) -> _Path:
        return _Path((*self, *keys))

    def property(self) -> _Path:
        """Without the indices at its end."""
        end = len(self)
        while end and isinstance(self[end - 1], int):
            end -= 1
        return _Path(self[:end])


class _AbsentError(KeyError):
    """A property is absent; any other KeyError is of a table that a value was looked up in."""


class _UnexpectedError(ValueError):
    """The property asked for last is not what it should be."""

    def __init__(self, expected: str, value: Any) -> None:
        super().__init__(f"expected {expected}, found {_found(value)}")


class Fields(dict[str, Any]):
    """A JSON object that knows which property was asked for last, in it or in what it holds.

    >>> fields = Fields({"means": {"shape": [3, "four"]}})
    >>> fields["means"]["shape"][1]
    'four'
    >>> fields.last
    'means.shape[1]'
    """

    def __init__(self, entry: dict[str, Any], path: _Path | None = None, asked: _Asked | None = None) -> None:
        super().__init__(entry)
        self.path, self.asked = path or _Path(), asked or _Asked(self)

    @property
    def last(self) -> str:
        """The property asked for last, as a.b[2]; "" before any was."""
        return str(self.asked.path)

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            self.asked.path = self.path
            raise _UnexpectedError("a list", self)
        self.asked.path = self.path.to(key)
        if key not in self:
            raise _AbsentError(key)
        return _within(super().__getitem__(key), self)

    def get(self, key: str, default: Any = None) -> Any:
        self.asked.path = self.path.to(key)
        return _within(super().get(key, default), self)


class _Items(list[Any]):
    """A JSON list inside `Fields`. What a file names by an index is never counted from the end."""

    def __init__(self, entries: list[Any], path: _Path, asked: _Asked) -> None:
        super().__init__(entries)
        self.path, self.asked = path, asked

    def __getitem__(self, at: Any) -> Any:
        self.asked.path = self.path
        if isinstance(at, int):
            self.asked.path = self.path.to(at)
            if not 0 <= at < len(self):
                raise _AbsentError(at)
        elif not isinstance(at, slice):
            raise _UnexpectedError("an object", self)
        return _within(super().__getitem__(at), self)

    def __iter__(self) -> Iterator[Any]:
        """Whoever has taken all of them asks for the list, of rows for all the rows."""
        for at in range(len(self)):
            yield self[at]
        self.asked.path = self.path.property()


def _within(value: Any, holder: Fields | _Items) -> Any:
    """A value just asked for, knowing what is asked of it in turn."""
    if isinstance(value, dict):
        return Fields(value, holder.asked.path, holder.asked)
    if isinstance(value, list):
        return _Items(value, holder.asked.path, holder.asked)
    return value


@contextmanager
def fields_of(where: str, entry: Any) -> Iterator[Fields]:
    """An object's properties; what parsing them raises becomes one line that names the last that was read.

    Args:
        where: the file, and which of its entries this is.
        entry: what stands there.

    Raises:
        InputError: `entry` is no object, or a property is absent or is not what it should be.
    """
    if not isinstance(entry, dict):
        raise InputError(f"malformed: expected an object, found {_found(entry)}", path=where)
    fields = entry if isinstance(entry, Fields) else Fields(entry)
    try:
        yield fields
    except InputError:
        raise
    except _AbsentError as error:
        raise InputError(f"lacks {fields.last!r}", path=where) from error
    except _UnexpectedError as error:
        raise InputError(f"malformed {fields.last!r}: {error}", path=where) from error
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"malformed {_told(fields.asked, error)}", path=where) from error


def numbers(holder: Fields, key: str, *shape: int, most: float = _LARGEST, gaps: bool = False) -> Any:
    """A property that holds a number, or a list of them, or a list of such lists, as floats.

    Args:
        holder: the object.
        key: the property.
        shape: how long the lists are, the outermost first; none for one number.
        most: the largest magnitude.
        gaps: whether null (which becomes NaN), NaN and infinities may stand among them.
    """

    def taken(value: Any, shape: tuple[int, ...]) -> Any:
        if shape:
            if not isinstance(value, list) or len(value) > shape[0]:
                raise _UnexpectedError(f"a list of {shape[0]}", value)
            return [taken(value[at], shape[1:]) for at in range(shape[0])]
        if gaps and (value is None or (isinstance(value, float) and not math.isfinite(value))):
            return math.nan if value is None else value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _UnexpectedError("a number", value)
        if not -most <= value <= most:
            raise _UnexpectedError(f"a number within ±{most:.6g}", value)
        return float(value)

    return taken(holder[key], shape)


def objects(holder: Fields, key: str) -> list[Fields]:
    """A property that holds a list of objects; none where it is absent."""
    return [_object(entry) for entry in listed(holder, key)]


def listed(holder: Fields, key: str) -> list[Any]:
    """A property that holds a list; an empty one where it is absent."""
    value = holder.get(key, [])
    if not isinstance(value, list):
        raise _UnexpectedError("a list", value)
    return value


def names_of(holder: Fields, key: str, count: int) -> list[str]:
    """The first `count` of a property that holds a list of names of files."""
    value, found = holder[key], []
    if not isinstance(value, list):
        raise _UnexpectedError("a list", value)
    for at in range(count):
        name = value[at]
        if not isinstance(name, str) or not name or not name.isprintable():
            raise _UnexpectedError("the name of a file", name)
        found.append(name)
    return found


def object_of(holder: Fields | list[Any], key: Any) -> Fields:
    """A property, or an entry of a list, that holds an object."""
    return _object(holder[key])


def _object(value: Any) -> Fields:
    if not isinstance(value, Fields):
        raise _UnexpectedError("an object", value)
    return value


def index_of(holder: Fields | list[Any], key: Any, count: int) -> int:
    """A property, or an entry of a list, that holds an index of a list of `count`."""
    value = holder[key]
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
        raise _UnexpectedError(
            f"an index from 0 to {count - 1}" if count else "no index of an empty list", value
        )
    return value


def whole(holder: Fields | list[Any], key: Any, default: int | None = None) -> int:
    """A property, or an entry of a list, that holds a whole number ≥ 0, or the default where it is absent."""
    value = holder[key] if default is None or key in holder else default
    if isinstance(value, bool) or not isinstance(value, int | float) or not (value >= 0 and value % 1 == 0):
        raise _UnexpectedError("a whole number ≥ 0", value)
    return int(value)


_NUMBER, _WHOLE = "a number", "a whole number"
_EXPECTED = (
    (r"to integer|literal for int\(\)", _WHOLE),
    (
        r"(float|int)\(\) argument|string to float|to convert to float|real number|ufunc|supported between",
        _NUMBER,
    ),
    (r"attribute '(get|items|keys|values)'|indices must be integers|argument of type", "an object"),
    (r"not iterable|type: 'slice'", "a list"),
    (r"not subscriptable", "an object or a list"),
    (r"should be a str|expected str|unsupported operand type.*Path", "a string"),
    (r"unhashable", "a number or a string"),
)
"""What Python's and NumPy's words mean that the value should have been."""
_KINDS = {"an object": dict, "a list": list, "a string": str}


def _told(asked: _Asked, error: Exception) -> str:
    """The property at fault, what was expected there and what was found, or the error's own words."""
    words = " ".join(str(error).split())
    if "inhomogeneous" in words:
        return _odd_row(asked)
    expected = next((kind for pattern, kind in _EXPECTED if re.search(pattern, words)), None)
    try:
        path = (expected == _NUMBER and _no_number(asked)) or asked.path
        value = asked.value(path)
    except LookupError:
        expected = None
    if expected is None or isinstance(value, _KINDS.get(expected, ())):
        return f"{str(asked.path)!r} ({_reason(error)})"
    return f"{str(path)!r}: expected {expected}, found {_found(value)}"


def _no_number(asked: _Asked) -> _Path | None:
    """The first entry that is no number of the lists asked for last, which are taken out as a whole."""
    places = [asked.path.property()]
    while places:
        value = asked.value(place := places.pop())
        if isinstance(value, list):
            places.extend(place.to(at) for at in reversed(range(len(value))))
            continue
        try:
            float(value)
        except (TypeError, ValueError, OverflowError):
            return place
    return None


def _odd_row(asked: _Asked) -> str:
    """The first entry that is not like most beside it, of the list asked for last."""
    places = [asked.path.property()]
    for path in places:
        rows = asked.value(path)
        lengths = [len(row) if isinstance(row, list) else None for row in rows]
        common = Counter(lengths).most_common(1)[0][0] if lengths else None
        at = next((i for i, length in enumerate(lengths) if length != common), None)
        if at is not None:
            expected = _NUMBER if common is None else f"a list of {common}"
            return f"{str(path.to(at))!r}: expected {expected}, found {_found(rows[at])}"
        places.extend(path.to(i) for i in range(len(rows)) if common is not None)
    return f"{str(places[0])!r}: expected rows of one length"


def _found(value: Any) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int) and abs(value) >= 10**_SHOWN:
        return "an integer of many digits"
    return f"the string {_short(repr(value))}" if isinstance(value, str) else repr(value)


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN // 2]}…{text[-_SHOWN // 4 :]}"


def _reason(error: Exception) -> str:
    """An exception's words on one line, or its name where it has none to say."""
    words = " ".join(str(error).split())
    return f"{words} is unknown" if isinstance(error, KeyError) else words or type(error).__name__
