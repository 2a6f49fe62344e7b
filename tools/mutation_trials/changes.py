"""The single changes that are possible in a module: of an operator, a comparison, a constant, a negation."""

from __future__ import annotations

import ast
from dataclasses import dataclass

_OPERATORS: dict[type[ast.AST], tuple[str, ...]] = {
    ast.Add: ("-",), ast.Sub: ("+",), ast.Mult: ("/",), ast.Div: ("*",), ast.FloorDiv: ("/",), ast.Mod: ("//",),
    ast.Pow: ("*",), ast.MatMult: (), ast.BitAnd: ("|",), ast.BitOr: ("&",), ast.LShift: (">>",), ast.RShift: ("<<",),
    ast.Lt: ("<=", ">"), ast.LtE: ("<", ">"), ast.Gt: (">=", "<"), ast.GtE: (">", "<"), ast.Eq: ("!=",),
    ast.NotEq: ("==",), ast.Is: ("is not",), ast.IsNot: ("is",), ast.In: ("not in",), ast.NotIn: ("in",),
    ast.And: ("or",), ast.Or: ("and",),
}  # fmt: skip
_LEAST = 1e-100  # what is smaller keeps a division from zero, and may be anything


@dataclass(frozen=True, order=True)
class Change:
    """One change of a module's source: the bytes from start to end give way to ``text``."""

    line: int
    start: int
    end: int
    was: str
    text: str

    def __str__(self) -> str:
        return f"{self.was} -> {self.text}"

    def of(self, source: str) -> str:
        """The source with the change."""
        content = source.encode()
        return (content[: self.start] + self.text.encode() + content[self.end :]).decode()


def changes_in(source: str) -> list[Change]:
    """All changes of a module, in their order; texts, annotations and what is raised stay as they are."""
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    return sorted(finder.found)


def is_program(source: str) -> bool:
    """Whether it can be compiled: a few changes leave nothing that can."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def function_at(source: str, change: Change) -> str:
    """The function or method, as ``Class.method``, in whose body a change is; empty: outside of functions."""
    return _function_of(ast.parse(source).body, change.line, "")


def _function_of(body: list[ast.stmt], line: int, prefix: str) -> str:
    for node in body:
        if isinstance(node, ast.ClassDef) and node.lineno <= line <= (node.end_lineno or 0):
            return _function_of(node.body, line, f"{prefix}{node.name}.")
        if isinstance(node, ast.FunctionDef) and node.body[0].lineno <= line <= (node.end_lineno or 0):
            return f"{prefix}{node.name}"
    return ""


class _Finder(ast.NodeVisitor):
    def __init__(self, source: str) -> None:
        self.found = list[Change]()
        self._content = source.encode()
        self._begins = [0]
        for line in self._content.split(b"\n"):
            self._begins.append(self._begins[-1] + len(line) + 1)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._between(node.left, node.right, node.op)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._between(node.target, node.value, node.op)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self._between(left, right, node.op)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, right, operator in zip([node.left, *node.comparators], node.comparators, node.ops, strict=False):
            self._between(left, right, operator)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not):
            start, end = self._place(node)[0], self._place(node.operand)[0]
            self._add(start, end, "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        match node.value:
            case bool():
                texts = [str(not node.value)]
            case int():
                texts = [str(node.value + 1), *([str(node.value - 1)] if node.value > 1 else [])]
            case float() if node.value == 0.0:
                texts = ["1.0"]
            case float() if node.value > _LEAST:
                texts = [repr(2.0 * node.value), repr(0.5 * node.value)]
            case _:
                texts = []
        for text in texts:
            self._add(*self._place(node), text)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        """Its annotation is left alone."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)

    def visit_FormattedValue(self, node: ast.FormattedValue) -> None:
        """What is said is left alone."""

    def visit_Raise(self, node: ast.Raise) -> None:
        """So is what is raised."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """And what is true anyway."""

    def _place(self, node: ast.expr) -> tuple[int, int]:
        end_line, end_column = node.end_lineno or node.lineno, node.end_col_offset or 0
        return self._begins[node.lineno - 1] + node.col_offset, self._begins[end_line - 1] + end_column

    def _between(self, left: ast.expr, right: ast.expr, operator: ast.AST) -> None:
        """The operator stands alone between its operands, but for brackets and white space."""
        gap = self._place(left)[1]
        middle = self._content[gap : self._place(right)[0]].decode()
        word = middle.strip(" \n\\()")
        if isinstance(operator, ast.operator):
            word = word.removesuffix("=")  # of an assignment with an operator
        if word and "#" not in middle:
            start = gap + len(middle[: middle.index(word)].encode())
            for text in _OPERATORS.get(type(operator), ()):
                self._add(start, start + len(word.encode()), text)

    def _add(self, start: int, end: int, text: str) -> None:
        was = self._content[start:end].decode()
        line = self._content[:start].count(b"\n") + 1
        self.found.append(Change(line, start, end, was.strip(), text))
