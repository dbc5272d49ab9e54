"""JSON files, read with errors that name the file and the line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from g2ard.errors import InputError

__all__ = ["parse_json", "read_any_json", "read_json", "read_json_list"]


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
