"""Config files: options in TOML, read by --config and written by --print-config."""

import json
import math
import re
from collections import ChainMap
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.usage import suggest_names
from g2ard.config.choices import Named
from g2ard.errors import InputError

_NOT_KEPT = ("config", "print_config", "overwrite", "resume")
"""Options that are not written to config files."""
_BACKSLASHES = "; within double quotes \\ begins an escape: write paths in single quotes, or with /"
_toml = partial(json.dumps, ensure_ascii=False)
"""Format a value; for text, finite numbers and lists of them, TOML is JSON."""


def load_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a TOML file as defaults: those at its top, then those in the command's table.

    Keys are long flag names. Every key must be an option of its table's command; keys at the top, of at least
    one of the commands.
    """
    if path is None:
        return None
    values = _read_toml(path)
    name = str(ctx.info_name)
    tables = {
        key: value for key, value in values.items() if isinstance(value, dict) and key != "set"
    }
    top = {key: value for key, value in values.items() if key not in tables}
    commands = _find_parameters(ctx, path, tables)
    for other, table in tables.items():
        _check_keys(table, commands[other], f"{path}: `{other}` has no option")
    anywhere = dict(ChainMap(*commands.values()))
    missing = "none of its commands has an option" if tables else f"`{name}` has no option"
    _check_keys(top, anywhere, f"{path}: {missing}")
    own = tables.get(name, {})
    settings = _flatten(top.pop("set", {})) | _flatten(own.pop("set", {}))
    if settings and "set" not in commands[name]:
        raise typer.BadParameter(f"{path}: `{name}` has no settings; remove `set`")
    found: Named = {}
    for key, value in {**top, **own}.items():
        parameter = commands[name].get(_write_dashes(key))
        if parameter is not None:  # otherwise an option of another command
            found[str(parameter.name)] = _read_default(parameter, value)
    if settings:
        found["set"] = [f"{key}={_write_as_typed(value)}" for key, value in settings.items()]
    ctx.default_map = {**(ctx.default_map or {}), **found}
    return path


def _read_toml(path: Path) -> Named:
    import tomllib

    from g2ard.io.paths import read_text

    try:
        text = read_text(path)
        return tomllib.loads(text)
    except InputError as e:
        raise typer.BadParameter(str(e)) from None
    except tomllib.TOMLDecodeError as e:
        hint = _BACKSLASHES if re.search(r'"[^"\n]*\\', text) else ""
        raise typer.BadParameter(f"{path}: {e}{hint}") from None


def _find_parameters(ctx: typer.Context, path: Path, tables: Iterable[str]) -> dict[str, Named]:
    """Return the parameters of this command and of those with a table, by command and dashed name."""
    from g2ard.cli.app import COMMANDS, app, register_commands

    name = str(ctx.info_name)
    others = set(tables) - {name}
    if strange := others - {*COMMANDS}:
        raise typer.BadParameter(
            f"{path}: unknown command {suggest_names(strange, {*COMMANDS, name})}"
        )
    for other in others:
        register_commands(other)
    commands: Named = getattr(typer.main.get_command(app), "commands", {}) if others else {}
    found: dict[str, Named] = {}
    for command in (name, *others):
        found[command] = {}
        for parameter in (ctx.command if command == name else commands[command]).params:
            for flag in (*parameter.opts, str(parameter.name)):
                found[command][_write_dashes(flag.lstrip("-"))] = parameter
    return found


def _check_keys(table: Named, known: Named, problem: str) -> None:
    """Reject unknown keys, with similar names, and letters of options that have a longer name."""
    told = []
    long = [flag for flag in known if len(flag) > 1]
    for key in sorted(table):
        name = key if len(key) > 1 or key not in known else _find_long_name(known[key])
        if name != key:
            told.append(f"{key} (write {name})")
        elif _write_dashes(key) not in known and key != "set":
            told.append(suggest_names([key], long))
    if told:
        raise typer.BadParameter(f"{problem} {', '.join(told)}")


def _read_default(parameter: Any, value: Any) -> Any:
    """Return a TOML value as a parameter's default: as typed, in a list if the parameter takes several."""
    if not getattr(parameter, "multiple", False) and parameter.nargs != -1:
        return _write_as_typed(value)
    return [_write_as_typed(one) for one in (value if isinstance(value, list) else [value])]


def _find_long_name(parameter: Any) -> str:
    """Return a parameter's longest flag without dashes, or its name if there is no long flag."""
    flags = (flag[2:] for flag in parameter.opts if flag.startswith("--"))
    return max(flags, key=len, default=str(parameter.name))


def _write_dashes(key: str) -> str:
    return key.replace("_", "-")


def _flatten(table: Any, prefix: str = "") -> Named:
    """Return a nested table of settings by dotted path, since TOML nests `simplify.max_energy = 0.02`."""
    if not isinstance(table, dict):
        raise typer.BadParameter(
            "set: expected a table of settings, such as set = { simplify.max_energy = 0.02 }"
        )
    out: Named = {}
    for key, value in table.items():
        out |= (
            _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return out


def _write_as_typed(value: Any) -> Any:
    """Return a TOML value as typed on the command line, such as 1,1,1 for [1, 1, 1]."""
    if isinstance(value, str) and not value.isprintable():
        raise typer.BadParameter(f"{value!r} holds control characters{_BACKSLASHES}")
    if isinstance(value, list):
        return ",".join(str(item) for item in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def write_config(ctx: typer.Context, values: Named) -> str:
    """Format a call's inputs and options, with defaults but without None, for `load_config`."""
    lines = [f"[{ctx.info_name}]"]
    constants: list[str] = []
    for parameter in ctx.command.params:
        name = str(parameter.name)
        value = values.get(str(parameter.name))
        if name in _NOT_KEPT or value in (None, [], ()):
            continue
        if name == "set":
            constants = list(value)
            continue
        many = parameter.nargs == -1
        shown = [str(item) for item in value] if many else _simplify(value)
        lines.append(f"{_find_long_name(parameter)} = {_toml(shown)}")
    if constants:
        lines.append(f"[{ctx.info_name}.set]")
        pairs = (text.partition("=") for text in constants)
        lines += [f"{name.strip()} = {_toml(value.strip())}" for name, _, value in pairs]
    return "\n".join(lines) + "\n"


def _simplify(value: Any) -> Any:
    """Return an option's value as a TOML type: 5,10 becomes [5, 10], 10.0 becomes 10, the rest text."""
    if isinstance(value, list):
        items = [_simplify(item) for item in value]
        return items if len(items) > 1 else items[0]
    if isinstance(value, tuple) and type(value).__str__ is tuple.__str__:
        return [_simplify(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return int(value)
    if isinstance(value, bool | int | float) and math.isfinite(value):
        return value
    text = str(value)
    return int(text) if isinstance(value, Count | tuple) and text.isdecimal() else text
