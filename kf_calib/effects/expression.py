"""Expressions a user types: read as Python's grammar has them, refused unless harmless, evaluated by simpleeval.

Allowed are names, numbers, ``+ - * / **``, one comparison at a time (1 where it holds, else 0) and the functions
below. Text is bounded in length and nesting; constants are floats, so that ``9**9**9`` overflows instead of growing.
"""

from __future__ import annotations

import ast
import difflib
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from kf_calib.errors import InputError

LENGTH_LIMIT = 300
_DEPTH_LIMIT = 30  # simpleeval takes three frames of Python's stack a level
_SIGNS: dict[type[ast.AST], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**", ast.USub: "neg", ast.UAdd: "pos",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
}  # fmt: skip
OPERATORS: dict[str, Callable[..., Any]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.true_divide, "**": np.power,
    "neg": np.negative, "pos": np.positive,
    "<": lambda a, b: np.less(a, b) * 1.0, "<=": lambda a, b: np.less_equal(a, b) * 1.0,
    ">": lambda a, b: np.greater(a, b) * 1.0, ">=": lambda a, b: np.greater_equal(a, b) * 1.0,
}  # fmt: skip
FUNCTIONS: dict[str, np.ufunc] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "arctan": np.arctan, "tanh": np.tanh, "exp": np.exp, "log": np.log,
    "sqrt": np.sqrt, "abs": np.abs, "sign": np.sign, "minimum": np.minimum, "maximum": np.maximum,
}  # fmt: skip
_ALLOWED = (ast.BinOp, ast.UnaryOp, ast.Compare, ast.Call, ast.Name, ast.Constant, ast.Load, *_SIGNS)


class Expression:
    """An expression that was looked at and found harmless; names: the quantities in it, in the order they appear.

    Raises InputError where the text is no such expression. ``meanings``: the names it may use, and what they are.
    """

    def __init__(self, text: str, meanings: Mapping[str, str]) -> None:
        self.text = text.strip()
        self._tree = _parse(self.text)
        self.names = tuple(dict.fromkeys(_look(self._tree, meanings)))

    def __call__(
        self,
        names: Mapping[str, Any],
        operators: Mapping[str, Callable[..., Any]] = OPERATORS,
        functions: Mapping[str, Callable[..., Any]] = FUNCTIONS,
    ) -> Any:
        """Its value for these values of its names; other operators and functions evaluate it in another algebra."""
        from simpleeval import SimpleEval

        # own operators: simpleeval's refuse arrays that are longer than a string may be, and powers of them
        signs = {kind: operators[sign] for kind, sign in _SIGNS.items()}
        run = SimpleEval(operators=signs, functions=dict(functions), names=dict(names))
        with np.errstate(all="ignore"):
            return run.eval(self.text, self._tree)


def _parse(text: str) -> ast.expr:
    if not text:
        raise InputError("there is no formula after the equals sign: write NAME = FORMULA, for example mine = a*T.")
    if len(text) > LENGTH_LIMIT:
        raise InputError(f"a formula of {len(text)} characters is too long: at most {LENGTH_LIMIT} are read.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "3if" is a SyntaxWarning, and no concern of the user's
            tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        place = getattr(error, "offset", None)
        where = f" at character {place}" if place else ""
        said = getattr(error, "msg", None) or "too deeply nested"
        raise InputError(
            f"{text!r} is not a formula ({said}{where}): write it as in Python, for example a*T."
        ) from None
    return tree


def _look(tree: ast.expr, meanings: Mapping[str, str]) -> Iterable[str]:
    """The names of a tree of nothing but what is allowed; its constants become floats."""
    waiting: list[tuple[ast.AST, int]] = [(tree, 1)]
    while waiting:
        node, depth = waiting.pop()
        if depth > _DEPTH_LIMIT:
            raise InputError(f"the formula is nested more than {_DEPTH_LIMIT} deep: write it with fewer parentheses.")
        if not isinstance(node, _ALLOWED):
            raise InputError(
                f"{_words(node)} cannot be in a formula: use names, numbers, + - * / ** and {_functions()}."
            )
        below = list(ast.iter_child_nodes(node))
        if isinstance(node, ast.Constant):
            node.value = _number(node.value)
        elif isinstance(node, ast.Name):
            yield _symbol_of(node.id, meanings)
        elif isinstance(node, ast.Compare) and len(node.ops) > 1:
            raise InputError(f"{_words(node)} compares more than two values: multiply two comparisons instead.")
        elif isinstance(node, ast.Call):
            below = _arguments(node)
        waiting += [(child, depth + 1) for child in reversed(below)]


def _words(node: ast.AST) -> str:
    try:
        text = ast.unparse(node)
    except (ValueError, AttributeError, RecursionError):  # an operator has no text of its own
        text = ""
    return " ".join(text.split())[:40] or f"the operator {type(node).__name__}"


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{str(value)[:40]!r} is not a real number: a formula holds names, numbers and functions.")
    try:
        return float(value)
    except OverflowError:
        raise InputError("a number in the formula is too large: write it as 1e30, up to 1e308.") from None


def _symbol_of(name: str, meanings: Mapping[str, str]) -> str:
    if name in meanings:
        return name
    if name in FUNCTIONS:
        raise InputError(f"{name} is a function: write what it is taken of in parentheses after it.")
    word = name.lower()
    near = [known for known in meanings if known.lower() == word]
    near += [known for known, meaning in meanings.items() if len(word) > 3 and word in meaning]
    near += difflib.get_close_matches(name, meanings, n=3, cutoff=0.6)
    hint = f"did you mean {' or '.join(dict.fromkeys(near[:3]))}? " if near else ""
    raise InputError(f"no quantity is called {name[:40]}: {hint}Known are {' '.join(meanings)}.")


def _arguments(call: ast.Call) -> list[ast.AST]:
    name = call.func.id if isinstance(call.func, ast.Name) else ""
    if name not in FUNCTIONS:
        raise InputError(f"{_words(call.func)} is not a function of formulas: use {_functions()}.")
    if call.keywords or len(call.args) != FUNCTIONS[name].nin:
        raise InputError(f"{name} takes {FUNCTIONS[name].nin} value{'s' * (FUNCTIONS[name].nin > 1)} in parentheses.")
    return list[ast.AST](call.args)


def _functions() -> str:
    return " ".join(FUNCTIONS)
