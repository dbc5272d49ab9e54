"""Compare what the documentation prints with what the commands print, or record it anew.

    python tests/printed.py compare            # exit status 1 if a line or a figure differs
    python tests/printed.py record             # write the program's lines and figures into the pages
    python tests/printed.py record --page README.md --quick

A block or paragraph names its commands in a comment above it: `<!-- printed by: g2ard … && g2ard … -->`, or
`printed slowly by`. `$DATA` is the folder of real scenes. The commands of a comment run in one empty folder.
Each line of a block must be among the lines that they print; figures of a paragraph must be among theirs.

Counts must be equal. Other figures may differ by what another processor changes, and times are ignored.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[up]) for up in (0, 1)]

import pytest

from helpers import notebooks, realdata
from helpers.project import ROOT, environment

MARK = re.compile(
    r"<!-- printed (?P<slow>slowly )?by: (?P<commands>[^\n]+?) -->\n+"
    r"(?P<text>```\n(?:.*?\n)```|(?:[^\n]+\n)+)",
    re.DOTALL,
)
TIMES = re.compile(r"[\d.,]+ (?:s|min|minutes|seconds|steps/s)\b")
NAMES = re.compile(r"(?=[\w/-]*\d)(?=[\w/-]*[A-Za-z_])[\w/-]+(?:\.\w+)?|\d+\.(?:jpg|png)")
NUMBERS = re.compile(r"\d[\d,]*(?:\.\d+)?")
_FIGURE = r"(?:\d[\d,]*\.\d+|\d{1,3}(?:,\d{3})+)"
"""Numbers of a paragraph that are checked: with decimals, or with thousands."""


@dataclass(frozen=True)
class Passage:
    """A block or paragraph of a page, and the commands that print it."""

    page: str
    commands: str
    slow: bool
    text: str

    @property
    def missing(self) -> list[str]:
        """Real files and folders that the commands read and that are not there."""
        named = re.findall(r"\$DATA/(\S+)", self.commands)
        return [name for name in named if not (realdata.ROOT / name).exists()]

    def renewed(self, printed: str) -> tuple[str, list[str]]:
        """Return the text with the program's lines and figures, and what differs or is not found."""
        if not self.text.startswith("```"):
            return _renewed_figures(self.text, printed)
        return _renewed_lines(self.text, printed.splitlines())


def passages(page: str) -> Iterator[Passage]:
    """Yield the marked passages of a page."""
    for found in MARK.finditer((ROOT / page).read_text(encoding="utf-8")):
        yield Passage(page, found["commands"], bool(found["slow"]), found["text"])


def pages() -> list[str]:
    found = [*ROOT.glob("*.md"), *sorted(ROOT.glob("docs/**/*.md"))]
    return [str(page.relative_to(ROOT)) for page in found]


@cache
def printed_by(commands: str) -> str:
    """Return what commands print, in an empty folder, without the path of the real scenes."""
    told = []
    with tempfile.TemporaryDirectory() as folder:
        for command in commands.split(" && "):
            words = command.replace("$DATA", str(realdata.ROOT)).split()
            rest = ["-m", *words] if words[0] == "g2ard" else words[1:]
            done = subprocess.run(
                [sys.executable, *rest],
                cwd=folder,
                env=environment(COLUMNS="80"),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                encoding="utf-8",
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}"
            told.append(done.stdout)
    return "".join(told).replace(f"{realdata.ROOT}/", "")


def _shape(line: str) -> str:
    """Return a line without its times, names and numbers, to find it by.

    >>> _shape("│ given │ 10 │ 16.40 → 32.97 │ IMG_9418.jpg 26.71 │") == _shape(
    ...     "│ given │     7 │ 9.1 → 3.2 │ 0110.jpg 28.24 │")
    True
    """
    text = TIMES.sub("~", " ".join(re.sub(r"([━─])+", r"\1", line).split()))
    return NUMBERS.sub("#", NAMES.sub("@", text))


def _numbers(line: str) -> list[str]:
    return NUMBERS.findall(NAMES.sub("@", TIMES.sub("~", line)))


def _alike(first: str, second: str) -> bool:
    """Return whether two figures differ by no more than another processor changes.

    >>> _alike("20,000", "20,001"), _alike("32.97", "33.02"), _alike("0.9045", "0.8045")
    (False, True, False)
    """
    a, b = _number(first), _number(second)
    if "." not in first + second:
        return a == b
    return abs(a - b) <= (0.01 if _decimals(first) > 2 else max(0.2, 0.01 * abs(a)))


