"""What is said of a bad option: its name, what it takes and what it was given, in one line of our own."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from typing import Any

import typer

__all__ = ["in_flags", "meant", "present_name", "typed", "usage_line"]

_FLAGS = {
    "overwrite=True replaces it": "give -w (--overwrite) to replace it",
    "another checkpoint or folder of work starts anew": "-w without --resume starts anew",
    "engine 'gsplat'": "--device cuda",
    "engine 'fused' needs none": "--device cpu needs none",
    "count, ratio:": "-n, -r:",
    "to take a ratio of: give a count": "to take a ratio of: give a count, -n COUNT",
    "that fit could be measured on: give a count": "that --fit could be measured on: give -n COUNT",
    "that min_psnr could be measured on: give a count": "that --min-psnr could be measured on: give -n COUNT",
    "that min_ssim could be measured on: give a count": "that --min-ssim could be measured on: give -n COUNT",
    "photos=True: a pool": "--photos: a pool",
    "its photos are needed as views": "give its photos with --views",
    "TeacherRenders of a scene can stand in": "--teacher SCENE stands in with its renders",
    "views that hold them, or focal=PIXELS": "--intrinsics VIEWS or --focal PIXELS",
    "photos=None takes renders there": "without --photos the scene's render stands in for it",
    "crop ": "--crop ",
}
"""What the library calls by the name of a parameter → what a shell calls it."""


_DAMAGED = re.compile(r": (truncated|not a whole|broken|stream \d+ (holds|unpacks))|cut off")
"""What readers say of a file that is not as its writer left it."""


def in_flags(message: str) -> str:
    """An error of the library in the words of the command line, with what to do about a damaged file.

    >>> in_flags("a.ply: exists; overwrite=True replaces it")
    'a.ply: exists; give -w (--overwrite) to replace it'
    >>> in_flags("a.spz: truncated in stream 2")
    'a.spz: truncated in stream 2; the file is damaged: copy or export it again'
    """
    for words, flag in _FLAGS.items():
        if words != "crop " or message.startswith(words):
            message = message.replace(words, flag)
    return f"{message}; the file is damaged: copy or export it again" if _DAMAGED.search(message) else message


_RENAMED = {"time-limit": "recovery-time"}
"""What options were called before → what they are called; the old names are still taken, and not shown."""


def present_name(name: str) -> str:
    """What an option is called now, as it stands after its dashes.

    >>> present_name("time-limit"), present_name("ratio")
    ('recovery-time', 'ratio')
    """
    return _RENAMED.get(name, name)


def meant(words: Iterable[str], known: Iterable[str]) -> str:
    """Words that nothing is called, each with those near to it that something is.

    >>> meant(["rato", "zzz"], ["ratio", "count"])
    'rato (did you mean ratio?), zzz'
    """
    from difflib import get_close_matches

    there, told = sorted(known), []
    for word in sorted(words):
        near = get_close_matches(word, there, 2)
        told.append(f"{word} (did you mean {' or '.join(near)}?)" if near else word)
    return ", ".join(told)


def usage_line(error: typer.TyperException) -> str:
    """Typer's message for a usage error; where it quotes the library that checks values, ours."""
    refused = getattr(error.__cause__, "errors", None)
    parameter: Any = getattr(error, "param", None)
    if (long := _of_one_dash(error)) is not None:
        return f"{long[1:]}: long options have two dashes: {long}"
    if isinstance(error, typer.BadParameter) and parameter is None:  # a check of several options at once
        return error.message
    if refused is None or parameter is None:
        return " ".join(error.format_message().split())
    given = refused()[0]["input"]
    source = _config_of(error, parameter.name)
    return f"Invalid value for {parameter.get_error_hint()}: {_allowed(parameter)}, not {given!r}{source}"


def _of_one_dash(error: typer.TyperException) -> str | None:
    """The long option that stands on the command line with one dash, which reads as several letters."""
    command: Any = getattr(getattr(error, "ctx", None), "command", None)
    long = {flag for parameter in getattr(command, "params", ()) for flag in parameter.opts}
    words = (f"-{word.partition('=')[0]}" for word in sys.argv[1:] if len(word) > 2)
    return next((word for word in words if re.match(r"--\w", word) and word in long), None)


def typed(ctx: typer.Context, name: str) -> bool:
    """Whether an option stands on the command line, rather than in a config file or nowhere."""
    return _source(ctx, name) == "COMMANDLINE"


def _source(ctx: typer.Context, name: str) -> str:
    return getattr(ctx.get_parameter_source(name), "name", "")


def _config_of(error: typer.TyperException, name: str) -> str:
    ctx = getattr(error, "ctx", None)
    return f" (from {ctx.params['config']})" if ctx and _source(ctx, name) == "DEFAULT_MAP" else ""


def _allowed(parameter: Any) -> str:
    """What an option takes: one of several words, yes or no, or a number within bounds."""
    descriptor = parameter.type_descriptor
    if descriptor.choices is not None:
        return f"one of {', '.join(map(str, descriptor.choices))}"
    kinds = {bool: "true or false", int: "a whole number", float: "a number"}
    low, high = descriptor.parameter_info.min, descriptor.parameter_info.max
    bounds = {
        (True, True): f" from {low} to {high}",
        (True, False): f" of at least {low}",
        (False, True): f" of at most {high}",
        (False, False): "",
    }
    return kinds.get(descriptor.annotation, "another value") + bounds[low is not None, high is not None]
