"""Checks of values against the annotated types of arguments and of config fields."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cache, wraps
from numbers import Integral, Real
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from g2ard.config.choices import Engine
from g2ard.errors import InputError, UsageError, require

P = ParamSpec("P")
Result = TypeVar("Result")

_UNIONS = (Union, types.UnionType)
_SCALARS = (bool, int, float, str, type(None))
_LONGEST = 60
"""Longest text of a value in a message; a longer one is described by its type."""


@dataclass(frozen=True)
class Within:
    """Limits of a number as an interval: `Annotated[float, Within("[0, 1)")]`.

    >>> str(Within("(0, inf)")), str(Within("[1, inf)")), str(Within("[0, 1)"))
    ('above 0', 'of at least 1', 'in [0, 1)')
    """

    interval: str

    def __contains__(self, value: float) -> bool:
        low, high = _parse_ends(self.interval)
        above = value >= low if self.interval[0] == "[" else value > low
        return above and (value <= high if self.interval[-1] == "]" else value < high)

    def __str__(self) -> str:
        low, high = _parse_ends(self.interval)
        if math.isfinite(high):
            return f"in {self.interval}"
        if math.isinf(low):
            return ""
        return f"of at least {low:g}" if self.interval[0] == "[" else f"above {low:g}"


@cache
def _parse_ends(interval: str) -> tuple[float, float]:
    low, high = interval[1:-1].split(",")
    return float(low), float(high)


Share = Annotated[float, Within("[0, 1]")]
Positive = Annotated[float, Within("(0, inf)")]
AboveZero = Annotated[float, Within("(0, inf]")]
Finite = Annotated[float, Within("(-inf, inf)")]
Degree = Annotated[int, Within("[0, 3]")]
NotNegative = Annotated[float, Within("[0, inf)")]
AtLeastOne = Annotated[int, Within("[1, inf)")]


def check_fields(config: Any) -> None:
    """Reject the first value of a dataclass that does not have the type of its field."""
    owner: Any = type(config)
    kinds = _find_hints(owner)
    for field in fields(config):
        _check(field.name, getattr(config, field.name), kinds[field.name])


def check_type(name: str, value: Any, kind: Any) -> None:
    """Reject a value that does not have the annotated type `kind`.

    Whole numbers are also numbers, NaN is no number, and a list can be a tuple. Types that cannot be tested,
    such as protocols and arrays, are not checked.

    >>> check_type("seed", 3, int)
    >>> check_type("seed", 2.5, int | None)
    Traceback (most recent call last):
    g2ard.errors.InputError: seed: expected a whole number or none, got 2.5
    """
    if not _fits(value, kind):
        got = repr(value)
        if len(got) > _LONGEST or "\n" in got:
            got = f"a value of type {type(value).__name__}"
        one = isinstance(value, list | tuple) and all(
            bare(option) in _SCALARS for option in options_of(kind)
        )
        wanted, hint = ("one value", "call once per value") if one else (described(kind), None)
        raise InputError(f"expected {wanted}, got {got}", parameter=name, hint=hint)


def check_seed(name: str, seed: Any) -> None:
    """Reject a seed that is not a whole number of at least 0."""
    check_type(name, seed, int)
    require(name, seed, seed >= 0, "a whole number of at least 0")


def check_vector(name: str, vector: Any) -> None:
    """Reject a point or direction that is not three finite numbers."""
    values = vector.tolist() if hasattr(vector, "tolist") else vector
    if not _fits(values, tuple[float, float, float]) or not all(map(math.isfinite, values)):
        raise InputError(f"expected three finite numbers, got {vector!r}", parameter=name)


def check_direction(name: str, direction: Any) -> None:
    """Reject a direction that is not three finite numbers, or zero."""
    check_vector(name, direction)
    if not any(direction):
        raise InputError(
            f"expected three finite numbers, not all zero, got {direction!r}", parameter=name
        )


def check_colour(name: str, colour: Any) -> None:
    """Reject a colour that is not three numbers from 0 to 1.

    >>> check_colour("background", (0, 0, 255))
    Traceback (most recent call last):
    g2ard.errors.InputError: background: expected 3 numbers from 0 to 1 (red, green, blue), got (0, 0, 255)
    """
    if hasattr(colour, "tolist"):
        colour = colour.tolist()
    if not _fits(colour, tuple[float, float, float]) or not all(
        0 <= channel <= 1 for channel in colour
    ):
        raise InputError(
            f"expected 3 numbers from 0 to 1 (red, green, blue), got {colour!r}", parameter=name
        )


_SHARED = {"seed": check_seed, "up": check_direction, "background": check_colour}
"""Arguments and fields that mean the same everywhere → their checks."""


def _check(name: str, value: Any, kind: Any) -> None:
    if name not in _SHARED or (value is None and _fits(None, kind)):
        check_type(name, value, kind)
    else:
        _SHARED[name](name, value)


def checks_arguments(function: Callable[P, Result]) -> Callable[P, Result]:
    """Check every argument of a public function before the call, like `check_fields`.

    A function that does so already is returned as it is.
    """
    if hasattr(function, "__wrapped__"):
        return function
    signature = inspect.signature(function)
    loose = {name for name, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD}

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> Result:
        kinds = _find_hints(function)
        unknown = [] if loose else [name for name in kwargs if name not in signature.parameters]
        if unknown:
            near = nearest(unknown[0], [name for name in signature.parameters if name != "self"])
            raise UsageError(f"{function.__name__}() has no keyword {unknown[0]!r}; {near}")
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            raise UsageError(f"{function.__name__}(): {error}") from None
        for name, value in bound.arguments.items():
            if name in kinds and name not in loose:
                _check(name, value, kinds[name])
        return function(*args, **kwargs)

    return checked


def nearest(name: str, listed: Iterable[str], known: Iterable[str] | None = None) -> str:
    """Return a question for the names most like an unknown one, or else the list.

    >>> nearest("ratoi", ["count", "ratio"]), nearest("x", ["count", "ratio"])
    ('did you mean ratio?', 'expected one of count, ratio')
    """
    listed = list(listed)
    close = get_close_matches(name, sorted(listed if known is None else known), 1)
    if close:
        return f"did you mean {close[0]}?"
    return f"expected one of {', '.join(listed)}"


def signature_of(other: Callable[P, Any]) -> Callable[[Callable[..., Result]], Callable[P, Result]]:
    """Give a function that passes its arguments on the signature of the function that takes them."""

    def decorated(function: Any) -> Any:
        function.__wrapped__ = other
        return function

    return decorated


def described(kind: Any) -> str:
    """Describe a type in an error message.

    >>> described(int | None), described(Literal["a", "b"]), described(tuple[float, float])
    ('a whole number or none', 'one of a, b', '2 comma-separated numbers')
    """
    if get_origin(kind) in _UNIONS:
        return " or ".join(dict.fromkeys(map(described, options_of(kind))))
    if get_origin(kind) is Annotated:
        limits = kind.__metadata__[0]
        finite = bare(kind) is float and limits.interval.endswith("inf)")
        return f"{'a finite number' if finite else described(bare(kind))} {limits}".rstrip()
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}{_REMARKS.get(kind, '')}"
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if kinds[-1] is Ellipsis:
            return "comma-separated numbers"
        return f"{len(kinds)} comma-separated numbers"
    if get_origin(kind) is Sequence:
        return "several numbers" if get_args(kind) == (float,) else "several values"
    words: dict[Any, str] = {
        _Array: "an array of numbers",
        Mapping: "names with values",
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "text",
        type(None): "none",
    }
    return words.get(get_origin(kind) or kind) or str(getattr(kind, "__name__", kind))


def options_of(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union, or the only type."""
    return get_args(kind) if get_origin(kind) in _UNIONS else (kind,)


