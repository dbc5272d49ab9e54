"""JSON files, read with errors that name the file and the line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from g2ard.errors import InputError

__all__ = ["read_any_json", "read_json", "read_json_list"]


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
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not JSON: {error.msg} (line {error.lineno})") from error
