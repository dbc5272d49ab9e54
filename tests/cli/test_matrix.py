"""Properties of every command, tested on the calls of `helpers/calls.py`."""

import json
import os
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any

import pytest

import g2ard._core as _core
from g2ard.cli.app import COMMANDS
from g2ard.cli.console import Console
from g2ard.io import detect
from g2ard.io.source import Source
from g2ard.stages.recover import checkpoint
from g2ard.tiles import tasks
from helpers.calls import CALLS, FIRST, WRITING, options_of, output_of
from helpers.commands import CommandLine, refused, succeeds
from helpers.killed import command, forked, killed

CHEAP = {
    "defaults",
    "device_notes",
    "device_state",
    "num_threads",
    "psnr",
    "set_device",
    "set_threads",
    "worker",
}
"""Functions of the core that only read or set its state, or compare two images."""
_TIMES = re.compile(r"seconds|time|rss|resumed|peak|^share$|^bytes$|config|^inputs$")
"""Keys of JSON that may differ between two runs of a call, one of which reads a config file."""
_UNEQUAL = (".html", ".png")
"""Suffixes of files that hold times, or bytes that depend on them."""

RESUMED = [name for name in CALLS if "resume" in options_of(name)]
REPEATED = [*RESUMED, "ingest", "ingest a cloud"]
"""Calls that finish the work of a killed run."""


def left(folder: Path) -> dict[str, Any]:
    """Return the files of a folder: their content without durations; of pages and pictures only the names."""
    found: dict[str, Any] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content: Any = None if path.suffix in _UNEQUAL else path.read_bytes()
        if path.suffix == ".json":
            content = _untimed(json.loads(content))
        found[path.relative_to(folder).as_posix()] = content
    return found


def _untimed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _untimed(item) for key, item in value.items() if not _TIMES.search(key)}
    return [_untimed(item) for item in value] if isinstance(value, list) else value


def test_every_command_has_a_call() -> None:
    assert {name.split()[0] for name in CALLS} == set(COMMANDS)
    assert {name.split()[0] for name in CALLS} - {name.split()[0] for name in WRITING} == {"info"}


