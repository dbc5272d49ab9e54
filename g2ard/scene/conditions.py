"""Conditions on rows by the names of their columns, the language of `--where`."""

import ast
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from g2ard.arrays import Mask, Values
from g2ard.errors import InputError
from g2ard.scene.attributes import ATTRIBUTES, attribute
from g2ard.scene.splats import Splats

_LONGEST = 1000  # characters of a condition at most, so that it cannot nest too deeply


def fulfilling(splats: Splats, condition: str) -> Mask:
    """Return the (N,) mask of Gaussians that fulfil a condition: `opacity > 0.05 and largest_scale < 2`.

    Names are `ATTRIBUTES`: those of `columns`; `smallest_scale` and `largest_scale` of the three standard
    deviations; and `elongation`, the largest over the middle one. Arithmetic (+, -, *, /, abs, sqrt, min,
    max) and comparisons (<, <=, >, >=, ==, !=, also chained) are supported, joined with and, or and not.
    Anything else is rejected; nothing runs as Python.

    >>> two = Splats.create([[0, 0, 0], [9, 0, 0]], scales=[[1, 1, 1], [1, 2, 3]])
    >>> fulfilling(two, "abs(x) <= 5 and not largest_scale > 2").tolist()
    [True, False]

    Raises:
        InputError: the text is not a condition, or uses an unknown name or operation.
    """
    return holds(condition, ATTRIBUTES, partial(attribute, splats), len(splats))


def holds(
    condition: str,
    names: Sequence[str],
    column: Callable[[str], Values],
    count: int,
) -> Mask:
    """Return the (count,) mask of rows that fulfil a condition, see `fulfilling`.

    Args:
        names: names of the columns.
        column: returns the (count,) column of one of them.

    >>> holds("class_ == 2", ["class_"], lambda _: np.array([1, 2]), 2).tolist()
    [False, True]
    """
    try:
        with np.errstate(all="ignore"):
            found = _evaluate(_parse(condition), dict.fromkeys(names, column))
        if not _is_condition(found):
            raise _invalid(f"{condition!r} is a number; compare it with another")
    except RecursionError as error:
        raise _invalid("nests too deeply").at(hint=_hint(names)) from error
    except InputError as error:
        raise error.at(hint=_hint(names)) from None
    return np.array(np.broadcast_to(found, count))


def names_in(condition: str) -> set[str]:
    """Return the names of columns that a condition uses.

    >>> sorted(names_in("abs(x) < 2 and classification == 2"))
    ['classification', 'x']
    """
    return {node.id for node in ast.walk(_parse(condition)) if isinstance(node, ast.Name)} - {
        *_FUNCTIONS
    }


def check_condition(condition: str) -> None:
    """Raise the `InputError` of `fulfilling` for any scene."""
    fulfilling(Splats.create(np.zeros((1, 3)), scales=np.ones((1, 3))), condition)


_Columns = Mapping[str, Callable[[str], Values]]
"""Name → function that returns the column of this name."""

_ARITHMETIC: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}

_COMPARISONS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_SIGNS: dict[type[ast.AST], Callable[[Any], Any]] = {
    ast.USub: np.negative,
    ast.UAdd: np.positive,
}
_FUNCTIONS: dict[str, Callable[[list[Any]], Any]] = {
    "abs": lambda values: np.abs(*values),
    "sqrt": lambda values: np.sqrt(*values),
    "min": lambda values: reduce(np.minimum, values),
    "max": lambda values: reduce(np.maximum, values),
}


def _parse(text: str) -> ast.expr:
    if len(text) > _LONGEST:
        raise _invalid(f"expected at most {_LONGEST} characters, got {len(text)}")
    try:
        return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        examples = "'opacity > 0.05' or, of points, 'classification == 2'"
        raise _invalid(f"{text!r} is not a condition, such as {examples}") from error


def _evaluate(node: ast.expr, columns: _Columns) -> Any:
    """Return the value of an expression: numbers or booleans, one or one per row."""
    match node:
        case ast.BoolOp(op, operands):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return reduce(join, [_evaluate_condition(one, columns) for one in operands])
        case ast.UnaryOp(ast.Not(), operand):
            return np.logical_not(_evaluate_condition(operand, columns))
        case ast.UnaryOp(op, operand) if type(op) in _SIGNS:
            return _SIGNS[type(op)](_evaluate_number(operand, columns))
        case ast.BinOp(left, op, right) if type(op) in _ARITHMETIC:
            return _ARITHMETIC[type(op)](
                _evaluate_number(left, columns), _evaluate_number(right, columns)
            )
        case ast.Compare(left, ops, others) if all(type(op) in _COMPARISONS for op in ops):
            values = [_evaluate_number(one, columns) for one in (left, *others)]
            holding = []
            for compare, a, b in zip(ops, values, values[1:], strict=False):
                holding.append(_COMPARISONS[type(compare)](a, b))
            return reduce(np.logical_and, holding)
        case ast.Call(ast.Name(name), arguments, []) if name in _FUNCTIONS:
            takes_one = name in ("abs", "sqrt")
            if not arguments or (len(arguments) == 1) != takes_one:
                raise _invalid(f"{name} takes {'one number' if takes_one else 'several numbers'}")
            return _FUNCTIONS[name]([_evaluate_number(one, columns) for one in arguments])
        case ast.Constant(bool()):
            pass
        case ast.Constant(int() | float() as value) if abs(value) < 1e300:
            return np.float64(value)
        case ast.Name(name) if name in columns:
            return columns[name](name)
        case ast.Name(name):
            raise _invalid(f"unknown name {name!r}")
    raise _invalid(f"{ast.unparse(node)!r} is not supported")


def _is_condition(value: Any) -> bool:
    return bool(np.asarray(value).dtype == bool)


def _evaluate_condition(node: ast.expr, columns: _Columns) -> Any:
    value = _evaluate(node, columns)
    if not _is_condition(value):
        raise _invalid(f"{ast.unparse(node)!r} is a number; and, or and not take comparisons")
    return value


def _evaluate_number(node: ast.expr, columns: _Columns) -> Any:
    value = _evaluate(node, columns)
    if _is_condition(value):
        raise _invalid(f"{ast.unparse(node)!r} is a comparison where a number is expected")
    return value


def _invalid(text: str) -> InputError:
    return InputError(text, parameter="where")


def _hint(names: Sequence[str]) -> str:
    return f"names are {', '.join(names)}"
