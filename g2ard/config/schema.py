"""Settings by dotted path: one schema for flags, `--set`, config files, presets, keywords and reports.

`Settings` is the base of frozen dataclasses whose fields are values or other settings. Values are checked
when they are made: by type, by the limits of an annotated type, and by name. What depends on a choice, such
as the method, is a variant of its own, so that a setting without effect cannot be given.

A stage's settings root their paths: `RecoverConfig` → `recover`. Settings that only join others, such as
`DistillConfig`, add no prefix. Any unambiguous tail names a path: `rates.means` is
`recover.schedule.rates.means`. If several paths end alike, the one nearest the root wins: `steps` is
`recover.steps`.

Settings with a classmethod `named` can be set as a whole by name: `recover.schedule=fast`. Fields marked
`setting=False` are computed and cannot be set; of those marked `whole=True` no single field can be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from inspect import signature
from typing import Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin, get_type_hints

from g2ard.config.checks import bare, check_fields, check_type, described, nearest, options_of
from g2ard.errors import InputError

Config = TypeVar("Config")


class Settings:
    """Base of settings: frozen dataclasses whose values are checked.

    `class SimplifyConfig(Settings, tag="method")` is made as the variant that its field `method` names, and
    `class Paper(SimplifyConfig, variants=("paper",))` is one.
    """

    _tag: ClassVar[str | None] = None
    _variants: ClassVar[dict[str, Any]] = {}

    def __init_subclass__(cls, tag: str | None = None, variants: Sequence[str] = ()) -> None:
        if tag is not None:
            cls._tag = tag
            cls._variants = {}
        cls._variants.update(dict.fromkeys(variants, cls))

    def __new__(cls, *first: Any, **values: Any) -> Self:
        kind = cls
        name = None
        if cls._tag is not None and cls not in cls._variants.values():
            given = dict(zip(_list_names(cls), first, strict=False)) | values
            name = given.get(cls._tag, next(iter(cls._variants)))
            kind = cls._variant(name)
        for other in values.keys() - _list_names(kind).keys():
            raise kind._unknown(other, name)
        return object.__new__(kind)

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def _variant(cls, name: Any) -> Any:
        if not isinstance(name, str) or name not in cls._variants:
            expected = f"expected one of {', '.join(cls._variants)}, got {name!r}"
            raise InputError(expected, parameter=cls._tag)
        return cls._variants[name]

    @classmethod
    def _unknown(cls, name: str, own: str | None) -> InputError:
        """Return the error for a field that does not exist, or exists in variants other than `own` only."""
        others = [other for other, kind in cls._variants.items() if name in _list_names(kind)]
        if not others:
            return InputError(
                "is no setting",
                parameter=name,
                hint=f"there are {', '.join(_list_names(cls))}",
            )
        if not own:
            own = next(variant for variant, kind in cls._variants.items() if kind is cls)
        reason = f"has no effect on the {cls._tag} {own}, only on {' and '.join(others)}"
        return InputError(reason, parameter=name)

    def turned(self, name: str | None) -> Self:
        """Return the settings as another variant: those that differ from the default, if it has them."""
        tag = str(self._tag)
        if name in (None, getattr(self, tag)):
            return self
        kind = self._variant(name)
        usual = type(self)(**{tag: getattr(self, tag)})
        kept = {}
        for field in vars(self).keys() & _list_names(kind).keys():
            value = getattr(self, field)
            if value != getattr(usual, field):
                kept[field] = value
        kept[tag] = name
        return kind(**kept)


def _list_names(kind: Any) -> dict[str, None]:
    return dict.fromkeys(f.name for f in fields(kind))


def parse_settings(texts: Iterable[str], config: Any) -> dict[str, Any]:
    """Return full path → value of `PATH=VALUE` texts for a config; the last value of a repeated path wins.

    Values are checked against the field's type: numbers (`1e-3`, `inf`), `true` or `false`, names, `0.36,0.1`
    for tuples, `1,2;3,4` for tuples of tuples, and `none` if the field may be None.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> parse_settings(["regularizers.anchor=1e-3", "period=50", "schedule=fast"], RecoverConfig())
    {'recover.regularizers.anchor': 0.001, 'recover.regularizers.period': 50, 'recover.schedule': 'fast'}
    """
    known = {leaf.path: leaf for leaf in _list_leaves(config, every=True)}
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"expected PATH=VALUE, got {text!r}")
        path = _expand(name.strip(), known)
        kind = known[path].kind
        values[path] = _read(path, value.strip(), kind)
    return values


def full_paths(values: Mapping[str, Any], config: Any) -> dict[str, Any]:
    """Expand the keys of `values` to full paths, and check the types of the values.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> full_paths({"rates.means": 1e-3, "steps": 100}, RecoverConfig())
    {'recover.schedule.rates.means': 0.001, 'recover.steps': 100}
    """
    known = {leaf.path: leaf for leaf in _list_leaves(config, every=True)}
    found = {}
    for name, value in values.items():
        path = _expand(name, known)
        leaf = known[path]
        if get_origin(leaf.kind) is tuple and hasattr(value, "tolist"):
            value = tuple(value.tolist())
        if not hasattr(leaf.value, "named"):
            check_type(name, value, leaf.kind)
        found[path] = value
    return found


def keywords(
    function: Callable[..., Any],
    config: Any,
    given: Mapping[str, Any],
) -> dict[str, Any]:
    """Return settings given as keywords of a function that are not None.

    A name that is neither an argument nor the end of a path of `config` is answered by the nearest of these.
    """
    parameters = signature(function).parameters.values()
    arguments = [each.name for each in parameters if each.kind is not each.VAR_KEYWORD]
    paths = {leaf.path for leaf in _list_leaves(config, every=True)}
    known = {path.rpartition(".")[2] for path in paths}
    known.update(arguments)
    for name in given:
        if name not in known and name not in paths and "." not in name:
            raise InputError(f"unknown keyword {name!r}; {nearest(name, arguments, known)}")
    return {name: value for name, value in given.items() if value is not None}


def changed(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the config with values replaced, including those of nested configs.

    A nested config given as a whole (by name or as an object) is replaced before its fields.

    Args:
        values: by full path; paths that the config does not have are ignored.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = changed(RecoverConfig(), {"recover.schedule": "paper", "recover.schedule.rates.means": 1e-3})
    >>> config.schedule.rates.means, config.schedule.round_steps
    (0.001, 8000)
    """
    return _change(config, _name_root(config), values)


