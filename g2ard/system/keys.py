"""Keys: hashes of everything that a result depends on."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

UNKEYED = {"key": False}
"""Metadata of a dataclass's field that results do not depend on."""


def key_of(value: object) -> str:
    """Return 16 hexadecimal digits of a hash of a value with all that it holds.

    Dataclasses count with all fields but the `UNKEYED`, or their `fingerprint()`; paths by their names,
    because files of steps have hashes in theirs.

    >>> key_of([1, None, {"a": np.zeros(2)}]) == key_of((1, None, {"a": np.zeros(2)}))
    True
    >>> key_of(np.zeros(2)) == key_of(np.zeros((2, 1)))
    False
    """
    digest = hashlib.sha256()
    _feed(digest.update, value)
    return digest.hexdigest()[:16]


def keyed(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that results depend on."""
    return {f.name: getattr(value, f.name) for f in fields(value) if f.metadata.get("key", True)}


def _feed(update: Callable[[Any], None], value: Any) -> None:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        update(f"array {value.dtype.str} {value.shape} ".encode())
        update(np.ascontiguousarray(value).reshape(-1).view(np.uint8))
    elif hasattr(value, "fingerprint"):
        _feed(update, [type(value).__qualname__, value.fingerprint()])
    elif is_dataclass(value):
        _feed(update, [type(value).__qualname__, keyed(value)])
    elif isinstance(value, Mapping):
        _feed(update, sorted(value.items(), key=lambda item: str(item[0])))
    elif isinstance(value, list | tuple):
        update(f"{len(value)} items ".encode())
        for item in value:
            _feed(update, item)
    elif value is None or isinstance(value, bool | int | float | str | bytes | Path):
        text = repr(value.name if isinstance(value, Path) else value)
        update(f"{len(text)} letters {text} ".encode(errors="surrogatepass"))
    else:
        raise TypeError(f"a value of type {type(value).__name__} has no key")