class Watched:
    """Kernels that it runs within and outside of them, and how often
    it detects and opens each file."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.detected: Counter[str] = Counter()
        self.opened: Counter[str] = Counter()
        self.inside: set[str] = set()
        self.outside: set[str] = set()
        self.console: Console | None = None
        enter = Console.__enter__

        def entered(console: Console) -> Console:
            self.console = console
            return enter(console)

        monkeypatch.setattr(Console, "__enter__", entered)
        for name, kernel in list(vars(_core).items()):
            if isinstance(kernel, BuiltinFunctionType) and name not in CHEAP:
                monkeypatch.setattr(_core, name, partial(self._call, kernel))
        # the former without its cache
        detect_file, open_source = detect._of_file.__wrapped__, Source._open

        def detecting(path: Path, *more: Any) -> Any:
            self.detected[path.resolve().name] += 1
            return detect_file(path, *more)

        def opening(source: Source, *more: Any) -> Any:
            if not source.others:  # joined sources open each by itself
                self.opened[source.file.resolve().name] += 1
            return open_source(source, *more)

        monkeypatch.setattr(detect, "_of_file", detecting)
        monkeypatch.setattr(Source, "_open", opening)

    def _call(self, kernel: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        stage = self.console and self.console._stage
        if stage is None or stage.ended is not None:
            self.outside.add(f"{kernel.__name__} after {stage and stage.name}")
        else:
            self.inside.add(kernel.__name__)
        return kernel(*arguments, **named)


Ran = Callable[[str], tuple[Path, Watched]]


@pytest.fixture(scope="module")
def ran(inputs: Path, tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine) -> Ran:
    """Runs a command once, and returns the folder to copy."""

    @cache
    def run(words: str) -> tuple[Path, Watched]:
        folder = shutil.copytree(inputs, tmp_path_factory.mktemp("ran") / "files")
        with pytest.MonkeyPatch.context() as patches:
            watched = Watched(patches)
            succeeds(command_line, folder, *words.split())
        return folder, watched

    return run


@pytest.fixture
def made(name: str, ran: Ran, tmp_path: Path) -> Path:
    """A folder in which the call of a test was run."""
    return shutil.copytree(ran(CALLS[name])[0], tmp_path / "files")


MORE = [
    "distill ball.ply -r 8 --views made --steps 2 --size 24 -o out",
    "distill cloud.ply -r 8 --views photos.json --steps 2 -o out",
    "simplify ball.ply --min-psnr 25 -o out.ply",
    "simplify ball.ply -r 4,8 -o small_{ratio}.ply",
    "simplify cloud.ply -r 4 -o out.ply",
    "lod ball.ply -r 1,2,4 --steps 2 --size 24 -o out",
    "compare ball.ply other.ply -k 3 --size 24 -o out.html",
]
"""Calls with other stages."""


@pytest.mark.parametrize("words", [*CALLS.values(), *MORE])
def test_kernels_run_within_stages(words: str, ran: Ran) -> None:
    _, watched = ran(words)
    assert watched.outside == set()
    if words.startswith("simplify") and "--tile-rows" not in words:
        assert "simplify_pairwise" in watched.inside


READING = [
    *CALLS.values(),
    "info ball.ply cloud.ply",
    "simplify cloud.ply -r 4 --no-views -o lifted.ply",
    *(
        f"{CALLS[name]} --dry-run"
        for name in ("distill", "distill tiles", "simplify", "simplify tiles", "recover", "lod")
    ),
]


@pytest.mark.parametrize("words", READING)
def test_an_input_is_opened_once(words: str, inputs: Path, ran: Ran) -> None:
    _, watched = ran(words)
    given = Counter(
        word for word in words.split() if word.endswith(".ply") and (inputs / word).exists()
    )
    assert given
    for name, times in given.items():  # a scene may be the teacher too
        assert (watched.detected[name], watched.opened[name]) == (times, times), name


@pytest.mark.parametrize("name", WRITING)
def test_outputs_are_replaced_only_on_request(
    name: str, made: Path, inputs: Path, command_line: CommandLine
) -> None:
    """No call writes another output. A printed config repeats the call, and --dry-run writes nothing."""
    words, files = CALLS[name].split(), left(made)
    assert output_of(name) in files or (made / output_of(name)).is_dir()
    for path in sorted(files.keys() - left(inputs).keys()):
        assert "--json" in refused(command_line, made, *words, "-w", "--json", path), path
    if not name.startswith("ingest"):  # which finds its tiles finished
        assert "-w" in refused(command_line, made, *words, status=1)
    if "dry_run" in options_of(name):
        succeeds(command_line, made, *words, "--dry-run", "-w")
    assert left(made) == files
    config = succeeds(command_line, made, *words, "--print-config").out
    (made / "call.toml").write_text(config)
    succeeds(command_line, made, words[0], "--config", "call.toml", "-w")
    assert left(made) == files | {"call.toml": config.encode()}


@pytest.mark.parametrize("name", FIRST)
def test_one_of_two_runs_writes_the_output(
    name: str,
    inputs: Path,
    tmp_path: Path,
    command_line: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other run begins when the first has read its inputs."""
    folder, words = shutil.copytree(inputs, tmp_path / "files"), CALLS[name].split()
    runs: list[Any] = []
    tell = Console.__call__

    def told(console: Console, stage: str, *more: Any) -> None:
        if not runs and stage != "read":
            runs.append(None)
            runs[0] = command_line(*words, cwd=folder)
        tell(console, stage, *more)

    monkeypatch.setattr(Console, "__call__", told)
    runs.append(command_line(*words, cwd=folder))
    assert sorted(status for status, _, _ in runs) == [0, 1], runs
    error = next(error for status, _, error in runs if status)
    assert re.search(rf"\b{words[-1].partition('/')[0]}: (in use by process|exists; -w)", error), (
        error
    )
    assert not list(folder.glob("**/*.lock"))