def listed(config: Any) -> dict[str, Any]:
    """Return every value of a config by full path in JSON form, with infinity as "inf".

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> listed(RecoverConfig())["recover.regularizers.period"]
    100
    """
    values = values_of(config)
    for path, value in values.items():
        if isinstance(value, float) and math.isinf(value):
            values[path] = str(value)
    return values


def values_of(config: Any) -> dict[str, Any]:
    """Return every value of a config by full path, as `changed` accepts it.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = RecoverConfig(steps=9)
    >>> changed(RecoverConfig(), values_of(config)) == config
    True
    """
    leaves = _list_leaves(config)
    return {leaf.path: leaf.value for leaf in leaves if not is_dataclass(leaf.value)}


@dataclass(frozen=True)
class _Leaf:
    """A field that can be set: its full path, type and value."""

    path: str
    kind: Any
    value: Any


def _list_leaves(
    config: Any,
    root: str | None = None,
    every: bool = False,
) -> Iterator[_Leaf]:
    """List what can be set; with `every`, also in other variants."""
    if root is None:
        root = _name_root(config)
    owner: Any = type(config)
    kinds = _find_kinds(owner)
    for f in fields(config):
        name = f.name
        path = _join(root, name)
        value = getattr(config, name)
        if is_dataclass(value):
            if hasattr(value, "named"):
                yield _Leaf(path, str, value)
            if not (every and f.metadata.get("whole")):
                yield from _list_leaves(value, path, every)
        elif f.metadata.get("setting", True):
            kind = kinds[name]
            if every and name == getattr(config, "_tag", None):
                kind = Literal[tuple(config._variants)]
            yield _Leaf(path, kind, value)
    if not every:
        return
    for variant in getattr(config, "_variants", {}).values():
        kinds = _find_kinds(variant)
        for f in fields(variant):
            name = f.name
            if name not in _list_names(config):
                yield _Leaf(_join(root, name), kinds[name], f.default)


