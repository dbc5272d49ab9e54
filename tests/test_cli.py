"""The command line's contract: exit statuses, one-line errors, lazy imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = ["evaluate", "recover", "render"]


def g2ard(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "g2ard", *arguments], capture_output=True, text=True, cwd=cwd, timeout=300
    )


def imported_by(statement: str, *heavy: str) -> list[str]:
    code = f"import sys; {statement}; print([m for m in {heavy!r} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return eval(out.stdout)


def test_import_and_help_load_nothing_heavy() -> None:
    assert imported_by("import g2ard", "torch", "numpy", "typer", "rich") == []
    help_ = "import contextlib, io\nfrom g2ard.cli import main\nsys.argv = ['g2ard', '--help']\n"
    help_ += "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit): main()\n"
    code = f"import sys\n{help_}print([m for m in ('torch', 'numpy', 'PIL') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert eval(out.stdout) == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_an_example(command: str) -> None:
    shown = g2ard(command, "--help")
    assert shown.returncode == 0
    assert "Example: g2ard " + command in shown.stdout.replace("\n", " ")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nonsense"], "nonsense"),
        (["render", "x.ply", "--views", "v.json", "-o", "out", "--threads", "-1"], "--threads"),
        (["render", "x.ply", "--views", "v.json", "-o", "out", "--background", "2,0,0"], "--background"),
        (["render", "x.ply", "--views", "v.json", "-o", "out", "--device", "abacus"], "abacus"),
    ],
)
def test_usage_errors_are_one_line_and_status_2(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = g2ard(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_config_file_gives_defaults_and_refuses_unknown_names(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text('[render]\nbackgruond = "white"\n')
    done = g2ard("render", "x.ply", "--views", "v", "-o", "o", "--config", "bad.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "backgruond" in done.stderr
    (tmp_path / "good.toml").write_text('[render]\ndevice = "abacus"\n')
    done = g2ard("render", "x.ply", "--views", "v", "-o", "o", "--config", "good.toml", cwd=tmp_path)
    assert "abacus" in done.stderr  # the file's value is used …
    done = g2ard(
        "render", "x", "--views", "v", "-o", "o", "--config", "good.toml", "--device", "cpu", cwd=tmp_path
    )
    assert "abacus" not in done.stderr  # … and a flag wins