def _renewed_lines(block: str, printed: list[str]) -> tuple[str, list[str]]:
    lines, wrong, at = [], [], 0
    for line in block.splitlines():
        if line.startswith("```"):
            lines.append(line)
            continue
        rows = [row for row, other in enumerate(printed) if _shape(other) == _shape(line)]
        if not rows:
            wrong.append(f"not printed: {line}")
            lines.append(line)
            continue
        at = next((row for row in rows if row >= at), rows[0])
        found = printed[at].rstrip()
        if not all(map(_alike, _numbers(line), _numbers(found))):
            wrong.append(f"{line}\n  is now {found}")
        lines.append(found)
        at += 1
    return "\n".join(lines), wrong


def _renewed_figures(text: str, printed: str) -> tuple[str, list[str]]:
    """Renew the figures of a paragraph by the nearest printed ones; `A to B` is printed as `A → B`."""
    wrong = []
    pairs = [" to ".join(pair) for pair in re.findall(rf"({_FIGURE}) → ({_FIGURE})", printed)]

    def renewed(found: re.Match[str]) -> str:
        old = _values(found[0])
        known = pairs if len(old) > 1 else re.findall(_FIGURE, printed)
        like = [
            one for one in known if list(map(_decimals, _values(one))) == list(map(_decimals, old))
        ]

        def distance(one: str) -> float:
            return sum(abs(_number(a) - _number(b)) for a, b in zip(_values(one), old, strict=True))

        new = min(like, key=distance, default=found[0])
        if not like or not all(map(_alike, old, _values(new))):
            wrong.append(f"{found[0]} is not printed; the nearest is {new}")
        return new

    return re.sub(rf"{_FIGURE}(?: to {_FIGURE})?", renewed, text), wrong


def _values(figures: str) -> list[str]:
    return figures.split(" to ")


def _number(text: str) -> float:
    return float(text.replace(",", ""))


def _decimals(text: str) -> int:
    return len(text.partition(".")[2])


def renewed_notebook() -> tuple[str, list[str]]:
    """Return the example notebook as it runs on the real scene, and what differs."""
    notebook = notebooks.read()
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("G2ARD_DATA", str(realdata.ROOT))
        patch.delenv("G2ARD_SCENE", raising=False)
        found = notebooks.execute(notebook, {}, Path(folder))
    wrong = []
    for cell, outputs in zip(notebooks.code_of(notebook), found, strict=True):
        wrong += differences(notebooks.text_of(cell["outputs"]), notebooks.text_of(outputs))
    return notebooks.written(notebook, found), wrong


def differences(lines: list[str], others: list[str]) -> list[str]:
    """Return the lines whose shape or figures differ from the others', and missing ones."""
    pairs = zip_longest(lines, others, fillvalue="")
    return [
        f"{line}\n  is now {other}"
        for line, other in pairs
        if _shape(line) != _shape(other) or not all(map(_alike, _numbers(line), _numbers(other)))
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("do", choices=("compare", "record"))
    parser.add_argument("--page", action="append", help="only this page")
    parser.add_argument(
        "--quick", action="store_true", help="only what takes less than about 20 seconds"
    )
    given, wrong = parser.parse_args(), 0
    for page in given.page or pages():
        for passage in passages(page):
            if passage.missing or (given.quick and passage.slow):
                print(f"{page}: skipped: {passage.commands}", flush=True)
                continue
            text, found = passage.renewed(printed_by(passage.commands))
            wrong += len(found)
            print(f"{page}: {passage.commands}", *found, sep="\n  ", flush=True)
            if given.do == "record":
                path = ROOT / page
                now = path.read_text(encoding="utf-8").replace(passage.text, text, 1)
                path.write_text(now, encoding="utf-8", newline="\n")
    if not given.page and not given.quick and (realdata.ROOT / "playbot").exists():
        text, found = renewed_notebook()
        wrong += len(found)
        print("examples/quickstart.ipynb", *found, sep="\n  ")
        if given.do == "record":
            notebooks.QUICKSTART.write_text(text, encoding="utf-8", newline="\n")
    return int(given.do == "compare" and wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
