"""No function over 80 lines, no file over 400, in Python and in Rust; what is longer has its reason here."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

FUNCTION, FILE = 80, 400

REASONS: dict[str, str] = {
    "g2ard/cli/commands/distill.py: distill": "a command's parameters are its options",
    "g2ard/cli/commands/lod.py: lod": "a command's parameters are its options",
    "g2ard/cli/commands/recover.py: recover": "a command's parameters are its options",
    "g2ard/cli/commands/register.py: register": "a command's parameters are its options",
    "g2ard/cli/commands/simplify.py: simplify": "a command's parameters are its options",
    "g2ard/cli/commands/bench/recover.py: recover": "a command's parameters are its options",
    "g2ard/cli/commands/bench/run.py: run_": "a command's parameters are its options",
}
"""What may be longer, and why."""


def python_functions(text: str) -> Iterator[tuple[str, int]]:
    """Every function's name and its lines, from `def` to its end, without the docstring."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            first = node.body[0]
            if ast.get_docstring(node, clean=False) is not None:
                lines -= (first.end_lineno or first.lineno) - first.lineno + 1
            yield node.name, lines


_FN = re.compile(r"^( *)(?:pub(?:\([a-z]+\))? )?(?:const )?(?:unsafe )?(?:extern \"C\" )?fn (\w+)")


def rust_functions(text: str) -> Iterator[tuple[str, int]]:
    """Every function's name and its lines: rustfmt puts the closing brace under the `fn` that it ends."""
    lines = text.split("\n")
    for number, line in enumerate(lines):
        if not (found := _FN.match(line)):
            continue
        indent, name = found.groups()
        for end, other in enumerate(lines[number:], number):
            head = other.rstrip().endswith(";") and "{" not in "".join(lines[number : end + 1])
            if head or other == f"{indent}}}" or (end == number and other.endswith("}")):
                yield name, end - number + 1
                break


def sources() -> Iterator[Path]:
    yield from sorted((ROOT / "g2ard").rglob("*.py"))
    yield from sorted((ROOT / "rust").rglob("*.rs"))


def too_long(paths: Iterator[Path]) -> dict[str, int]:
    """Files and functions over the limits: their lines."""
    found = {}
    for path in paths:
        text, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix()
        if (lines := text.count("\n")) > FILE:
            found[name] = lines
        functions = python_functions if path.suffix == ".py" else rust_functions
        found |= {f"{name}: {f}": lines for f, lines in functions(text) if lines > FUNCTION}
    return found


def test_nothing_is_longer_without_a_reason() -> None:
    if not (ROOT / "rust").is_dir():
        pytest.skip("the sources are not here")
    found = too_long(sources())
    assert not REASONS.keys() - found.keys(), "a reason for what is no longer long"
    long = {name: lines for name, lines in found.items() if name not in REASONS}
    assert not long, f"over {FUNCTION} lines a function or {FILE} a file: {long}"


def test_lines_are_counted_as_they_are_read() -> None:
    python = 'def short(\n    a,\n):\n    """One\n    two.\n    """\n    return a\n'
    assert dict(python_functions(python)) == {"short": 4}
    rust = "pub fn one() {}\nimpl T {\n    fn two(\n        a: u8,\n    ) -> u8 {\n        a\n    }\n"
    rust += "    fn three();\n}\n"
    assert dict(rust_functions(rust)) == {"one": 1, "two": 5, "three": 1}
    body = "".join(f"    let x{i} = {i};\n" for i in range(90))
    assert dict(rust_functions(f"fn long() {{\n{body}}}\n")) == {"long": 92}
