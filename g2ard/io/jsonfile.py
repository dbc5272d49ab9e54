"""JSON files, read with errors that name the file and the line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from g2ard.errors import InputError

__all__ = ["Fields", "fields_of", "parse_json", "read_any_json", "read_json", "read_json_list"]


def read_json(path: Path) -> dict[str, Any]:
    """The object a JSON file holds.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than an object.
    """
    content = read_any_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object")
    return content


def read_json_list(path: Path) -> list[Any]:
    """The list a JSON file holds.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than a list.
    """
    content = read_any_json(path)
    if not isinstance(content, list):
        raise InputError(f"{path}: expected a JSON list")
    return content


def read_any_json(path: Path) -> Any:
    """Whatever a JSON file holds.

    Raises:
        InputError: the file is absent or is not JSON.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    return parse_json(str(path), data)


def parse_json(where: str, data: bytes) -> Any:
    """Whatever some JSON text holds; `where` names it in errors.

    Raises:
        InputError: it is not JSON, or nested deeper than Python follows.
    """
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not a text file") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: not JSON: {error.msg} (line {error.lineno})") from error
    except RecursionError as error:
        raise InputError(f"{where}: JSON nested too deeply") from error
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"{where}: not JSON: {error}") from error


class _Asked:
    """Which property of a JSON document was asked for last."""

    name = ""


class _AbsentError(KeyError):
    """A property is absent; any other KeyError is of a table that a value was looked up in."""


class Fields(dict[str, Any]):
    """A JSON object that knows which property was asked for last, in it or in what it holds.

    >>> fields = Fields({"means": {"shape": [3, "four"]}})
    >>> fields["means"]["shape"][1]
    'four'
    >>> fields.last
    'means.shape[1]'
    """

    def __init__(self, entry: dict[str, Any], inside: str = "", asked: _Asked | None = None) -> None:
        super().__init__(entry)
        self._inside, self._asked = inside, asked or _Asked()

    @property
    def last(self) -> str:
        """The property asked for last, as a.b[2]; "" before any was."""
        return self._asked.name

    def __getitem__(self, key: str) -> Any:
        self._ask(key)
        if key not in self:
            raise _AbsentError(key)
        return _within(super().__getitem__(key), self)

    def get(self, key: str, default: Any = None) -> Any:
        self._ask(key)
        return _within(super().get(key, default), self)

    def _ask(self, key: str) -> None:
        self._asked.name = f"{self._inside}.{key}" if self._inside else key


class _Items(list[Any]):
    """A JSON list inside `Fields`."""

    def __init__(self, entries: list[Any], inside: str, asked: _Asked) -> None:
        super().__init__(entries)
        self._inside, self._asked = inside, asked

    def __getitem__(self, at: Any) -> Any:
        self._asked.name = f"{self._inside}[{at}]" if isinstance(at, int) else self._inside
        return _within(super().__getitem__(at), self)

    def __iter__(self) -> Iterator[Any]:
        """Whoever takes all of them asks for the list: entries are named only while they are held."""
        for at, value in enumerate(super().__iter__()):
            yield self[at] if isinstance(value, dict | list) else value
        self._asked.name = self._inside


def _within(value: Any, holder: Fields | _Items) -> Any:
    """A value just asked for, knowing what is asked of it in turn."""
    if isinstance(value, dict):
        return Fields(value, holder._asked.name, holder._asked)
    if isinstance(value, list):
        return _Items(value, holder._asked.name, holder._asked)
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
        raise InputError(f"{where}: malformed (a {type(entry).__name__}, not an object)")
    fields = entry if isinstance(entry, Fields) else Fields(entry)
    try:
        yield fields
    except InputError:
        raise
    except _AbsentError as error:
        raise InputError(f"{where}: lacks {fields.last!r}") from error
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{where}: malformed {fields.last!r} ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    """An exception's words on one line, or its name where it has none to say."""
    words = " ".join(str(error).split())
    return f"{words} is unknown" if isinstance(error, KeyError) else words or type(error).__name__
