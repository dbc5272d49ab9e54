"""Constants by name: the fields of config dataclasses, as `--set`, config files and reports write them.

A config is a dataclass whose fields are constants, or configs in their turn. A constant has its field's name
after that of the config it stands in: `rates.means`, `simplify.max_energy`. What a new field is called comes
from its class: nothing is listed. A field whose metadata says `constant=False` is worked out by the program,
and none; one with a `prefix` names the constants of the config it holds by that.
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from g2ard.errors import InputError

__all__ = ["changed", "full_names", "listed", "parsed", "values_of"]

Config = TypeVar("Config")
_UNIONS = (Union, types.UnionType)


def parsed(texts: Iterable[str], configs: Mapping[str, Any], without: Iterable[str] = ()) -> dict[str, Any]:
    """Read `NAME=VALUE` for the constants of configs; of a name given twice the last counts.

    The prefix may be left out where only one config has a field of that name. Values are checked against the
    field's type: numbers (`1e-3`, `inf`), `true` or `false`, words, `0.36,0.1` for tuples, and `none` where
    the field may be None.

    Args:
        texts: as typed.
        configs: prefix → dataclass; only their fields' names and types count.
        without: fields of theirs, not of configs within them, that are set in other ways.

    Returns:
        Full name → value, for `changed`.

    Raises:
        InputError: no `=`, no such constant (near ones are named), several of that name, another type, or one
            of `without`.

    >>> from g2ard.stages.recover.anchors import PRESETS
    >>> parsed(["regularizers.anchor=1e-3", "period=50"], {"regularizers": PRESETS["lift"]})
    {'regularizers.anchor': 0.001, 'regularizers.period': 50}
    """
    others = {f"{root}.{name}" for root in configs for name in without}
    known = {name: kind for name, kind, _ in _all(configs) if name not in others}
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"expected NAME=VALUE, not {text!r}")
        if name.strip() in others:
            raise InputError(f"{name.strip()}: there is an option for that")
        full = _full(name.strip(), known)
        values[full] = _read(full, value.strip(), known[full])
    return values


def full_names(values: Mapping[str, Any], configs: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the full names of constants; as `parsed`, a prefix may be left out where none else has it.

    Raises:
        InputError: a name that no config has, or several have.

    >>> from g2ard.stages.recover.schedule import PAPER
    >>> full_names({"means": 1e-3}, {"schedule": PAPER})
    {'rates.means': 0.001}
    """
    known = {name: kind for name, kind, _ in _all(configs)}
    return {_full(name, known): value for name, value in values.items()}


def changed(config: Config, root: str, values: Mapping[str, Any]) -> Config:
    """The config with constants replaced, those of configs within it included.

    Args:
        config: a dataclass.
        root: the prefix of its own fields.
        values: by full name, see `parsed`; what the config does not have is left alone.

    Raises:
        InputError: a value out of its range.

    >>> from g2ard.stages.recover.schedule import PAPER
    >>> changed(PAPER, "schedule", {"rates.means": 1e-3, "schedule.steps": 300}).rates.means
    0.001
    """
    new: dict[str, Any] = {}
    for f in fields(config):  # type: ignore[arg-type]
        held = getattr(config, f.name)
        if is_dataclass(held):
            inner = changed(held, f.metadata.get("prefix", f.name), values)
            if inner != held:
                new[f.name] = inner
        elif f"{root}.{f.name}" in values:
            new[f.name] = values[f"{root}.{f.name}"]
    if not new:
        return config
    try:
        return replace(config, **new)  # type: ignore[type-var]
    except InputError as error:
        if error.parameter not in new:
            raise
        raise error.at(parameter=f"{root}.{error.parameter}") from None


def listed(configs: Mapping[str, Any], without: Iterable[str] = ()) -> dict[str, dict[str, Any]]:
    """Every constant of configs by prefix and field, as JSON can hold it: what is infinite is "inf".

    Args:
        configs: prefix → dataclass.
        without: fields of theirs, not of configs within them, to leave out.

    >>> from g2ard.stages.recover.anchors import PRESETS
    >>> listed({"regularizers": PRESETS["lift"]})["regularizers"]["shape"]
    1.0
    """
    left_out = {f"{root}.{name}" for root in configs for name in without}
    out: dict[str, dict[str, Any]] = {}
    for name, value in values_of(configs).items():
        if name not in left_out:
            prefix, _, key = name.rpartition(".")
            infinite = isinstance(value, float) and math.isinf(value)
            out.setdefault(prefix, {})[key] = str(value) if infinite else value
    return out


def values_of(configs: Mapping[str, Any]) -> dict[str, Any]:
    """Every constant of configs by full name: `changed` makes the same of other configs with it.

    >>> from g2ard.stages.recover.schedule import PAPER, TUNED
    >>> changed(TUNED, "schedule", values_of({"schedule": PAPER})) == PAPER
    True
    """
    return {name: value for name, _, value in _all(configs)}


def _all(configs: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for root, config in configs.items():
        yield from _walk(config, root)


def _walk(config: Any, root: str) -> Iterator[tuple[str, Any, Any]]:
    """Full name, type and value of every constant."""
    kinds = get_type_hints(type(config))
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            yield from _walk(value, f.metadata.get("prefix", f.name))
        elif f.metadata.get("constant", True):
            yield f"{root}.{f.name}", kinds[f.name], value


def _full(name: str, known: Mapping[str, Any]) -> str:
    """The full name of what was typed."""
    if name in known:
        return name
    same = [full for full in known if full.rpartition(".")[2] == name]
    if len(same) == 1:
        return same[0]
    if same:
        raise InputError(f"{name!r} could be {' or '.join(same)}")
    prefix, _, last = name.rpartition(".")
    close = get_close_matches(last, sorted({full.rpartition(".")[2] for full in known}), 3, 0.6)
    near = [full for word in close for full in known if full.endswith(f".{word}")]
    if near:
        raise InputError(f"no constant {name!r}; did you mean {' or '.join(near)}?")
    within = [full for full in known if full.startswith(f"{prefix}.")]
    raise InputError(f"no constant {name!r}; there are {', '.join(within or known)}")


def _read(name: str, text: str, kind: Any) -> Any:
    for option in get_args(kind) if get_origin(kind) in _UNIONS else (kind,):
        try:
            return _as(option, text)
        except ValueError:
            continue
    raise InputError(f"expected {_described(kind)}, not {text!r}", parameter=name)


def _as(kind: Any, text: str) -> Any:
    """`text` as one type; ValueError where it is none of it."""
    if get_origin(kind) is Literal and text in get_args(kind):
        return text
    if get_origin(kind) is tuple:
        parts = text.strip("()[]").split(",")
        return tuple(_as(k, part.strip()) for k, part in zip(get_args(kind), parts, strict=True))
    if kind is type(None) and text.lower() == "none":
        return None
    if kind is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if kind is str:
        return text
    if kind is int or (kind is float and not math.isnan(float(text))):
        return kind(text)
    raise ValueError(text)


def _described(kind: Any) -> str:
    if get_origin(kind) in _UNIONS:
        return " or ".join(_described(option) for option in get_args(kind))
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    if get_origin(kind) is tuple:
        return f"{len(get_args(kind))} numbers with commas between"
    words = {bool: "true or false", int: "a whole number", float: "a number", type(None): "none"}
    return words.get(kind, "text")
