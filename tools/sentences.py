#!/usr/bin/env python
"""All sentences that the program can say of a run, as one page: this renews tests/golden/sentences.md.

They are read from the source: every text of four words or more, in the order of the files; what a value is put in for
stands in braces. Left out are docstrings, what an input is refused with, and the words of commands and their help.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "tests" / "golden" / "sentences.md"
_WORDS = 4
_OF_RUNS = ("design", "diagnosis", "estimation", "fleet", "noise", "online", "dwells", "views", "report")
_LEAVES, _SAYING = ("certificate", "exports", "positioning", "reproduction"), ("text.py", "figures.py", "section.py")
_HEAD = """# All that the program can say of a run

Made by `tools/sentences.py` from the source; `tests/test_sentences.py` compares. Read it once in a while: each sentence
has to be understood the first time. What a value is put in for stands in braces.
"""


def page() -> str:
    """The page as it follows from the source."""
    parts = [_HEAD]
    rooms = [*((room, "*.py") for room in _OF_RUNS), *((room, name) for room in _LEAVES for name in _SAYING)]
    for path in (path for room, name in rooms for path in sorted((ROOT / "kf_calib" / room).rglob(name))):
        name = path.relative_to(ROOT / "kf_calib").as_posix()
        if path.name != "command.py" and (said := list(dict.fromkeys(sentences(path.read_text())))):
            parts.append(f"## {name}\n\n" + "\n".join(f"- {each}" for each in said) + "\n")
    return "\n".join(parts)


def sentences(source: str) -> Iterator[str]:
    """The sentences in the source of a module, in its order."""
    tree = ast.parse(source)
    bare = (node.value for node in ast.walk(tree) if isinstance(node, ast.Expr))
    docstrings = {id(value) for value in bare if isinstance(value, ast.Constant)}
    found = [(node.lineno, node.col_offset, text) for node, text in _texts(tree, docstrings)]
    for _, _, text in sorted(found):
        words = re.findall(r"[A-Za-zµσ]{2,}", re.sub(r"\{[^}]*\}", "", text))
        if len(words) >= _WORDS and " " in text.strip() and not re.search(r"\\[bd]|</?[a-z]|#\{", text):
            yield " ".join(text.split())


def _texts(node: ast.AST, left_out: set[int]) -> Iterator[tuple[ast.expr, str]]:
    """Every text below a node, an f-string as a whole."""
    if id(node) in left_out or isinstance(node, ast.Raise) or (isinstance(node, ast.Call) and _is_help(node)):
        return
    if isinstance(node, ast.JoinedStr):
        yield node, "".join(_part(each) for each in node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node, node.value
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.JoinedStr) and isinstance(child, ast.Constant)):
            yield from _texts(child, left_out)


def _is_help(node: ast.Call) -> bool:
    """Tell whether a call makes an option, an argument or a warning of the command line, or raises what it makes."""
    name = ast.unparse(node.func)
    return name.rpartition(".")[2] in ("option", "output_option", "argument", "examples", "InputError", "UsageError")


def _part(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    return f"{{{ast.unparse(node.value)}}}" if isinstance(node, ast.FormattedValue) else ast.unparse(node)


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page())
    sys.stdout.write(f"{PAGE.relative_to(ROOT)}\n")
