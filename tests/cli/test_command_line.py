"""The command line's contract: exit statuses, one-line errors, lazy imports."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import g2ard
from g2ard.cli.app import COMMANDS
from g2ard.cli.console import Console
from g2ard.cli.run import Run
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball


def imported_by(statement: str, *heavy: str) -> list[str]:
    code = f"import sys\n{statement}\nprint([m for m in sys.modules if m.startswith({heavy!r})])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return eval(out.stdout)


def test_import_and_help_load_nothing_heavy() -> None:
    assert (
        imported_by("import g2ard", "torch", "numpy", "PIL", "typer", "rich", "g2ard._core") == []
    )
    show_help = """
import contextlib, io
from g2ard.cli.main import main
for words in {calls}:
    sys.argv = ["g2ard", *words]
    with contextlib.redirect_stdout(io.StringIO()) as shown, contextlib.suppress(SystemExit):
        main()
    assert "Usage: g2ard" in shown.getvalue(), words
"""
    heavy = "torch", "numpy", "PIL"
    whole = show_help.format(calls=[["--help"]])
    assert imported_by(whole, *heavy, "g2ard.cli.commands.") == []
    each = show_help.format(calls=[[command, "--help"] for command in COMMANDS])
    assert imported_by(each, *heavy) == []


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_config_files_are_utf_8(tmp_path: Path, mark: bytes) -> None:
    """Any locale works, also with the byte order mark that editors on Windows write."""
    (tmp_path / "c.toml").write_bytes(mark + 'output = "größe/×.ply"\n'.encode())
    code = "import sys; from pathlib import Path; from g2ard.cli.config_file import _read_toml;"
    code += "print(ascii(_read_toml(Path(sys.argv[1]))))"
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "c.toml"], env=plain, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert eval(done.stdout) == {"output": "größe/×.ply"}


def test_progress_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("g2ard.cli.console.time.monotonic", lambda: now)
    console = Console()
    for done in range(1, 41):
        now += 1
        console("recover", done, 40, {"loss": 0.5})
        console.tick()
    console("short", 1, 1)
    for done in range(10):
        now += 2
        console("simplify", done, 20)
        console.tick()
    lines = capsys.readouterr().err.splitlines()
    assert "ETA 30.0 s" in lines.pop()
    assert len(lines) == 4  # every 10 s, and the end
    assert "ETA" in lines[0]
    assert "loss 0.5" in lines[0]
    assert lines[-1].startswith("recover: 40/40")


def test_remaining_time_is_hidden_until_it_settles(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first unit that takes long, such as a compilation, promises days."""
    now = 0.0
    monkeypatch.setattr("g2ard.cli.console.time.monotonic", lambda: now)
    console = Console()
    console("targets", 0, 100_000)
    for done in range(1, 4000):
        now += 10 if done == 1 else 0.01
        console("targets", done, 100_000)
        console.tick()
    lines = capsys.readouterr().err.splitlines()
    assert "ETA" not in lines[0]
    assert all(int(hours) < 1 for hours in re.findall(r"ETA (\d+) h", "\n".join(lines)))
    for done in range(4000, 50_000):
        now += 0.01
        console("targets", done, 100_000)
        console.tick()
    assert "ETA 8 min" in capsys.readouterr().err.splitlines()[-1]


def test_a_machine_without_a_gpu_says_one_thing(tmp_path: Path) -> None:
    """`info --devices` gives the reason that a fallback to the CPU gives; auto says nothing."""
    g2ard.save(tmp_path / "ball.ply", checkered_ball(300))
    g2ard.save_views(tmp_path / "views.json", around(2, (48, 36)))

    def told(*words: object) -> str:
        without = dict.fromkeys(("VK_ICD_FILENAMES", "VK_DRIVER_FILES"), "/dev/null")
        ask = [sys.executable, "-m", "g2ard", *map(str, words)]
        done = subprocess.run(
            ask,
            cwd=tmp_path,
            env={**os.environ, **without},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout + done.stderr

    listed = told("info", "--devices")
    reasons = re.findall(r"│ none +│ (.*?) +│", listed)
    if not reasons:
        pytest.skip("a driver that needs no list of drivers")
    assert re.search(r"--device auto +│ the CPU", listed)
    ask = (
        "evaluate",
        "ball.ply",
        "--teacher",
        "ball.ply",
        "--views",
        "views.json",
        "--split",
        "all",
    )
    assert reasons[0] in told(*ask, "--device", "gpu")
    assert "GPU" not in told(*ask, "--device", "auto")


def test_a_page_that_is_served_leaves_no_live_line(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    g2ard.save(tmp_path / "ball.ply", checkered_ball(300))
    done: list[str] = []
    close = Console.close
    monkeypatch.setattr(
        Console, "close", lambda console: [done.append("closed"), close(console)][1]
    )

    monkeypatch.setattr(Run, "answer", lambda run, text: done.append(text))
    assert "stopped" in succeeds(command_line, tmp_path, "view", "ball.ply").err
    assert done[0] == "closed"
    assert "127.0.0.1" in done[1]


def test_quiet_prints_errors_only(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(quiet=True)
    console.say("hello")
    console("stage", 1, 1)
    console.table("t", ["a"], [["1"]])
    console.error("bad")
    assert capsys.readouterr().err == "g2ard: bad\n"


def test_an_interrupt_while_a_string_is_executed_ends_with_130_too(tmp_path: Path) -> None:
    """`python -m` would end by the signal although the interrupt was handled."""
    (tmp_path / "stopped.py").write_text("""
import sys
import g2ard.cli.main
from g2ard.__main__ import main
def stopped():
    try:
        exec("raise KeyboardInterrupt")
    except KeyboardInterrupt:
        print("kept")
    sys.exit(130)
g2ard.cli.main.main = stopped
main()
""")
    command = [sys.executable, "-m", "stopped"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "kept\n")


def test_an_interrupt_while_a_class_is_made_is_one(
    folder: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modules are loaded late, and before Python 3.12 its own error hides what a descriptor raises."""

    class Stopped:
        def __set_name__(self, owner: type, name: str) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr(
        "g2ard.jobs.clean.clean", lambda *_, **__: type("Made", (), {"field": Stopped()})
    )
    error = refused(command_line, folder, "clean", "ball.ply", "-o", "clean.ply", status=130)
    assert error == "g2ard: interrupted; nothing was written\n"


def test_version_has_a_letter(command_line: CommandLine, folder: Path) -> None:
    assert command_line("-V", cwd=folder) == command_line("--version", cwd=folder)
    shown = succeeds(command_line, folder, "--help").out
    assert [word for word in ("--install-completion", *COMMANDS) if f" {word} " not in shown] == []


def test_completion_is_of_the_shell_that_is_named(command_line: CommandLine, folder: Path) -> None:
    for shell, words in (
        ("zsh", "#compdef g2ard"),
        ("fish", "complete --command g2ard"),
        ("bash", "complete -o"),
    ):
        status, out, error = command_line("--show-completion", shell, cwd=folder, apart=True)
        assert (status, error) == (0, "")
        assert words in out
    status, _, error = command_line("--show-completion", "tcsh", cwd=folder, apart=True)
    assert (status, error.count("\n"), "zsh" in error) == (2, 1, True), error