@pytest.mark.parametrize("name", RESUMED)
def test_only_the_same_command_on_the_same_files_is_finished(
    name: str, tmp_path: Path, inputs: Path, command_line: CommandLine
) -> None:
    folder, words = shutil.copytree(inputs, tmp_path / "files"), CALLS[name].split()
    succeeds(command_line, folder, *words)
    files = left(folder)
    told = succeeds(command_line, folder, *words, "--resume").err
    assert ("already finished" in told, told.count("\n")) == (True, 1), told
    for option, value in (("background", "white"), ("seed", "5"), ("size", "20")):
        line = refused(command_line, folder, *words, f"--{option}", value, "--resume", status=1)
        assert f"finished with other options ({option})" in line
    read = [folder / word for word in words if (inputs / word).is_file()]
    read += [folder / "photos" / "view_003.png"] if words[0] == "distill" else []
    assert len(read) > 1
    for path in read:
        content, times = path.read_bytes(), path.stat()
        at = len(content) // 2
        other = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
        for new, later in ((other, -(10**12)), (other, 0), (other, 10**12), (content + b"\n", 0)):
            path.write_bytes(new)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + later))
            line = refused(command_line, folder, *words, "--resume", status=1)
            assert f"finished before {path.relative_to(folder).as_posix()} changed" in line
        path.write_bytes(content)  # a file is what it holds, whenever it was written
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + 10**12))
    assert "already finished" in succeeds(command_line, folder, *words, "--resume").err
    assert left(folder) == files


@pytest.mark.parametrize("name", [name for name in RESUMED if "--merge-only" not in CALLS[name]])
def test_half_written_files_are_written_again(
    name: str, made: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, words, files = made, CALLS[name].split(), left(made)
    saved: list[Path] = []

    def stopping(save: Callable[..., None]) -> Callable[..., None]:
        def stopped(path: Path, *content: Any) -> None:
            save(path, *content)
            saved.append(folder / path)
            if len(saved) == 2:
                raise KeyboardInterrupt

        return stopped

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "PERIOD", -1.0)
        for module in (checkpoint, tasks):
            patched.setattr(module, "save", stopping(module.save))
        assert command_line(*words, "-w", cwd=folder)[0] == 130
    left_over = [path for path in saved if path.exists()]
    assert left_over
    for path in left_over:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    succeeds(command_line, folder, *words, "--resume", "-w")
    assert left(folder) == files


@pytest.mark.parametrize("name", ["recover"])
def test_another_file_at_the_output_is_not_the_finished_one(
    name: str, made: Path, command_line: CommandLine
) -> None:
    (made / "out.ply").write_bytes((made / "small.ply").read_bytes())
    error = refused(command_line, made, *CALLS[name].split(), "--resume", status=1)
    assert "out.ply: exists" in error


_COUNTED = ("replace", "link", "rename", "unlink", "rmdir")
_MOMENTS = 3
# others write as these do
KILLED = [name for name in REPEATED if name not in ("distill a page", "lod")]


@pytest.mark.skipif(
    not hasattr(os, "fork"), reason="needs os.fork, to kill a process at a chosen moment"
)
@pytest.mark.parametrize("name", KILLED)
def test_the_same_command_after_a_kill_ends_and_cleans_up(
    name: str, inputs: Path, tmp_path: Path
) -> None:
    """The kills come alternately before and after a file is put in place."""
    words, logs = [*CALLS[name].split(), *["--resume"] * (name in RESUMED)], tmp_path / "logs"
    logs.mkdir()

    def run(label: str, folder: Path, after: int = 0) -> tuple[int, str]:
        work = killed(
            command(words), after, logs / "count", functions=_COUNTED, before=after % 2 == 0
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads
            status = forked(work, logs / f"{label}.out", logs / f"{label}.err", folder)
        return status, (logs / f"{label}.err").read_text()

    status, error = run("whole", shutil.copytree(inputs, tmp_path / "whole"))
    assert status == 0, error
    whole, count = left(tmp_path / "whole"), int((logs / "count").read_text())
    hidden = [file for file in whole if re.search(r"(^|/)\.", file)]
    assert not hidden
    assert count > 2
    for after in sorted(
        {1 + round(i * (count - 1) / (_MOMENTS - 1)) for i in range(_MOMENTS)} | {count - 1}
    ):
        folder = shutil.copytree(inputs, tmp_path / str(after))
        assert run(f"killed{after}", folder, after)[0] == -9
        status, error = run(f"again{after}", folder)
        assert status == 0, f"killed at {after} of {count}: {error}"
        again = left(folder)
        assert again.keys() == whole.keys(), f"killed at {after} of {count}"
        assert [file for file in whole if again[file] != whole[file]] == [], (
            f"killed at {after} of {count}"
        )