def bare(kind: Any) -> Any:
    """Return a type without its limits."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


_REMARKS: dict[Any, str] = {Engine: " (the device gpu runs fused on a GPU)"}


class _Array:
    """Type of arrays, and of what numpy makes arrays of."""

    def __class_getitem__(cls, _: Any) -> type[_Array]:
        return cls


_ARRAY_NAMES = dict.fromkeys(
    ("ArrayLike", "NDArray", "Bytes", "Float", "Float32", "Int", "Mask", "Rows", "Values"), _Array
)
"""Names of array types in annotations. `g2ard.arrays` itself loads numpy, too slow for `--help`."""


@cache
def _find_hints(owner: Any) -> dict[str, Any]:
    """Return the types of fields or arguments; `object` for names imported for type checkers only."""
    if isinstance(owner, type):
        return get_type_hints(owner, localns=_ARRAY_NAMES, include_extras=True)
    hints: dict[str, Any] = {}
    for name, kind in owner.__annotations__.items():
        alone: Any = types.SimpleNamespace(__annotations__={name: kind})
        try:
            hints |= get_type_hints(alone, owner.__globals__, _ARRAY_NAMES, include_extras=True)
        except NameError:
            hints[name] = object
    return hints


def _fits(value: Any, kind: Any) -> bool:
    if kind is _Array or kind is Any:
        return kind is Any or _is_array(value)
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in _UNIONS:
        return any(_fits(value, option) for option in inner)
    if origin is Annotated:
        return _fits(value, inner[0]) and value in kind.__metadata__[0]
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is tuple or origin is Sequence:
        several = hasattr(value, "__len__") and not isinstance(value, str)
        if origin is Sequence and several and isinstance(value, list | tuple):
            return all(_fits(one, inner[0]) for one in value)
        if origin is Sequence or not several or inner[-1] is Ellipsis:
            return several
        return (
            isinstance(value, list | tuple)
            and len(value) == len(inner)
            and all(map(_fits, value, inner))
        )
    if origin is Mapping:
        return isinstance(value, Mapping)
    if kind is bool:
        return isinstance(value, bool) or getattr(getattr(value, "dtype", None), "kind", "") == "b"
    if kind is int or kind is float:
        number = isinstance(value, Integral if kind is int else Real) and not isinstance(
            value, bool
        )
        return number and not (kind is float and math.isnan(float(value)))
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, kind)


def _is_array(value: Any) -> bool:
    import numpy as np

    if not hasattr(value, "dtype"):
        try:
            value = np.asarray(value)
        except (TypeError, ValueError):  # rows of several lengths
            return False
    return value.ndim > 0 and (not isinstance(value, np.ndarray) or value.dtype.kind in "biuf")
