"""Two evaluations side by side as a table, in words, and as a JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from kf_calib.diagnosis.side_by_side import Difference, SideBySide
from kf_calib.estimation.results import Parameter, format_p
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import ConsoleTable


def verdict(pair: SideBySide) -> str:
    """In a sentence, by how much the parameters differ."""
    far = pair.farthest
    if far is None:
        return "The two have no parameter in common that both determine."
    most = f"{symbol(far.symbol)} differs most, by {abs(far.sigmas or 0.0):.1f} σ"
    if pair.p_value is None:
        return f"Between the two models, {most}."
    word = "agree" if pair.p_value >= LEVEL else "DIFFER"
    chance = f"noise alone gives differences as large with probability p {format_p(pair.p_value)}"
    return f"The parameters of the two recordings {word}: {chance}; {most}."


def difference_table(differences: Sequence[Difference], first: str, second: str) -> ConsoleTable:
    """The table of the parameters in both, less nominal, and of their differences; first, second: what they are of."""
    table = ConsoleTable(title="Parameters less nominal (1σ)", title_justify="left")
    for heading in ("parameter", first, "sigma", second, "sigma", "unit", "difference", "in σ"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for k, each in enumerate(differences):
        table.add_row(*_row(each), end_section=k % 4 == 3)
    return table


def _row(difference: Difference) -> tuple[str, ...]:
    """Return the row of one parameter."""
    both, moved = (*_cells(difference.first), *_cells(difference.second)), ("", "")
    if difference.value is not None and difference.sigma is not None and difference.sigmas is not None:
        moved = shown(difference.first).rounded(difference.value, difference.sigma)[0], f"{difference.sigmas:+.1f}"
    return symbol(difference.symbol), *both, shown(difference.first).label, *moved


def _cells(parameter: Parameter) -> tuple[str, str]:
    """Return a parameter less its nominal value, and its sigma."""
    if parameter.value is None or parameter.sigma is None:
        return "not seen", ""
    value, sigma = shown(parameter).rounded(parameter.value - parameter.nominal, parameter.sigma)
    return value, f"± {sigma}"


def side_by_side_object(pair: SideBySide) -> dict[str, Any]:
    """What ``report --json`` adds for a second evaluation: that one, and the differences from it in SI units."""
    return clean(
        {
            "against": {
                "consistent": pair.first.test.consistent,
                "p_value": pair.first.test.p_value,
                "verdict": pair.first.verdict,
            },
            "differences": [
                {
                    "symbol": difference.symbol,
                    "first": difference.first.value,
                    "second": difference.second.value,
                    "sigmas": difference.sigmas,
                    "unit": difference.first.unit,
                }
                for difference in pair.differences
            ],
            "differences_p_value": pair.p_value,
        }
    )
