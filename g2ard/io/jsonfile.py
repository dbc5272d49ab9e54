"""JSON files checked against types; errors name the file, the entry and the property."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from g2ard.errors import InputError
from g2ard.io.paths import about, read_text

_LARGEST_NUMBER = sys.float_info.max
_LONGEST_SHOWN_VALUE = 40  # longest value in a message, characters

_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a string",
    "array": "a list",
    "object": "an object",
}
"""msgspec's names of types → those of messages."""

Value = TypeVar("Value")

Json = dict[str, Any]
"""An object."""

Number = Annotated[float, Meta(ge=-_LARGEST_NUMBER, le=_LARGEST_NUMBER)]
Within1 = Annotated[float, Meta(ge=-1, le=1)]
Weight = Annotated[float, Meta(ge=0, le=_LARGEST_NUMBER)]
Positive = Annotated[float, Meta(gt=0, le=_LARGEST_NUMBER)]
Vector = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Matrix = tuple[Vector, Vector, Vector]
Pose = Annotated[list[Row], Meta(min_length=3, max_length=4)]
"""Finite numbers, alone and in lists; a pose has 3×4 or 4×4."""


class Whole(int):
    """A whole number ≥ 0 (80 or 80.0)."""


class FileName(str):
    """The name of a file, not empty and printable."""


@dataclass(frozen=True, slots=True)
class Place:
    """Location of a value in a file: an entry and a property, such as a.b[2]."""

    path: Path
    index: int | None = None
    item: str = "entry"
    property: str = ""

    def to(self, *keys: str | int) -> Place:
        """Return the place of a property, or of an entry of a list."""
        path = self.property
        for key in keys:
            if isinstance(key, int):
                path += f"[{key}]"
            else:
                path += f".{key}"
        return replace(self, property=path.removeprefix("."))

    def error(self, message: str) -> InputError:
        return InputError(
            message,
            path=self.path,
            property=self.property or None,
            index=self.index,
            item=self.item,
        )


def read_json(path: Path) -> Json:
    """Return the object in a JSON file."""
    return checked(read_any_json(path), Json, Place(path))


def read_own(path: Path, format: str, version: int) -> Json:
    """Return the object in a JSON file of g2ard's, which states this format and version."""
    content = read_json(path)
    stated = content.get("format")
    if stated != format:
        raise Place(path).to("format").error(f"is {stated!r}, expected {format!r}")
    stated = content.get("version")
    if stated != version:
        text = f"unsupported version {stated!r}; expected {version}"
        raise InputError(text, path=path)
    return content


def read_any_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    with about(path):
        return parse_json(read_text(path))


def parse_json(text: str) -> Any:
    """Return the content of JSON text.

    Text in another character set than UTF-8 becomes Latin 1, in which names of files can be found.
    """
    if not text.isascii() and any("\udc80" <= letter <= "\udcff" for letter in text):
        text = text.encode("utf-8", "surrogateescape").decode("latin-1")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON ({error.msg})", index=error.lineno, item="line") from error
    except RecursionError as error:
        raise InputError("is nested too deeply") from error
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"not JSON ({error})") from error


def checked(
    value: Any,
    kind: type[Value],
    place: Place,
    entries: str | None = None,
) -> Value:
    """Return JSON content as a type that msgspec knows, such as a struct.

    Args:
        place: location of the content, for errors.
        entries: unit of the first list in the content, whose index is that of errors.

    Raises:
        InputError: a property is missing, or not of its type.

    >>> Part = msgspec.defstruct("Part", [("shape", list[int])])
    >>> checked({"shape": [3, "four"]}, Part, Place(Path("a.json")))
    Traceback (most recent call last):
    ...
    g2ard.errors.InputError: a.json: property 'shape[1]' is the string 'four', expected a whole number
    """
    try:
        return msgspec.convert(value, kind, dec_hook=_special)
    except msgspec.ValidationError as error:
        message, _, at = str(error).partition(" - at `$")
    except RecursionError:
        raise place.error("is nested too deeply") from None
    for name, number in re.findall(r"\.([^.\[`]+)|\[(\d+)\]", at):
        key = int(number) if number else name
        value = value[key]
        if number and entries is not None and place.index is None:
            place = Place(place.path, int(number), entries)
        else:
            place = place.to(key)
    lacking = re.fullmatch("Object missing required field `(.+)`", message)
    if lacking:
        raise place.to(lacking[1]).error("is missing")
    length = re.search(r"length (?:>= )?(\d+)", message)
    if length and len(value) < int(length[1]):
        raise place.to(len(value)).error("is missing")
    raise place.error(f"is {_found(value)}, {_wanted(message)}")


def _special(kind: type, value: Any) -> Any:
    if kind is Whole:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if is_number and 0 <= value <= _LARGEST_NUMBER and value % 1 == 0:
            return Whole(value)
        raise ValueError("expected a whole number ≥ 0")
    if isinstance(value, str) and value and value.isprintable():
        return FileName(value)
    raise ValueError("expected the name of a file")


def _wanted(message: str) -> str:
    """Return what msgspec expected instead, in the words of other messages."""
    if message.startswith("Invalid enum value"):
        return "which is not supported"
    wanted = message.partition(", got ")[0].replace("`", "")
    if wanted == "Number out of range" or "e+308" in wanted:
        return "expected a finite number"
    wanted = wanted.removesuffix(" | null").replace("length <= ", "at most ").replace("length ", "")
    wanted = re.sub(r"\w+", lambda word: _WORDS.get(word[0], word[0]), wanted)
    return wanted[:1].lower() + wanted[1:]


def _found(value: Any) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int) and abs(value) >= 10**_LONGEST_SHOWN_VALUE:
        return "an integer of many digits"
    if isinstance(value, str) and len(value) > _LONGEST_SHOWN_VALUE:
        value = f"{value[: _LONGEST_SHOWN_VALUE // 2]}…{value[-_LONGEST_SHOWN_VALUE // 4 :]}"
    if isinstance(value, str):
        return f"the string {value!r}"
    return repr(value)
