"""Dataclasses as lines of a CSV that grows while a benchmark runs and is taken up again after a stop."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Row = TypeVar("Row", bound=DataclassInstance)

__all__ = ["append", "read", "rewrite"]

_DIGITS = 6


def read(path: Path, kind: type[Row]) -> list[Row]:
    """The rows of a CSV, none if there is no such file; fields must be int, float, str or optional ones.

    A file from before the last columns came takes their defaults.

    Raises:
        InputError: it was not written from `kind`.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        lines = csv.DictReader(file)
        known, held = fields(kind), lines.fieldnames or []
        if held != [f.name for f in known[: len(held)]] or any(
            f.default is MISSING for f in known[len(held) :]
        ):
            raise InputError(f"{path}: has other columns than this benchmark's")
        return [_row(path, number, line, kind) for number, line in enumerate(lines, 2)]


def _row(path: Path, number: int, line: dict[str, str], kind: type[Row]) -> Row:
    try:
        return kind(**{f.name: _value(line[f.name], str(f.type)) for f in fields(kind) if f.name in line})
    except (TypeError, ValueError):
        raise InputError(f"{path}: line {number}: not a row of this benchmark") from None


def _value(text: str, kind: str) -> Any:
    if text == "" and "None" in kind:
        return None
    if kind.startswith("int"):
        return int(text)
    return float(text) if kind.startswith("float") else text


def rewrite(path: Path, rows: Iterable[Row], kind: type[Row]) -> None:
    """Replace the file by these rows, whole or not at all."""
    with (
        atomic_output(path, overwrite=True) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, [f.name for f in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(_line(row) for row in rows)


def append(path: Path, rows: Sequence[Row]) -> None:
    """Add rows to a file that `rewrite` made."""
    with path.open("a", newline="", encoding="utf-8") as file:
        for row in rows:
            csv.DictWriter(file, [f.name for f in fields(row)], lineterminator="\n").writerow(_line(row))


def _line(row: Row) -> dict[str, Any]:
    return {k: round(v, _DIGITS) if isinstance(v, float) else v for k, v in asdict(row).items()}
