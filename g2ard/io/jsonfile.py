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


class Fields(dict[str, Any]):
    """A JSON object that knows which of its properties was asked for last, for what is said of a bad one."""

    last = ""

    def __getitem__(self, key: str) -> Any:
        self.last = key
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.last = key
        return super().get(key, default)


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
    fields = Fields(entry)
    try:
        yield fields
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{where}: lacks {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{where}: malformed {fields.last!r} ({error})") from error
