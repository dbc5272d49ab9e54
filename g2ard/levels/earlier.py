"""What an earlier call left in a folder of levels: files that its `lod-meta.json` names, and no others."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

__all__ = ["named_in", "remove"]

_PART, _IMAGE = re.compile(r"\d+_\d+/meta\.json"), re.compile(r"\w+\.webp")
"""What a file of a level is called, and what the images that it names are."""


def named_in(path: Path) -> set[Path]:
    """The files of all levels, relative to the folder; none where there is no folder of ours."""
    named: set[Path] = set()
    for part in map(Path, _names(_json(path / "lod-meta.json"), "filenames", _PART)):
        entries = [entry for entry in _json(path / part).values() if isinstance(entry, dict)]
        images = [image for entry in entries for image in _names(entry, "files", _IMAGE)]
        named |= {part, *map(part.with_name, images)}
    return named


def remove(path: Path, files: Collection[Path]) -> None:
    """Remove files of the folder, and the folders in it that they leave empty."""
    for file in files:
        (path / file).unlink(missing_ok=True)
    for folder in {(path / file).parent for file in files}:
        with suppress(OSError):
            folder.rmdir()


def _names(content: dict[str, Any], key: str, pattern: re.Pattern[str]) -> list[str]:
    found = content.get(key)
    return [name for name in map(str, found) if pattern.fullmatch(name)] if isinstance(found, list) else []


def _json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
