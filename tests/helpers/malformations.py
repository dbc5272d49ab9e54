"""Malformed files by rule: each differs from a valid one in one place, and no two are alike.

JSON: every property absent or of another kind. Text: every word and line wrong, absent or twice. Binary:
every word of the head at an extreme. All: cut short.
"""

import gzip
import json
import re
import struct
from collections.abc import Iterator
from typing import Any

WRONG: tuple[Any, ...] = (None, True, "x", "", -1, 1e300, [], {}, [[]], ["x"])
"""Values of other types that replace a JSON property."""
RAW = ("NaN", "1e999", "1" + "0" * 400)
"""The same as text, for what no program writes."""

_PLACES = 3
"""Entries of a list that are changed: the rest are like them."""
_HEAD = 32
"""Words of a binary file that are changed."""
_WORDS = 30
"""Words, and lines, of a text that are changed: evenly over it."""
_CUTS = 20


def malformed(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield malformed versions of a valid file of any format, each with a description."""
    if content[:2] == b"\x1f\x8b":
        for what, data in malformed(gzip.decompress(content)):
            yield f"gzip of {what}", gzip.compress(data, 1, mtime=0)
        yield from _cut(content)
    elif content[:1] in b"{[":
        yield from _json(content)
        yield from _cut(content)
    elif b"\0" not in content and content.isascii():
        yield from _text(content)
        yield from _cut(content)
    else:
        if content.startswith(b"ply"):
            head, end, body = content.partition(b"end_header\n")
            for what, data in _text(head):
                yield what, data + end + body
        else:
            yield from _binary(content)
        yield from _cut(content)


def _json(content: bytes) -> Iterator[tuple[str, bytes]]:
    document = json.loads(content)
    mark = "\uffff"
    for path in list(_paths(document)):
        name = ".".join(map(str, path))
        yield f"lacks {name}", json.dumps(_changed(document, path)).encode()
        for value in WRONG:
            yield f"{name} is {value!r}", json.dumps(_changed(document, path, value)).encode()
        marked = json.dumps(_changed(document, path, mark))
        for value in RAW:
            yield f"{name} is {value[:6]}", marked.replace(json.dumps(mark), value).encode()
    for value in WRONG:
        yield f"{value!r}", json.dumps(value).encode()


def _paths(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of every property and of the first entries of every list."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:_PLACES])
    for key, entry in list(inner):
        yield (*at, key)
        if isinstance(entry, dict | list):
            yield from _paths(entry, (*at, key))


def _changed(document: Any, path: tuple[Any, ...], *value: Any) -> Any:
    """Return a copy with another value at a path, or without that path."""
    copy = json.loads(json.dumps(document))
    holder = copy
    for key in path[:-1]:
        holder = holder[key]
    if value:
        holder[path[-1]] = value[0]
    else:
        del holder[path[-1]]
    return copy


def _text(content: bytes) -> Iterator[tuple[str, bytes]]:
    words = list(re.finditer(rb"[^\s,:\[\]{}\"']+", content))
    for word in words[:: -(-len(words) // _WORDS)]:
        for wrong in (b"", b"x", b"-1", b"nan", b"1e999", b"9" * 30, b"1 1", b"\xff", b"\0"):
            changed = content[: word.start()] + wrong + content[word.end() :]
            yield f"{word[0].decode()} at {word.start()} is {wrong!r}", changed
    lines = content.splitlines(keepends=True)
    for at in range(min(len(lines), _WORDS)):
        yield f"lacks line {at + 1}", b"".join(lines[:at] + lines[at + 1 :])
        yield f"line {at + 1} twice", b"".join(lines[: at + 1] + lines[at:])


def _binary(content: bytes) -> Iterator[tuple[str, bytes]]:
    for at in range(0, min(4 * _HEAD, len(content) - 8), 4):
        for value in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FC00000, 0x7F800000):
            data = bytearray(content)
            struct.pack_into("<I", data, at, value)
            yield f"{value:#x} at {at}", bytes(data)
        yield f"2**63 at {at}", content[:at] + struct.pack("<Q", 1 << 63) + content[at + 8 :]


def _cut(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Cut at even steps, and after each of the first and the last bytes."""
    steps = {len(content) * i // _CUTS for i in range(_CUTS)}
    for size in sorted(steps | set(range(12)) | set(range(len(content) - 12, len(content)))):
        if 0 <= size < len(content):
            yield f"cut at {size}", content[:size]
