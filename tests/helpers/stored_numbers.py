"""Numbers that are stored in ``tests/golden/numbers``: written by ``tools/golden_numbers.py``, compared by the tests.

A case is a tree of mappings and lists with numbers, names and sentences. A number is alike within 1e-5 of itself, a
value beside a ``sigma`` within 1e-4 of that, too; ``figures`` of a result, sums over many numbers, within 1e-5 for each
of their terms, as if these had independent errors. Names, lengths and whole numbers have to be the same, and sentences
but for the numbers in them. ``LOOSE`` has the cases in which numbers may differ by more.
"""

import json
import math
import re
import tempfile
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from helpers.paths import ROOT

FOLDER = ROOT / "tests" / "golden" / "numbers"
RENEW = "python tools/golden_numbers.py"
_RELATIVE, _OF_SIGMA = 1e-5, 1e-4
_ZERO = 1e-12
UNTOLD = 1e-3
"""Probability below which no verdict tells an explanation: the order of such is one of rounding."""
_DIGITS = 10
_NAME = re.compile(r"[A-Za-z][\w:=^*().+-]{0,40}( [\w:=^*().+-]+){0,2}")
_NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?")
_FILE = re.compile(f"({re.escape(str(ROOT))}|{re.escape(tempfile.gettempdir())})[^\\s:,;'\"]*")
_SHOWN, _WIDTH = 10, 60
LOOSE: Mapping[str, float] = {"position_feedback": 30.0, "mems": 100.0, "without_angles": 1000.0, "plans": 1000.0}
"""By what factor more numbers of a case may differ. A setting error or scatter that is estimated is where a search for
the largest likelihood ends, to 3e-5 of itself; a fit without angles ends where its steps are below a thousandth of
a sigma; a plan is the best that a search meets. Of these, 1e-5 is not reached on another processor (measured: 1e-4,
2e-3, 1e-3)."""
_LOOSE_NAMES: Mapping[str, float] = {
    "log10_odds_to_next": 1e3, "minimum": 10.0, "Fit.scatter_gain": 1e3, "EffectRow.no_one": 1e3,
    "HypothesisTable.log10_odds": 10.0, "FoldedDwells.spreads": 10.0, "EffectTests.independent_tests": 100.0,
    "EffectTests.p_values": 100.0,
}  # fmt: skip
"""The same for numbers that are small differences of large ones, or so large that nothing was determined."""


@dataclass(frozen=True)
class Difference:
    """A place in a case, what is stored there and what there is now."""

    path: str
    stored: Any
    new: Any

    def __str__(self) -> str:
        both = isinstance(self.stored, float | int) and isinstance(self.new, float | int)
        stored, new = (textwrap.shorten(str(each), _WIDTH) for each in (self.stored, self.new))
        return f"{self.path}: stored {stored}, now {new}" + (f", by {self.new - self.stored:.3g}" if both else "")


def plain(tree: Any) -> Any:
    """A tree as it is stored: numbers with ten digits, sentences without their numbers and the names of files."""
    match tree:
        case Mapping():
            return {str(key): plain(part) for key, part in tree.items()}
        case bool() | None:
            return tree
        case str():
            return tree if _NAME.fullmatch(tree) else _NUMBER.sub("0", _FILE.sub("FILE", tree))
        case float():
            return float(f"{tree:.{_DIGITS}g}") if math.isfinite(tree) else str(tree)
        case Sequence():
            return [plain(part) for part in tree if not _is_untold(part)]
        case _ if hasattr(tree, "tolist"):
            return plain(tree.tolist())
    return tree


def _is_untold(part: Any) -> bool:
    """Whether it is an explanation so unlikely that no verdict tells it: the order of such is one of rounding."""
    return isinstance(part, Mapping) and "log10_odds_to_next" in part and part.get("probability", 1.0) < UNTOLD


def read(name: str) -> Any:
    """The stored numbers of a case; None where it has none yet."""
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def write(name: str, tree: Any) -> None:
    """Store the numbers of a case, a line for each of its parts."""
    lines = (f"{json.dumps(key)}:{json.dumps(part, separators=(',', ':'))}" for key, part in _lines(tree))
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _lines(tree: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    yield from tree.items()


def changed(name: str, tree: Any) -> list[Difference]:
    """What differs in a case from what is stored of it."""
    return list(differences(read(name), tree, loose=LOOSE.get(name, 1.0)))


def differences(stored: Any, new: Any, path: str = "", loose: float = 1.0) -> Iterator[Difference]:
    """Where two trees differ by more than they may; loose: factor of what numbers may differ by."""
    match stored, new:
        case (Mapping(), Mapping()):
            for key in {**stored, **new}:
                yield from _of_key(stored, new, str(key), path, loose)
        case (list(), list()) if len(stored) == len(new):
            if "/figures/" in path:
                yield from _of_figures(stored, new, path, loose)
                return
            for k, (one, other) in enumerate(zip(stored, new, strict=True)):
                yield from differences(one, other, f"{path}/{k}", loose)
        case _ if not _alike(stored, new, _RELATIVE * loose, 0.0):
            yield Difference(path, stored, new)


def _of_key(
    stored: Mapping[str, Any], new: Mapping[str, Any], key: str, path: str, loose: float
) -> Iterator[Difference]:
    one, other, sigma = stored.get(key), new.get(key), stored.get("sigma")
    if (
        key == "value"
        and isinstance(sigma, float)
        and _alike(one, other, 0.0, _OF_SIGMA * max(loose / 10.0, 1.0) * sigma)
    ):
        return
    yield from differences(one, other, f"{path}/{key}", loose * _LOOSE_NAMES.get(key, 1.0))


def _of_figures(stored: list[float], new: list[float], path: str, loose: float) -> Iterator[Difference]:
    """Count, then two sums of so many terms, or fewer: their errors of rounding are independent."""
    if stored[0] != new[0]:
        yield Difference(f"{path} (numbers)", stored[0], new[0])
    for k, what in ((1, "sizes"), (2, "shapes")):
        if not _alike(stored[k], new[k], _RELATIVE * loose, _RELATIVE * loose * math.sqrt(stored[0])):
            yield Difference(f"{path} ({what})", stored[k], new[k])


def _alike(one: Any, other: Any, relative: float, absolute: float) -> bool:
    if isinstance(one, float) and isinstance(other, float | int) and not isinstance(other, bool):
        return math.isclose(one, other, rel_tol=relative, abs_tol=max(absolute, _ZERO if relative else 0.0))
    return one == other and type(one) is type(other)


def told(found: Sequence[Difference]) -> str:
    """The first differences as text, and how to renew what is stored."""
    more = f"\n... {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    shown = "\n".join(map(str, found[:_SHOWN]))
    return f"{len(found)} numbers changed:\n{shown}{more}\nWhere this is what was meant: {RENEW}"
