"""Reader for words and paths in trainers' settings, YAML with Python tags.

It only supports what PyYAML writes for dataclasses: `key: value`, nested blocks, and
`!!python/object/apply:pathlib.PosixPath` with a list of parts.
"""

from __future__ import annotations

import re
from pathlib import Path, PureWindowsPath

from g2ard.io.finding import plain_parts
from g2ard.io.paths import read_text, real_path

_PATH = re.compile(
    r"(?:&(?P<anchor>\w+)\s+)?!!python/object/apply:pathlib\.(?P<kind>\w*)Path\s*(?:\[\])?$"
)


class Settings:
    """A block of settings: the lines of the file, the block's first line, and the spaces before its keys."""

    def __init__(self, lines: list[str], first: int = 0, indent: int = 0) -> None:
        self._lines = lines
        self._first = first
        self._indent = indent

    def word(self, key: str) -> str | None:
        """Return a value as text without quotes; None if it is missing, null, empty or an object."""
        at = self._find(key)
        if at is None:
            return None
        text = self._text(at, key)
        if text[:1] in ("", *"!&*[{"):
            return None
        for line in self._lines[at + 1 :]:  # continuation lines are indented
            if _indent(line) <= self._indent or not line.strip():
                break
            text += " " + line.strip()
        if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
            text = text[1:-1]
        if text in ("null", "~"):
            return None
        return text

    def path(self, key: str) -> Path | None:
        """Return a value as a path; None if it is missing, null or empty."""
        at = self._find(key)
        if at is None:
            return None
        text = self._text(at, key)
        if text.startswith("*"):
            anchor = re.compile(rf"&{re.escape(text[1:])}\b")
            found = (i for i, line in enumerate(self._lines) if anchor.search(line))
            at = next(found, None)
            text = ""
            if at is not None:
                text = self._lines[at].split(": ", 1)[-1].strip()
        match = _PATH.match(text)
        if at is None or match is None:
            word = self.word(key)
            if word is None:
                return None
            return Path(word)
        parts = self._items(at)
        if not parts:
            return None
        if match["kind"] == "Windows":
            return Path(PureWindowsPath(*parts).as_posix())
        return Path(*parts)

    def block(self, key: str, *deeper: str) -> tuple[str, Settings] | None:
        """Return the tag (class) and the block of a key, or of a key in its block; None if it is missing."""
        at = self._find(key)
        if at is None:
            return None
        block = Settings(self._lines, at + 1, self._indent + 2)
        if deeper:
            return block.block(*deeper)
        return (self._text(at, key), block)

    def _find(self, key: str) -> int | None:
        start = " " * self._indent + key + ":"
        for i in range(self._first, len(self._lines)):
            line = self._lines[i]
            if line.strip() and _indent(line) < self._indent:
                return None
            if line.rstrip() == start or line.startswith(start + " "):
                return i
        return None

    def _text(self, at: int, key: str) -> str:
        return self._lines[at].strip()[len(key) + 1 :].strip()

    def _items(self, at: int) -> list[str]:
        indent = _indent(self._lines[at])
        items = []
        for line in self._lines[at + 1 :]:
            if _indent(line) < indent or not line.strip().startswith("- "):
                break
            items.append(line.strip()[2:].strip().strip("'\""))
        return items


def read_settings(path: Path) -> Settings:
    return Settings(read_text(path).splitlines())


def below(start: Path, path: Path) -> Path | None:
    """Resolve a path that a trainer wrote into `start`, or return None if it does not exist.

    Trainers write paths relative to where they ran, usually a folder above their output. Of a run that was
    copied with its data from another system, the longest end of the path that exists there is taken.
    """
    folders = real_path(start).parents
    places = *folders, Path()
    for place in places:
        if (place / path).exists():
            return place / path
    parts = plain_parts(str(path))
    for k in range(len(parts)):
        for place in places:
            end = place.joinpath(*parts[k:])
            if end.exists() and real_path(end) not in folders:
                return end
    return None


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
