"""Every command of the documentation runs as printed, on small stand-ins for its files."""

import re
import shlex
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.study import DEFINITIONS, read_study
from helpers.commands import CommandLine
from helpers.project import ROOT
from helpers.stand_ins import OF_PAGE, PLACEHOLDERS, SHRUNK, STAND_INS, provide, shrunk

PAGES = [
    str(page.relative_to(ROOT))
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/README.md")
    for page in sorted(ROOT.glob(pattern))
]

NOT_RUN = {
    r"pip install .*": "installs packages; tests/release/check.py does from a wheel",
    r"make \S+.*": "builds or measures for minutes; tests/test_docs.py knows the targets",
    r"rustup target add .*": "downloads a toolchain",
    r"colmap .*": "another program",
    r"\.venv/bin/python tests/goldens\.py .*": "takes minutes; tests/test_goldens.py runs a slice",
    r"python -m http\.server .*": "a server that does not end",
    r"dask (scheduler|worker)\b.*": "a server that does not end; tests/tiles starts one",
    r"python -m benchmarks synth .*": "takes a minute; tests/benchmarks/test_synth.py makes a small one",
    r"g2ard register .* --pool train.json .*": "takes a minute; tests/stages/test_register.py tries a pool",
}
"""Pattern of a command → why it does not run here."""

if shutil.which("ffmpeg") is None:
    NOT_RUN[r"g2ard render .*\.mp4"] = "needs ffmpeg, which is not installed"

STUDIES = r"python -m benchmarks run .*"
"""Studies take minutes, and tests/benchmarks runs each kind; here their names and options are checked."""


PAGED = "README.md"
"""Page whose runs write view.html too; tests/cli/test_pages.py and others test those."""


def is_complete(words: list[str]) -> bool:
    """Return whether code quoted in a sentence is a command, and not only the name of one or of an option."""
    names = {*STAND_INS, *PLACEHOLDERS}
    return any(word.split("/")[0] in names or word in ("--devices", "--version") for word in words)


def commands_of(text: str) -> Iterator[str]:
    """Yield the lines of a page's shell blocks, and the complete commands quoted in its text."""
    for block in re.findall(r"(?ms)^ *```(?:sh|bash)\n(.*?)^ *```", text):
        for line in block.replace("\\\n", " ").splitlines():
            yield from (shlex.join(words) for words in parts(line))
    for quoted in re.findall(r"`([^`\n]+)`", re.sub(r"(?ms)^ *```.*?^ *```", "", text)):
        if re.match(r"(g2ard|python -m benchmarks) ", quoted) and is_complete(quoted.split()):
            yield from (shlex.join(words) for words in parts(quoted))


def parts(line: str) -> list[list[str]]:
    """Split a line of shell into its commands' words, without comments."""
    found: list[list[str]] = [[]]
    for word in shlex.split(line, comments=True):
        if word in ("&&", ";"):
            found.append([])
        else:
            found[-1].append(word)
    return [words for words in found if words]


class Reader:
    """Types a page's commands in a folder."""

    def __init__(self, page: str, folder: Path, store: Path, command_line: CommandLine) -> None:
        self.page, self.folder, self.store, self.command_line = page, folder, store, command_line
        (folder / "small.toml").write_text(SHRUNK)

    def types(self, command: str) -> None:
        words = [PLACEHOLDERS.get(word, word) for word in shlex.split(command)]
        program = words[:1] if words[0] == "g2ard" else words[:3]
        arguments = shrunk(words[len(program) :])
        self._clear(arguments)
        for before, word in zip(["", *arguments], arguments, strict=False):
            if before != "-o":
                provide(word, self.folder, self.page, self.store)
        assert program in (["g2ard"], ["python", "-m", "benchmarks"]), (
            f"{self.page}: `{command}` is not run"
        )
        small = ["--config", "small.toml"] if f"[{arguments[0]}]" in SHRUNK else []
        if re.fullmatch(STUDIES, command):
            assert (
                arguments[1].endswith(".toml") or (DEFINITIONS / f"{arguments[1]}.toml").is_file()
            )
            small = ["--print-config"]
        if arguments[0] == "distill" and self.page != PAGED and "page:" not in command:
            small.append("--no-page")
        status, _, error = self.command_line(*program[2:], *arguments, *small, cwd=self.folder)
        assert status == 0, f"{self.page}: {command}\n{error}"

    def _clear(self, arguments: list[str]) -> None:
        """Remove an output of the same name: the lines of a page are examples of their own."""
        for option, value in pairwise(arguments):
            if option == "-o" and (self.folder / value).exists():
                path = self.folder / value
                shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("stand_ins")


def runnable(page: str) -> list[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    found = dict.fromkeys(commands_of(text))
    return [command for command in found if not any(re.fullmatch(no, command) for no in NOT_RUN)]


@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page)])
def test_the_commands_of_a_page_run(
    page: str, tmp_path: Path, store: Path, command_line: CommandLine
) -> None:
    reader = Reader(page, tmp_path, store, command_line)
    for command in runnable(page):
        reader.types(command)
    if page == "docs/datasets.md":  # its maps are those that the study of poses reads
        study = read_study(DEFINITIONS / "paper/kings_college_registration.toml")
        missing = [
            p
            for scene in study.scenes
            if not Path(p := scene.prior.replace("$CAMBRIDGE", str(tmp_path))).exists()
        ]
        assert missing == []


def test_every_reason_and_stand_in_is_used() -> None:
    texts = {page: (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
    commands = [command for text in texts.values() for command in commands_of(text)]
    assert [
        no for no in NOT_RUN if not any(re.fullmatch(no, command) for command in commands)
    ] == []
    everything = "\n".join(texts.values())
    unused = [name for name in (*STAND_INS, *PLACEHOLDERS) if name not in everything]
    assert unused == []
    assert [page for page in OF_PAGE if page not in PAGES] == []
