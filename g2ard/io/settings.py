"""The settings that trainers leave beside a model as YAML with Python's tags: of those, words and paths.

What PyYAML writes of dataclasses is read line by line: `key: value`, a block below a key, and paths as
`!!python/object/apply:pathlib.PosixPath` with a part an item. It is no reader of YAML at large.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath, PureWindowsPath

from g2ard.errors import InputError
from g2ard.io.paths import real_path

_PATH = re.compile(r"(?:&(?P<anchor>\w+)\s+)?!!python/object/apply:pathlib\.(?P<kind>\w*)Path\s*(?:\[\])?$")


class Settings:
    """One block of settings.

    Args:
        lines: all lines of the file.
        first: the block's first line.
        indent: spaces before its keys.
    """

    def __init__(self, lines: list[str], first: int = 0, indent: int = 0) -> None:
        self._lines, self._first, self._indent = lines, first, indent

    def word(self, key: str) -> str | None:
        """The value of a key as text, without quotes; None where it is absent, null, empty or an object."""
        at = self._find(key)
        text = "" if at is None else self._text(at, key)
        if at is None or text[:1] in ("", *"!&*[{"):
            return None
        for line in self._lines[at + 1 :]:  # a long value goes on in deeper lines
            if _indent(line) <= self._indent or not line.strip():
                break
            text += " " + line.strip()
        text = text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"" else text
        return None if text in ("null", "~") else text

    def path(self, key: str) -> Path | None:
        """The value of a key as a path; None where it is absent, null or empty."""
        at = self._find(key)
        if at is None:
            return None
        text = self._text(at, key)
        if text.startswith("*"):
            anchor = re.escape(text[1:])
            at = next((i for i, line in enumerate(self._lines) if re.search(rf"&{anchor}\b", line)), None)
            text = "" if at is None else self._lines[at].split(": ", 1)[-1].strip()
        match = _PATH.match(text)
        if at is None or match is None:
            word = self.word(key)
            return None if word is None else Path(word)
        parts = self._items(at)
        pure = PureWindowsPath if match["kind"] == "Windows" else PurePosixPath
        return Path(pure(*parts).as_posix()) if parts else None

    def block(self, key: str) -> tuple[str, Settings] | None:
        """The tag of a key (what it is an object of) and what stands below it; None where it is absent."""
        at = self._find(key)
        if at is None:
            return None
        return self._text(at, key), Settings(self._lines, at + 1, self._indent + 2)

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
        indent, items = _indent(self._lines[at]), []
        for line in self._lines[at + 1 :]:
            if _indent(line) < indent or not line.strip().startswith("- "):
                break
            items.append(line.strip()[2:].strip().strip("'\""))
        return items


def read_settings(path: Path) -> Settings:
    """The settings in a file.

    Raises:
        InputError: it is absent or no text.
    """
    try:
        return Settings(path.read_text(encoding="utf-8").splitlines())
    except OSError as error:
        raise InputError(f"{error.strerror}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputError("not a text file", path=path) from error


def below(start: Path, path: Path) -> Path | None:
    """Where a path that a trainer wrote into `start` leads to now, or None: trainers write paths relative to
    where they ran, mostly a folder above their output."""
    if path.is_absolute():
        return path if path.exists() else None
    places = (*real_path(start).parents, Path())
    return next((place / path for place in places if (place / path).exists()), None)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