@cache
def _find_kinds(config: type) -> dict[str, Any]:
    return get_type_hints(config, include_extras=True)


def _name_root(config: Any) -> str:
    if all(is_dataclass(getattr(config, f.name)) for f in fields(config)):
        return ""
    owner = type(config)
    tagged = (kind for kind in owner.__mro__ if vars(kind).get("_tag"))
    kind = next(tagged, owner)
    return kind.__name__.removesuffix("Config").lower()


def _join(root: str, name: str) -> str:
    if not root:
        return name
    return f"{root}.{name}"


def _change(config: Any, root: str, values: Mapping[str, Any]) -> Any:
    new: dict[str, Any] = {}
    if isinstance(config, Settings) and config._tag is not None:
        try:
            chosen = values.get(_join(root, config._tag), getattr(config, config._tag))
            config = config.turned(chosen)
            own = _list_names(config)
            for kind in config._variants.values():
                for name in _list_names(kind):
                    if name not in own and _join(root, name) in values:
                        raise config._unknown(name, chosen)
        except InputError as error:
            raise error.at(parameter=_join(root, str(error.parameter))) from None
    for f in fields(config):
        name = f.name
        path = _join(root, name)
        held = getattr(config, name)
        if is_dataclass(held) and not isinstance(held, type):
            whole = _resolve_whole(held, values.get(path, held), path)
            inner = _change(whole, path, values)
            if inner != held:
                new[name] = inner
        elif path in values:
            new[name] = values[path]
    if not new:
        return config
    try:
        return replace(config, **new)
    except InputError as error:
        if error.parameter not in new:
            raise
        raise error.at(parameter=_join(root, error.parameter)) from None


def _resolve_whole(held: Any, value: Any, path: str) -> Any:
    """Return the config that `value` names, or `value` itself if it is a config."""
    if not isinstance(value, str):
        return value
    try:
        return type(held).named(value)
    except InputError as error:
        raise error.at(parameter=path) from None


def _expand(name: str, known: Mapping[str, Any]) -> str:
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
    words = {path.rpartition(".")[2] for path in known}
    near = []
    for word in get_close_matches(last, sorted(words), 3, 0.6):
        near += [path for path in known if path.endswith(f".{word}")]
    if near:
        raise InputError(f"unknown setting {name!r}; did you mean {' or '.join(near)}?")
    within = [path for path in known if path.startswith(f"{prefix}.")]
    raise InputError(f"unknown setting {name!r}; expected one of {', '.join(within or known)}")


def _read(path: str, text: str, kind: Any) -> Any:
    for option in options_of(kind):
        try:
            return _parse(option, text)
        except ValueError:
            continue
    raise InputError(f"expected {described(kind)}, got {text!r}", parameter=path)


def _parse(kind: Any, text: str) -> Any:
    """Parse `text` as one type, or raise ValueError."""
    kind = bare(kind)
    if get_origin(kind) is Literal and text in get_args(kind):
        return text
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        text = text.strip("()[]")
        if kinds[-1] is not Ellipsis:
            parts = map(str.strip, text.split(","))
            return tuple(_parse(kind, part) for kind, part in zip(kinds, parts, strict=True))
        mark = ","
        if get_origin(kinds[0]) is tuple:
            mark = ";"
        parts = map(str.strip, text.split(mark))
        return tuple(_parse(kinds[0], part) for part in parts if part)
    if kind is type(None) and text.lower() == "none":
        return None
    if kind is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if kind is str:
        return text
    if kind is int:
        return int(text)
    if kind is float and not math.isnan(float(text)):
        return float(text)
    raise ValueError(text)
