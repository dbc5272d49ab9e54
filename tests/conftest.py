"""Fixtures of several stages: the program as a user types it, and a folder with inputs."""

import contextlib
import gc
import io
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import typer
from typer.main import get_command as typer_parser

import g2ard
from g2ard.io import write_views
from helpers.keys import lasting_keys
from helpers.plans import FOLDER, plan_small_scenes, share_plans
from helpers.project import environment
from helpers.scenes import around, checkered_ball

Said = tuple[int, str, str]


# processes in the background start with it ignored
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def unchanged_signals() -> Iterator[None]:
    """Fail a test after which Ctrl-C has another handler: it would end the process in a later test."""
    yield
    left = signal.signal(signal.SIGINT, signal.default_int_handler)
    assert left is signal.default_int_handler


def pytest_configure(config: pytest.Config) -> None:
    if FOLDER not in os.environ:  # processes that are started later inherit it
        plans = tempfile.TemporaryDirectory(prefix="plans")
        config.add_cleanup(plans.cleanup)
        os.environ[FOLDER] = plans.name
        os.environ["XDG_CACHE_HOME"] = os.environ["LOCALAPPDATA"] = plans.name


_STUDIES = Path(__file__).with_name("benchmarks")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave the tests of studies to `make test-benchmarks`, unless an argument names some of them."""
    if collection_path != _STUDIES:
        return None
    named = (Path(argument.partition("::")[0]).resolve() for argument in config.args)
    return None if any(path.is_relative_to(_STUDIES) for path in named) else True


def pytest_collection_finish() -> None:
    """Spare the garbage collector what stays to the end: modules and collected tests.

    Hypothesis's plugin imports it at the end otherwise, where Python 3.11 may fail to parse (gh-106905).
    """
    import_module("hypothesis")
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Count the skipped tests by reason. `.ci/run` repeats these lines at its end."""
    stats = terminalreporter.stats
    tests = sum(
        len(stats.get(kind, []))
        for kind in ("passed", "failed", "skipped", "error", "xfailed", "xpassed")
    )
    reasons = Counter(_reason(report) for report in stats.get("skipped", []))
    terminalreporter.line("")
    terminalreporter.line(f"skipped: {reasons.total():,} of {tests:,} tests")
    for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0])):
        terminalreporter.line(f"skipped: {count:5,} {reason}")


def _reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    told = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return " ".join(told.removeprefix("Skipped: ").split()) or "no reason"


os.environ.pop(
    "CI", None
)  # with it, pytest shows the whole difference of two files, which takes hours for megabytes

_OF_THE_PROCESS = {"--threads", "--device", "--devices"}
"""Options that change the whole process: calls with them run in a process of their own."""


@pytest.fixture(scope="session")
def command_line() -> Callable[..., Said]:
    """Runs `g2ard …` in a folder: (exit status, stdout, stderr).

    In this process, for most of a short command is Python's start; in one of its own where `apart` says so.
    """

    def run(*arguments: object, cwd: Path, apart: bool = False) -> Said:
        words = [str(argument) for argument in arguments]
        env = environment(COLUMNS="200")
        return (_apart if apart or _OF_THE_PROCESS & set(words) else _here)(words, cwd, env)

    return run


def _program(words: list[str]) -> list[str]:
    """Return the module of a command and its words; those of the benchmarks begin with "benchmarks"."""
    return words if words[:1] == ["benchmarks"] else ["g2ard", *words]


@cache
def _parser(app: typer.Typer, commands: int) -> Any:
    """Return typer's parser. The program registers one command, a process of tests nearly all."""
    return typer_parser(app)


def _apart(words: list[str], cwd: Path, env: dict[str, str]) -> Said:
    done = subprocess.run(
        [sys.executable, "-m", *_program(words)],
        cwd=cwd,
        env=env,
        capture_output=True,
        text=True,
        timeout=300,
    )
    return done.returncode, done.stdout, done.stderr


def _here(words: list[str], cwd: Path, env: dict[str, str]) -> Said:
    from g2ard.cli.main import main

    program, *words = _program(words)
    if program == "benchmarks":
        from benchmarks.__main__ import main  # type: ignore[no-redef]

    out, err = io.StringIO(), io.StringIO()
    status: object = 0
    before, known = Path.cwd(), set(sys.modules)
    with (
        patch.dict(os.environ, env),
        patch.object(sys, "argv", [program, *words]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        patch("g2ard.system.interrupt.ends_the_program"),  # signals stay those of pytest
        patch("gc.freeze"),  # `main` takes it that the program ends
        patch("typer.main.get_command", lambda app: _parser(app, len(app.registered_commands))),
        # a page that is shown is closed at once
        patch("webbrowser.open", side_effect=KeyboardInterrupt),
    ):
        os.chdir(cwd)
        try:
            main()
        except SystemExit as end:
            status = end.code
        finally:
            os.chdir(before)
            # a user's module of that name may be another's next time
            for name in set(sys.modules) - known:
                if Path(str(getattr(sys.modules[name], "__file__", None))).parent == cwd:
                    del sys.modules[name]
    return int(status or 0) if isinstance(status, int | None) else 1, out.getvalue(), err.getvalue()


_USUAL_VIEWS = {"test_floors", "test_generated_views", "test_notes", "test_stopped_runs"}
"""Modules whose generated views have the usual size, as their numbers and kinds depend on it."""
_UNSCORED = {
    "cli",
    "levels",
    "report",
    "viewer",
    "io/test_upright",
    "jobs/test_sizes",
    "tests/test_api",
    "tests/test_documented_commands",
    "tiles/test_distill",
}
"""Folders and modules whose tests ask for no score, or compare scores in equal views: any views will do."""


@pytest.fixture(scope="module", autouse=True)
def shared_plans(request: pytest.FixtureRequest) -> Iterator[None]:
    """Share planned views between all tests but those of planning."""
    with pytest.MonkeyPatch.context() as patches:
        if request.path.parent.name != "poses":
            if request.path.stem in _USUAL_VIEWS:
                share_plans(patches)
            else:
                folder = request.path.parent.name
                coarse = bool({folder, f"{folder}/{request.path.stem}"} & _UNSCORED)
                plan_small_scenes(patches, coarse=coarse)
        yield


@pytest.fixture(autouse=True)
def keys_of_jobs() -> Iterator[None]:
    """Fail a test that runs a job whose key changes until its end: it could not be resumed."""
    with lasting_keys():
        yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """ball.ply of 400 Gaussians and views.json of 16 views."""
    g2ard.save(tmp_path / "ball.ply", checkered_ball(400))
    write_views(tmp_path / "views.json", around(16, (48, 36)))
    return tmp_path
