"""Exceptions with structured fields; `str()` joins the fields into one line."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

_PARAMETER = re.compile(r"\{(\w+)(?:=([^{}]*))?\}")


def _as_argument(name: str, value: str | None = None) -> str:
    return name if value is None else f"{name}={value}"


class G2ardError(Exception):
    """Base class of all g2ard exceptions.

    Args:
        message: what is wrong; after `property` or `index`, the rest of a sentence ("is missing").
        parameter: Python name of the invalid argument or constant.
        path: file or folder.
        property: property, column or key in the file.
        index: row, line or view.
        item: unit of `index`.
        hint: what to do. `{name}` and `{name=VALUE}` are arguments, which the command line prints as flags.

    >>> str(InputError("is missing", path="a.ply", property="scale_2", hint="export the scene again"))
    "a.ply: property 'scale_2' is missing; export the scene again"
    >>> str(InputError("is not finite", path="a.ply", property="x", index=7))
    "a.ply: property 'x' of row 7 is not finite"
    >>> str(InputError("expected at least 1, got 0", parameter="count"))
    'count: expected at least 1, got 0'
    >>> str(OutputError("exists", path="a.ply", hint="{overwrite=True} replaces it"))
    'a.ply: exists; overwrite=True replaces it'
    """

    def __init__(
        self,
        message: str,
        *,
        parameter: str | None = None,
        path: str | Path | None = None,
        property: str | None = None,
        index: int | None = None,
        item: str = "row",
        hint: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.parameter = parameter
        self.path = None if path is None else Path(path)
        self.property = property
        self.index = index
        self.item = item
        self.hint = hint

    def __str__(self) -> str:
        return self.line()

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook prints instead of a traceback: one line, as in a terminal."""
        return [f"{type(self).__name__}: {self}"]

    def line(self, spelled: Callable[[str, str | None], str] = _as_argument) -> str:
        """Return the fields as one line.

        Args:
            spelled: function from a parameter and its value, or None, to text.
        """
        parts = [] if self.parameter is None else [spelled(self.parameter, None)]
        if self.path is not None:
            parts.append(str(self.path))
        at = [] if self.property is None else [f"property {self.property!r}"]
        if self.index is not None:
            at.append(f"{self.item} {self.index}")
        parts.append(" ".join([*filter(None, [" of ".join(at)]), self.message]))
        line = ": ".join(parts)
        if self.hint is None:
            return line
        return f"{line}; {_PARAMETER.sub(lambda found: spelled(found[1], found[2]), self.hint)}"

    def at(self, **fields: Any) -> Self:
        """Return a copy with changed fields.

        >>> str(InputError("is empty").at(path="a.ply"))
        'a.ply: is empty'
        """
        if fields.get("path") is not None:
            fields["path"] = Path(fields["path"])
        error = copy.copy(self)
        error.__dict__.update(fields)
        return error


class InputError(G2ardError, ValueError):
    """Invalid input: a bad file, shape, dtype or value."""


class UsageError(G2ardError, TypeError):
    """A call with unknown, missing or too many arguments."""


class OutputError(G2ardError, OSError):
    """Output that cannot be written, or exists and must not be overwritten."""


class MissingDependencyError(G2ardError, ImportError):  # type: ignore[misc]  # ImportError.path is a string
    """Missing optional package; the hint is the command that installs it."""


class DeviceError(G2ardError, RuntimeError):
    """Failure of a GPU during recovery, which continues on the CPU."""


def damaged(message: str, **fields: Any) -> InputError:
    """Return the error for a damaged file, with the hint to get it again."""
    return InputError(message, hint="the file is damaged: copy or export it again", **fields)


def missing(what: str, package: str, **fields: Any) -> MissingDependencyError:
    """Return the error for a feature whose optional package is not installed.

    Args:
        package: the package itself, which pip installs wherever g2ard came from; an extra of g2ard would not.

    >>> str(missing("reading .e57", "pye57"))
    'reading .e57 needs a package that is not installed; pip install pye57'
    """
    return MissingDependencyError(
        f"{what} needs a package that is not installed", hint=f"pip install {package}", **fields
    )


def explained(error: ImportError) -> ImportError:
    """Return the error for a checkout whose Rust extension is not built, or another error as it is."""
    if error.name != "g2ard._core":
        return error
    return MissingDependencyError(
        "this checkout has no Rust extension, and Python prefers it to an installed g2ard",
        path=Path(__file__).parents[1],
        hint="run `pip install -e .` or `make setup` there, or start Python in another folder",
    )


def require_torch(feature: str) -> None:
    """Check that torch can be imported, without importing it."""
    if find_spec("torch") is None:
        raise MissingDependencyError(f"{feature} needs torch", hint="pip install torch")


def require(name: str, value: object, fits: bool, expected: str) -> None:
    """Raise an `InputError` for a parameter's value unless `fits`."""
    if not fits:
        raise InputError(f"expected {expected}, got {value}", parameter=name)
