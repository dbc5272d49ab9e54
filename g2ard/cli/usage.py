"""One-line messages: usage errors, and library errors with flags for parameters."""

import re
import sys
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any, Literal

import typer

from g2ard.cli.budget_options import BUDGET_FLAGS, BUDGETS
from g2ard.config.checks import described
from g2ard.errors import G2ardError

_FLAGS = {"overwrite=True": "-w (--overwrite)"}
"""Parameters, alone or with a value, whose flag has another name."""


def map_flags(command: Any) -> dict[str, str]:
    """Return the long flag of each option of a command, by parameter."""
    options = (p for p in command.params if p.param_type_name == "option")
    return {str(option.name): max(option.opts, key=len) for option in options}


def spell_in_flags(error: G2ardError, flags: Mapping[str, str]) -> str:
    """Return an error's line with flags instead of parameters.

    >>> from g2ard.errors import InputError, OutputError
    >>> spell_in_flags(OutputError("exists", path="a.ply", hint="{overwrite=True} replaces it"), {})
    'a.ply: exists; -w (--overwrite) replaces it'
    >>> error = InputError("has no focal length", path="a.jpg", hint="give {focal=PIXELS}")
    >>> spell_in_flags(error, {"focal": "--focal"})
    'a.jpg: has no focal length; give --focal PIXELS'
    """

    def spelled(name: str, value: str | None) -> str:
        full = name if value is None else f"{name}={value}"
        if full in _FLAGS:
            return _FLAGS[full]
        if name not in flags:
            return full
        return flags[name] if value in (None, "True") else f"{flags[name]} {value}"

    return error.line(spelled)


def suggest_names(words: Iterable[str], known: Iterable[str]) -> str:
    """List unknown words, each with the known words that are close to it.

    >>> suggest_names(["rato", "zzz"], ["ratio", "count"])
    'rato (did you mean ratio?), zzz'
    """
    from difflib import get_close_matches

    there = sorted(known)
    told = []
    for word in sorted(words):
        near = get_close_matches(word, there, 2)
        told.append(f"{word} (did you mean {' or '.join(near)}?)" if near else word)
    return ", ".join(told)


def describe_usage_error(error: typer.TyperException) -> str:
    """Return the line for a usage error: typer's message, or a shorter one for an invalid value."""
    refused = getattr(error.__cause__, "errors", None)
    parameter: Any = getattr(error, "param", None)
    missing = _list_missing(error) if type(error).__name__ == "MissingParameter" else []
    if missing:
        return f"missing {' and '.join(missing)}"
    long = _find_single_dash(error)
    if long is not None:
        return f"{long[1:]}: long options need two dashes; write {long}"
    # a check of several options at once
    if isinstance(error, typer.BadParameter) and parameter is None:
        return error.message
    if refused is None or parameter is None:
        return " ".join(error.format_message().split())
    given = refused()[0]["input"]
    ctx = getattr(error, "ctx", None)
    in_file = ctx is not None and _find_source(ctx, parameter.name) == "DEFAULT_MAP"
    source = f" (from {ctx.params['config']})" if ctx and in_file else ""
    expected = f"expected {_describe_allowed(parameter)}, got {given!r}"
    return f"Invalid value for {parameter.get_error_hint()}: {expected}{source}"


def _list_missing(error: Any) -> list[str]:
    """List a missing option with the others that are missing too, and the budget."""
    options = [p for p in error.ctx.command.params if p.param_type_name == "option"]
    if error.param not in options:
        return []
    given = set(error.ctx.default_map or {})
    for word in sys.argv[1:]:
        given |= {word.partition("=")[0], word[:2]}
    missing = [p for p in options if not given & {*p.opts, p.name}]
    found = [f"{min(p.opts, key=len)} {p.metavar or p.name.upper()}" for p in missing if p.required]
    # some commands have a budget for one option alone
    if {p.name for p in missing} >= BUDGETS.keys():
        found.append(f"a budget ({BUDGET_FLAGS})")
    return found


def _find_single_dash(error: typer.TyperException) -> str | None:
    """Return a long option that was typed with a single dash, if any."""
    command: Any = getattr(getattr(error, "ctx", None), "command", None)
    known = set(chain.from_iterable(parameter.opts for parameter in getattr(command, "params", ())))
    for word in sys.argv[1:]:
        long = f"-{word.partition('=')[0]}"
        if len(word) > 2 and re.match(r"--\w", long) and long in known:
            return long
    return None


def is_typed(ctx: typer.Context, name: str) -> bool:
    """Return whether an option was typed, rather than read from a config file or left at its default."""
    return _find_source(ctx, name) == "COMMANDLINE"


def _find_source(ctx: typer.Context, name: str) -> str:
    return getattr(ctx.get_parameter_source(name), "name", "")


def _describe_allowed(parameter: Any) -> str:
    """Describe the values an option accepts: choices, true or false, or a number within bounds."""
    descriptor = parameter.type_descriptor
    if descriptor.choices is not None:
        return described(Literal[tuple(descriptor.choices)])
    kinds = {bool: "true or false", int: "a whole number", float: "a number"}
    low = descriptor.parameter_info.min
    high = descriptor.parameter_info.max
    kind = kinds.get(descriptor.annotation, "another value")
    if low is None and high is None:
        return kind
    if low is None:
        return f"{kind} of at most {high}"
    if high is None:
        return f"{kind} of at least {low}"
    return f"{kind} from {low} to {high}"
