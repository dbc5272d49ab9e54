"""Config files: options in TOML, read by --config and written by --print-config."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.usage import meant

_NOT_KEPT = ("config", "print_config", "overwrite", "resume")
"""Options that are not written to config files."""
_toml = partial(json.dumps, ensure_ascii=False)
"""Format a value; for text, finite numbers and lists of them, TOML is JSON."""


def load_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a TOML file as defaults: those at its top, then those in the command's table.

    Keys are long flag names; unknown keys raise an error. Tables of other commands are ignored.
    """
    if path is None:
        return None
    values = _read(path)
    table = _of_command(ctx, path, values)
    constants = _flat(table.pop("set", {}))
    params = {flag.lstrip("-").replace("-", "_"): p for p in ctx.command.params for flag in (*p.opts, p.name)}
    table = {_dashed(key).replace("-", "_"): value for key, value in table.items()}
    unknown = {_dashed(key) for key in table if key not in params or len(key) == 1}
    if unknown:
        near = _meant(unknown, ctx.command)
        raise typer.BadParameter(f"{path}: `{ctx.info_name}` has no option {near}")
    found: dict[str, Any] = {}
    for key, value in table.items():
        many = getattr(params[key], "multiple", False) or params[key].nargs == -1
        several = value if isinstance(value, list) else [value]
        found[str(params[key].name)] = [_as_typed(one) for one in several] if many else _as_typed(value)
    if constants:
        found["set"] = [f"{name}={_as_typed(value)}" for name, value in constants.items()]
        if "set" not in params:
            raise typer.BadParameter(f"{path}: `{ctx.info_name}` has no settings; remove `set`")
    ctx.default_map = {**(ctx.default_map or {}), **found}
    return path


def _read(path: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as e:
        raise typer.BadParameter(f"{path}: {e.strerror}") from None
    except UnicodeDecodeError:
        raise typer.BadParameter(f"{path}: not a text file") from None
    except tomllib.TOMLDecodeError as e:
        raise typer.BadParameter(f"{path}: {e}") from None


def _of_command(ctx: typer.Context, path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return the file's top-level options, overridden by those in the command's table."""
    from g2ard.cli.commands import COMMANDS

    name = str(ctx.info_name)
    top = {key: value for key, value in values.items() if key == "set" or not isinstance(value, dict)}
    strange = sorted(set(values) - set(top) - {*COMMANDS, name})
    if strange:
        raise typer.BadParameter(f"{path}: unknown command {meant(strange, {*COMMANDS, name})}")
    own = values.get(name, {})
    if not isinstance(own, dict):
        raise typer.BadParameter(f"{path}: {name}: expected a table of options")
    known = _options(ctx.command)
    several_commands = own or len(top) < len(values)
    if several_commands:  # then options at the top may belong to another one
        of_others = _check_others(path, {key: values[key] for key in values if key not in {*top, name}})
        strange = [key for key in top if _dashed(key) not in known | of_others and key != "set"]
        if strange:
            near = meant(strange, known | of_others)
            raise typer.BadParameter(f"{path}: none of its commands has an option {near}")
        top = {key: value for key, value in top.items() if _dashed(key) in known or key == "set"}
    constants = {**_flat(top.pop("set", {})), **_flat(own.get("set", {}))}
    return {**top, **own} | ({"set": constants} if constants else {})


def _check_others(path: Path, tables: dict[str, Any]) -> set[str]:
    """Check the tables of other commands, and return the options of those commands."""
    from g2ard.cli.app import app
    from g2ard.cli.commands import register_commands

    for name in tables:
        register_commands(name)
    commands: dict[str, Any] = getattr(typer.main.get_command(app), "commands", {})
    found: set[str] = set()
    for name, table in tables.items():
        command = commands.get(name)
        if command is None or not isinstance(table, dict) or hasattr(command, "commands"):
            continue  # a group of commands
        options = _options(command)
        if strange := [key for key in table if key != "set" and _dashed(key) not in options]:
            raise typer.BadParameter(f"{path}: `{name}` has no option {meant(strange, options)}")
        found |= options
    return found


def _options(command: Any) -> set[str]:
    """Return the names of a command's options, with dashes."""
    return {_dashed(flag.lstrip("-")) for p in command.params for flag in (*p.opts, str(p.name))}


def _meant(keys: Iterable[str], command: Any) -> str:
    """List unknown keys, each with similar long names; for a letter, with the long name of that flag."""
    flags = ((flag, max(p.opts, key=len)) for p in command.params for flag in p.opts)
    long = {flag[1:]: name.lstrip("-") for flag, name in flags if len(flag) == 2}
    known = {name for name in _options(command) if len(name) > 1}
    told = [f"{key} (write {long[key]})" if key in long else meant([key], known) for key in sorted(keys)]
    return ", ".join(told)


def _dashed(key: str) -> str:
    return key.replace("_", "-")


def _flat(table: Any, prefix: str = "") -> dict[str, Any]:
    """Return a nested table of settings by dotted path, since TOML nests `simplify.max_energy = 0.02`."""
    if not isinstance(table, dict):
        raise typer.BadParameter(
            "set: expected a table of settings, such as set = { simplify.max_energy = 0.02 }"
        )
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return out


def _as_typed(value: Any) -> Any:
    """Return a TOML value as typed on the command line, such as 1,1,1 for [1, 1, 1]."""
    if isinstance(value, list):
        return ",".join(str(item) for item in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def printed(ctx: typer.Context, values: dict[str, Any]) -> str:
    """Format a call's inputs and options, with defaults but without None, for `load_config`."""
    lines = [f"[{ctx.info_name}]"]
    constants: list[str] = []
    for parameter in ctx.command.params:
        name, value = str(parameter.name), values.get(str(parameter.name))
        if name in _NOT_KEPT or value in (None, [], ()):
            continue
        if name == "set":
            constants = list(value)
            continue
        many = parameter.nargs == -1
        flag = max((opt for opt in parameter.opts if opt.startswith("--")), key=len, default=f"--{name}")
        lines.append(f"{flag[2:]} = {_toml([str(item) for item in value] if many else _plain(value))}")
    if constants:
        lines.append(f"[{ctx.info_name}.set]")
        pairs = (text.partition("=") for text in constants)
        lines += [f"{name.strip()} = {_toml(value.strip())}" for name, _, value in pairs]
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    """Return an option's value as a TOML type: 5,10 becomes [5, 10], 10.0 becomes 10, the rest text."""
    if isinstance(value, list):
        items = [item for one in map(_plain, value) for item in (one if isinstance(one, list) else [one])]
        return items if len(items) > 1 or not isinstance(value[0], tuple) else items[0]
    if isinstance(value, tuple) and type(value).__str__ is tuple.__str__:
        return [_plain(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return int(value)
    if isinstance(value, bool | int | float) and math.isfinite(value):
        return value
    text = str(value)
    return int(text) if isinstance(value, Count) and text.isdecimal() else text
