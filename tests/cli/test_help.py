"""Options in `--help` and `--help-all`, and options that were renamed."""

import ast
import re
from pathlib import Path
from typing import Any

import pytest

from g2ard.cli.app import COMMANDS
from g2ard.cli.panels import USED
from helpers.commands import CommandLine, succeeds
from helpers.project import ROOT


def options_of(command: str) -> dict[str, Any]:
    """Return the options of a command by parameter, in their order."""
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.command import app

    register_commands()
    params = get_command(app).commands[command].params  # type: ignore[attr-defined]
    return {str(p.name): p for p in params if p.param_type_name == "option"}


def flags_in(text: str) -> list[str]:
    """Return the long flags, or short ones without a long, that begin the rows of a help text."""
    return re.findall(r"(?m)^│ {1,22}(?:\* +)?(--?[\w-]+)", text)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_twelve_options_at_most_in_order_of_use(
    command: str, command_line: CommandLine, tmp_path: Path
) -> None:
    options = options_of(command)
    assert set(USED[command]) <= set(options)
    assert len(USED[command]) <= 12
    status, text, _ = command_line(command, "--help", cwd=tmp_path)
    assert status == 0
    shown = [flag for flag in flags_in(text) if flag != "--help"]
    flags = [max(options[name].opts, key=len) for name in USED[command]]
    assert [flag for flag in shown if flag in flags or flag.startswith("-")] == flags
    assert f"g2ard {command} --help-all" in text
    assert f"Example: g2ard {command}" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_all_shows_every_option_once(
    command: str, command_line: CommandLine, tmp_path: Path
) -> None:
    options = options_of(command)
    status, text, _ = command_line(command, "--help-all", "--unknown", cwd=tmp_path)
    assert status == 0
    shown = flags_in(text)
    for option in options.values():
        assert shown.count(max(option.opts, key=len)) == 1, option.name
    assert "--help-all" not in text.split("Example:")[1]


def test_options_without_effect_are_left_out() -> None:
    for command in ("convert", "info"):
        assert not {"seed", "threads", "device"} & set(options_of(command))
    for command in COMMANDS:  # whatever takes a seed uses it
        text = (ROOT / "g2ard" / "cli" / "commands" / f"{command}.py").read_text(encoding="utf-8")
        assert ("seed" in options_of(command)) == ("seed" in text.replace('without=("seed"', "")), (
            command
        )


def test_a_flag_is_taken_by_its_former_spelling(command_line: CommandLine, tmp_path: Path) -> None:
    for flag, page in (("--no-view", False), ("--view", True)):
        ask = ("distill", "x.ply", "-r", 2, "-o", "run", flag, "--print-config")
        assert f"page = {str(page).lower()}" in succeeds(command_line, tmp_path, *ask).out


def test_lines_of_the_list_are_those_of_the_commands() -> None:
    for command, line in COMMANDS.items():
        tree = ast.parse(
            (ROOT / "g2ard" / "cli" / "commands" / f"{command}.py").read_text(encoding="utf-8")
        )
        (function,) = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == command]
        assert (ast.get_docstring(function) or "").split("\n\n")[0] == line
