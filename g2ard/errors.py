"""What g2ard raises. Each message is one line that names the file, the property and the index at fault."""

from __future__ import annotations

__all__ = ["G2ardError", "InputError", "MissingDependencyError", "OutputError", "require"]


class G2ardError(Exception):
    """Base of every error the command line turns into one line and exit status 1."""


class InputError(G2ardError, ValueError):
    """The input is not what it should be: a bad file, shape, dtype or value."""


class OutputError(G2ardError, OSError):
    """The output cannot be written, or exists and may not be overwritten."""


class MissingDependencyError(G2ardError, ImportError):
    """An optional package is needed for this input; the message names the extra to install."""


def require(name: str, value: object, fits: bool, expected: str) -> None:
    """Raise an `InputError` for the value of a field unless it fits."""
    if not fits:
        raise InputError(f"{name}: expected {expected}, got {value}")
