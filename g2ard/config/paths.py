"""Fields of nested config dataclasses by dotted path, as used by `--set`, config files, presets and reports.

A config is a frozen dataclass whose fields are values or other configs. A stage's config roots its paths:
`RecoverConfig` → `recover`. A config that only joins others, such as `DistillConfig`, adds no prefix.
Any unambiguous tail names a path: `rates.means` is `recover.schedule.rates.means`. If several paths end
alike, the one nearest the root wins: `steps` is `recover.steps`.

A config with a classmethod `named` can be set as a whole by name: `recover.schedule=fast`. Fields marked
`setting=False` are computed and cannot be set.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from g2ard.config.checks import check_type, described, options_of
from g2ard.errors import InputError

Config = TypeVar("Config")


def parse_settings(texts: Iterable[str], config: Any) -> dict[str, Any]:
    """Parse `PATH=VALUE` texts for a config; the last value of a repeated path wins.

    Values are checked against the field's type: numbers (`1e-3`, `inf`), `true` or `false`, names, `0.36,0.1`
    for tuples, `1,2;3,4` for tuples of tuples, and `none` if the field may be None.

    Returns:
        Full path → value, for `changed`.

    Raises:
        InputError: no `=`, an unknown or ambiguous path, or a value of another type.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> parse_settings(["regularizers.anchor=1e-3", "period=50", "schedule=fast"], RecoverConfig())
    {'recover.regularizers.anchor': 0.001, 'recover.regularizers.period': 50, 'recover.schedule': 'fast'}
    """
    known = {leaf.path: leaf for leaf in _leaves(config)}
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"expected PATH=VALUE, got {text!r}")
        path = _full(name.strip(), known)
        values[path] = _read(path, value.strip(), known[path].kind)
    return values


def full_paths(values: Mapping[str, Any], config: Any) -> dict[str, Any]:
    """Expand the keys of `values` to full paths.

    Raises:
        InputError: an unknown or ambiguous path, or a value of another type.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> full_paths({"rates.means": 1e-3, "steps": 100}, RecoverConfig())
    {'recover.schedule.rates.means': 0.001, 'recover.steps': 100}
    """
    known = {leaf.path: leaf for leaf in _leaves(config)}
    found = {}
    for name, value in values.items():
        path = _full(name, known)
        if get_origin(known[path].kind) is tuple and hasattr(value, "tolist"):
            value = tuple(value.tolist())
        if not hasattr(known[path].value, "named"):
            check_type(name, value, known[path].kind)
        found[path] = value
    return found


def changed(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the config with values replaced, including those of nested configs.

    A nested config given as a whole (by name or as an object) is replaced before its fields.

    Args:
        values: by full path; paths that the config does not have are ignored.

    Raises:
        InputError: a value out of its range, or an unknown name.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = changed(RecoverConfig(), {"recover.schedule": "paper", "recover.schedule.rates.means": 1e-3})
    >>> config.schedule.rates.means, config.schedule.round_steps
    (0.001, 8000)
    """
    return _changed(config, _root(config), values)


def listed(config: Any) -> dict[str, Any]:
    """Return every value of a config by full path in JSON form, with infinity as "inf".

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> listed(RecoverConfig())["recover.regularizers.period"]
    100
    """
    return {
        path: str(value) if isinstance(value, float) and math.isinf(value) else value
        for path, value in values_of(config).items()
    }


def values_of(config: Any) -> dict[str, Any]:
    """Return every value of a config by full path, as `changed` accepts it.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = RecoverConfig(steps=9)
    >>> changed(RecoverConfig(), values_of(config)) == config
    True
    """
    return {leaf.path: leaf.value for leaf in _leaves(config) if not is_dataclass(leaf.value)}


@dataclass(frozen=True)
class _Leaf:
    """A field that can be set: its full path, type and value."""

    path: str
    kind: Any
    value: Any


def _leaves(config: Any, root: str | None = None) -> Iterator[_Leaf]:
    root = _root(config) if root is None else root
    kinds = get_type_hints(type(config))
    for f in fields(config):
        path, value = _joined(root, f.name), getattr(config, f.name)
        if is_dataclass(value):
            if hasattr(value, "named"):
                yield _Leaf(path, str, value)
            yield from _leaves(value, path)
        elif f.metadata.get("setting", True):
            yield _Leaf(path, kinds[f.name], value)


def _root(config: Any) -> str:
    if all(is_dataclass(getattr(config, f.name)) for f in fields(config)):
        return ""
    return type(config).__name__.removesuffix("Config").lower()


def _joined(root: str, name: str) -> str:
    return f"{root}.{name}" if root else name


def _changed(config: Any, root: str, values: Mapping[str, Any]) -> Any:
    new: dict[str, Any] = {}
    for f in fields(config):
        path, held = _joined(root, f.name), getattr(config, f.name)
        if is_dataclass(held) and not isinstance(held, type):
            inner = _changed(_whole(held, values.get(path, held), path), path, values)
            if inner != held:
                new[f.name] = inner
        elif path in values:
            new[f.name] = values[path]
    if not new:
        return config
    try:
        return replace(config, **new)
    except InputError as error:
        if error.parameter not in new:
            raise
        raise error.at(parameter=_joined(root, error.parameter)) from None


def _whole(held: Any, value: Any, path: str) -> Any:
    """Return the config that `value` names, or `value` itself if it is a config."""
    if not isinstance(value, str):
        return value
    try:
        return type(held).named(value)
    except InputError as error:
        raise error.at(parameter=path) from None


def _full(name: str, known: Mapping[str, Any]) -> str:
    """Expand a path or an unambiguous tail of one."""
    if name in known:
        return name
    same = [path for path in known if path.endswith(f".{name}")]
    nearest = min((path.count(".") for path in same), default=0)
    same = [path for path in same if path.count(".") == nearest]
    if len(same) == 1:
        return same[0]
    if same:
        raise InputError(f"ambiguous setting {name!r}; use {' or '.join(same)}")
    prefix, _, last = name.rpartition(".")
    close = get_close_matches(last, sorted({path.rpartition(".")[2] for path in known}), 3, 0.6)
    near = [path for word in close for path in known if path.endswith(f".{word}")]
    if near:
        raise InputError(f"unknown setting {name!r}; did you mean {' or '.join(near)}?")
    within = [path for path in known if path.startswith(f"{prefix}.")]
    raise InputError(f"unknown setting {name!r}; expected one of {', '.join(within or known)}")


def _read(path: str, text: str, kind: Any) -> Any:
    for option in options_of(kind):
        try:
            return _as(option, text)
        except ValueError:
            continue
    raise InputError(f"expected {described(kind)}, got {text!r}", parameter=path)


def _as(kind: Any, text: str) -> Any:
    """Parse `text` as one type, or raise ValueError."""
    if get_origin(kind) is Literal and text in get_args(kind):
        return text
    if get_origin(kind) is tuple:
        kinds, text = get_args(kind), text.strip("()[]")
        if kinds[-1] is Ellipsis:
            mark = ";" if get_origin(kinds[0]) is tuple else ","
            return tuple(_as(kinds[0], part.strip()) for part in text.split(mark) if part.strip())
        return tuple(_as(k, part.strip()) for k, part in zip(kinds, text.split(","), strict=True))
    if kind is type(None) and text.lower() == "none":
        return None
    if kind is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if kind is str:
        return text
    if kind is int or (kind is float and not math.isnan(float(text))):
        return kind(text)
    raise ValueError(text)
