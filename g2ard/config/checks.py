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
        if value == low:
            return self.interval[0] == "["
        if value == high:
            return self.interval[-1] == "]"
        return low < value < high

    def __str__(self) -> str:
        low, high = _parse_ends(self.interval)
        if math.isfinite(high):
            return f"in {self.interval}"
        if math.isinf(low):
            return ""
        if self.interval[0] == "[":
            return f"of at least {low:g}"
        return f"above {low:g}"


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
        name = field.name
        _check(name, getattr(config, name), kinds[name])


def check_type(name: str, value: Any, kind: Any) -> None:
    """Reject a value that does not have the annotated type `kind`.

    Whole numbers are also numbers, NaN is no number, and a list can be a tuple. Types that cannot be tested,
    such as protocols and arrays, are not checked.

    >>> check_type("seed", 3, int)
    >>> check_type("seed", 2.5, int | None)
    Traceback (most recent call last):
    g2ard.errors.InputError: seed: expected a whole number or none, got 2.5
    """
    if _fits(value, kind):
        return
    got = repr(value)
    if len(got) > _LONGEST or "\n" in got:
        got = f"a value of type {type(value).__name__}"
    wanted = described(kind)
    hint = None
    is_scalar = all(bare(option) in _SCALARS for option in options_of(kind))
    if is_scalar and isinstance(value, list | tuple):
        wanted = "one value"
        hint = "call once per value"
    raise InputError(f"expected {wanted}, got {got}", parameter=name, hint=hint)


def check_seed(name: str, seed: Any) -> None:
    """Reject a seed that is not a whole number of at least 0."""
    check_type(name, seed, int)
    require(name, seed, seed >= 0, "a whole number of at least 0")


def check_vector(name: str, vector: Any) -> None:
    """Reject a point or direction that is not three finite numbers."""
    values = vector
    if hasattr(vector, "tolist"):
        values = vector.tolist()
    if not _fits(values, tuple[Finite, Finite, Finite]):
        raise InputError(f"expected three finite numbers, got {vector!r}", parameter=name)


def check_direction(name: str, direction: Any) -> None:
    """Reject a direction that is not three finite numbers, or zero."""
    check_vector(name, direction)
    if not any(direction):
        text = f"expected three finite numbers, not all zero, got {direction!r}"
        raise InputError(text, parameter=name)


def check_colour(name: str, colour: Any) -> None:
    """Reject a colour that is not three numbers from 0 to 1.

    >>> check_colour("background", (0, 0, 255))
    Traceback (most recent call last):
    g2ard.errors.InputError: background: expected 3 numbers from 0 to 1 (red, green, blue), got (0, 0, 255)
    """
    if hasattr(colour, "tolist"):
        colour = colour.tolist()
    if not _fits(colour, tuple[Share, Share, Share]):
        text = f"expected 3 numbers from 0 to 1 (red, green, blue), got {colour!r}"
        raise InputError(text, parameter=name)


_SHARED = {
    "seed": check_seed,
    "up": check_direction,
    "background": check_colour,
}
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
    parameters = signature.parameters.values()
    loose = {each.name for each in parameters if each.kind is each.VAR_KEYWORD}

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> Result:
        kinds = _find_hints(function)
        for name in kwargs:
            if not loose and name not in signature.parameters:
                known = [other for other in signature.parameters if other != "self"]
                near = nearest(name, known)
                raise UsageError(f"{function.__name__}() has no keyword {name!r}; {near}")
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            raise UsageError(f"{function.__name__}(): {error}") from None
        for name, value in bound.arguments.items():
            if name in kinds and name not in loose:
                _check(name, value, kinds[name])
        return function(*args, **kwargs)

    return checked


def nearest(
    name: str,
    listed: Iterable[str],
    known: Iterable[str] | None = None,
) -> str:
    """Return a question for the names most like an unknown one, or else the list.

    >>> nearest("ratoi", ["count", "ratio"]), nearest("x", ["count", "ratio"])
    ('did you mean ratio?', 'expected one of count, ratio')
    """
    listed = list(listed)
    if known is None:
        known = listed
    close = get_close_matches(name, sorted(known), 1)
    if close:
        return f"did you mean {close[0]}?"
    return f"expected one of {', '.join(listed)}"


def signature_of(
    other: Callable[P, Any],
) -> Callable[[Callable[..., Result]], Callable[P, Result]]:
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
        number = described(bare(kind))
        if bare(kind) is float and limits.interval.endswith("inf)"):
            number = "a finite number"
        return f"{number} {limits}".rstrip()
    if get_origin(kind) is Literal:
        names = ", ".join(map(str, get_args(kind)))
        return f"one of {names}{_REMARKS.get(kind, '')}"
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if kinds[-1] is Ellipsis:
            return "comma-separated numbers"
        return f"{len(kinds)} comma-separated numbers"
    if get_origin(kind) is Sequence:
        if get_args(kind) == (float,):
            return "several numbers"
        return "several values"
    words: dict[Any, str] = {
        _Array: "an array of numbers",
        Mapping: "names with values",
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "text",
        type(None): "none",
    }
    known = get_origin(kind) or kind
    if known in words:
        return words[known]
    return str(getattr(kind, "__name__", kind))


def options_of(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union, or the only type."""
    if get_origin(kind) in _UNIONS:
        return get_args(kind)
    return (kind,)


def bare(kind: Any) -> Any:
    """Return a type without its limits."""
    if get_origin(kind) is Annotated:
        return get_args(kind)[0]
    return kind


_REMARKS: dict[Any, str] = {Engine: " (the device gpu runs fused on a GPU)"}


class _Array:
    """Type of arrays, and of what numpy makes arrays of."""

    def __class_getitem__(cls, _: Any) -> type[_Array]:
        return cls


_ARRAY_NAMES = {
    "ArrayLike": _Array,
    "NDArray": _Array,
    "Bytes": _Array,
    "Float": _Array,
    "Float32": _Array,
    "Int": _Array,
    "Mask": _Array,
    "Rows": _Array,
    "Values": _Array,
}
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
    if kind is Any:
        return True
    if kind is _Array:
        return _is_array(value)
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in _UNIONS:
        return any(_fits(value, option) for option in inner)
    if origin is Annotated:
        return _fits(value, inner[0]) and value in kind.__metadata__[0]
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is tuple or origin is Sequence:
        is_listed = isinstance(value, list | tuple)
        if is_listed and origin is Sequence:
            return all(_fits(one, inner[0]) for one in value)
        if origin is Sequence or inner[-1] is Ellipsis:
            return hasattr(value, "__len__") and not isinstance(value, str)
        if not is_listed or len(value) != len(inner):
            return False
        return all(map(_fits, value, inner))
    if origin is Mapping:
        return isinstance(value, Mapping)
    if kind is bool:
        dtype = getattr(value, "dtype", None)
        return isinstance(value, bool) or getattr(dtype, "kind", "") == "b"
    if kind is int:
        return isinstance(value, Integral) and not isinstance(value, bool)
    if kind is float:
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        return is_number and not math.isnan(float(value))
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
    if isinstance(value, np.ndarray) and value.dtype.kind not in "biuf":
        return False
    return bool(value.ndim > 0)
