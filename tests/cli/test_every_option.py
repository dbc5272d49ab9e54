"""No option is silently ignored: each changes what a command writes; the paper's preset refuses some."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from g2ard.cli.app import COMMANDS
from helpers.calls import CALLS, ON, REFUSED, VALUES, flag_of, options_of, without
from helpers.commands import CommandLine, succeeds

NO_RESULT = {
    **dict.fromkeys(("quiet", "verbose", "json"), "say more or less"),
    **dict.fromkeys(
        ("overwrite", "resume", "work", "dry_run", "print_config"), "say whether to compute"
    ),
    **dict.fromkeys(
        ("threads", "device", "workers", "scheduler", "memory"), "say where to compute"
    ),
    **dict.fromkeys(("config", "set"), "hold other options, see test_used_settings.py"),
    "seed": "common to all commands, and some draw nothing",
    "engine": "other engines give equal results up to rounding",
    "recovery_time": "depends on the machine",
    "time": "depends on the machine",
    "lpips": "needs weights",
    "lpips_input": "needs weights",
}
"""Options that are not for the result."""

OWN = {
    "poses": ("render_model",),
    "select": ("render_model",),
    "register": ("pool", "matcher"),
    "evaluate": ("photos",),
}
"""Options that need not change a result: poses depend on geometry alone; a pool is for photos without a pose,
and a matcher that finds no features gives way to direct alignment; evaluate uses the photos in any case.
"""


def _written(folder: Path, before: set[Path], told: str) -> dict[str, Any]:
    """Return what a command wrote, without times, and what it says on stdout."""
    files: dict[str, Any] = {"stdout": told}
    for path in sorted({path for path in folder.rglob("*") if path.is_file()} - before):
        name = str(path.relative_to(folder))
        if path.name == "report.html":
            files[name] = "written"
        elif path.suffix == ".json":
            files[name] = _timeless(json.loads(path.read_text()))
        else:
            files[name] = path.read_bytes()
    return files


def _timeless(content: Any) -> Any:
    """Return a report without its times and options."""
    if isinstance(content, dict):
        gone = ("seconds", "config", "peak_rss_bytes", "steps_per_second", "output")
        return {key: _timeless(value) for key, value in content.items() if key not in gone}
    return [_timeless(value) for value in content] if isinstance(content, list) else content


BUDGETS = ("count", "ratio", "fit", "min_psnr", "min_ssim")


def _base(command: str, option: str, preset: str = "") -> str:
    """Return the plainest call of a command that the option has an effect on, with a result to compare."""
    words = ON.get(command, {}).get(option, CALLS[command]) + preset
    if command == "simplify" and preset:  # the paper's method has no views
        words = re.sub(r" --views \S+", "", words)
    if " -o " not in words and " --json" not in words:
        words += " --json -" if command == "info" else " --json out.json"
    return words.replace(" -r 8", "") if option in BUDGETS else words


class Runner:
    """Runs commands on the inputs, each in a folder of its own."""

    def __init__(self, inputs: Path, store: Path, command_line: CommandLine) -> None:
        self.inputs, self.store, self.command_line = inputs, store, command_line
        self.usual: dict[str, dict[str, Any]] = {}
        self.count = 0

    def run(self, words: str) -> tuple[str, dict[str, Any]]:
        self.count += 1
        folder = self.store / str(self.count)
        shutil.copytree(self.inputs, folder)
        before = {path for path in folder.rglob("*") if path.is_file()}
        status, out, error = self.command_line(*words.split(), cwd=folder)
        written = _written(folder, before, re.sub(r"\d+\.\d+ s", "", out))
        shutil.rmtree(folder)
        return error if status else "", written

    def base(self, command: str, option: str, preset: str) -> dict[str, Any]:
        words = _base(command, "" if option in BUDGETS else option, preset)
        if words not in self.usual:
            error, self.usual[words] = self.run(words)
            assert not error
        return self.usual[words]


@pytest.fixture(scope="module")
def runner(
    inputs: Path, tmp_path_factory: pytest.TempPathFactory, command_line: CommandLine
) -> Runner:
    return Runner(inputs, tmp_path_factory.mktemp("runs"), command_line)


OVER_PAPER = [
    ("distill", "sh_degree"),
    ("distill", "steps"),
    ("simplify", "method"),
    ("recover", "steps"),
    ("adapt", "steps"),
    ("select", "k"),
]
"""Command and option that the paper's preset sets, so that the option must win; others it leaves alone."""
CASES = [(command, name, "") for command, table in VALUES.items() for name in table] + [
    (command, name, " --preset paper") for command, name in [*OVER_PAPER, *REFUSED]
]


@pytest.mark.parametrize(("command", "option", "preset"), CASES)
def test_an_option_changes_the_result(
    command: str, option: str, preset: str, runner: Runner
) -> None:
    usual = runner.base(command, option, preset)
    given = f"{flag_of(command, option)} {VALUES[command][option]}"
    words = f"{_base(command, option, preset)} {given}"
    if (command, option) == ("info", "devices"):
        words = "info --devices --json -"
    error, result = runner.run(words)
    if preset and (command, option) in REFUSED:
        assert REFUSED[command, option] in error.splitlines()[-1]
        assert error.splitlines()[-1].startswith("g2ard")
    else:
        assert not error
        assert result != usual


@pytest.mark.parametrize("command", VALUES)
def test_a_config_file_says_the_same_as_flags(
    command: str, inputs: Path, command_line: CommandLine
) -> None:
    """So does the config that is printed of either."""
    file = inputs / f"{command}.toml"

    def config(words: list[str], table: str) -> str:
        file.write_text(f"[{command}]\n{table}")
        return succeeds(command_line, inputs, *words, "--config", file.name, "--print-config").out

    for option, given in VALUES[command].items():
        parameter, flag = options_of(command)[option], flag_of(command, option)
        excluded = ["views"] * (option == "no_views")
        words = without(_base(command, option).split(), option, *excluded)
        value, more = (
            ("", given.split()) if parameter.is_flag else (given.split()[0], given.split()[1:])
        )
        by_flag = config([*words, flag, *given.split()], "")
        on = json.dumps(value or flag not in parameter.secondary_opts)
        key = max(
            (found for found in parameter.opts if found[:2] == "--"), key=len, default=option
        ).lstrip("-")
        rest = without([command, *more], option)[1:]
        assert config([*words, *rest], f"{key} = {on}\n") == by_flag, option
        assert config([command], by_flag.partition("\n")[2]) == by_flag, option


def test_the_table_holds_every_option() -> None:
    assert all(option in VALUES[command] for command, table in ON.items() for option in table)
    assert VALUES.keys() == COMMANDS.keys()
    for command, table in VALUES.items():
        apart = set(NO_RESULT) | set(OWN.get(command, ())) | {"output", "help"}
        assert options_of(command).keys() - apart == set(table) - {"output"}, command
