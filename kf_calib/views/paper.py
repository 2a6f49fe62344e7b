"""The paper's experiment for people and for programs: Table 2 beside its own figures, and what they rest on."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from kf_calib import experiment, paper
from kf_calib.experiment import NONOPTIMAL_PRINTED, OPTIMAL_PRINTED, TOGETHER, Column, Conditions, Experiment
from kf_calib.inferred import AZIMUTHS_DEG, PERIODS_S, Found, Search
from kf_calib.samples import Floats
from kf_calib.views.console import symbol
from kf_calib.views.json import clean

_ABOUT = {
    "platform": "turns about the platform's axes, 3 from the first orientation",
    "platform-after-2": "turns about the platform's axes, 3 after 2",
    "bench": "turns about the bench's axes, 3 from the first orientation",
    "bench-after-2": "turns about the bench's axes, 3 after 2",
}
_WORDS = {2: "two", 3: "three"}


def paper_object(found: Experiment, searched: Search) -> dict[str, Any]:
    """What ``paper --json`` prints; figures of table2 are per cent, ``optimal`` and ``nonoptimal`` by least squares."""
    sets = {"optimal": found.optimal, "nonoptimal": found.nonoptimal}
    return clean(
        {
            "table2": [_row_object(found, symbol) for symbol in paper.SYMBOLS],
            "repetitions": found.repetitions,
            "seed": found.seed,
            "scatter": experiment.scatter(found.repetitions),
            **{
                name: {
                    "log_ratio": float(experiment.log_ratio(column.least_squares, _printed(name))),
                    "expected_log_ratio": float(experiment.log_ratio(column.orientations.expected, _printed(name))),
                    "condition_numbers": column.orientations.condition_numbers,
                    "condition_numbers_in_g": column.orientations.condition_numbers_in_g,
                    "rank": column.orientations.rank,
                    "kalman_difference_sigma": column.difference_sigma,
                }
                for name, column in sets.items()
            },
            "nonoptimal_gravity_fixed": {
                "rank": found.fixed.rank,
                "condition_numbers": found.fixed.condition_numbers,
                "same_vector": found.fixed.same_vector,
                "why": rank_sentence(found),
            },
            "conditions": {**_conditions_object(found.conditions), "inferred": True},
            "optimal_under_conditions": dict(zip(("turned_after", "turned_at_first"), _turning(found), strict=True)),
            "search": {
                "tried": searched.tried,
                "together": _found_object(searched.together),
                "in_turn": _found_object(searched.in_turn),
                "least_log_ratio_together": searched.floor,
                "log_ratio_of_scatter_alone": searched.scatter,
                "printed_bias_over_most_possible": searched.bias_excess,
            },
        }
    )


def _printed(name: str) -> Floats:
    return experiment.printed(OPTIMAL_PRINTED if name == "optimal" else NONOPTIMAL_PRINTED)


def _row_object(found: Experiment, name: str) -> dict[str, Any]:
    k, row = paper.SYMBOLS.index(name), {"parameter": name}
    for key, column in (("optimal", found.optimal), ("nonoptimal", found.nonoptimal)):
        row |= {
            key: column.least_squares[k],
            f"{key}_printed": _printed(key)[k],
            f"{key}_expected": column.orientations.expected[k],
            f"{key}_kalman": column.kalman[k],
        }
    return row


def _conditions_object(conditions: Conditions) -> dict[str, Any]:
    return {**vars(conditions), "duration_s": conditions.duration_s}


def _found_object(found: Found) -> dict[str, Any]:
    return {**_conditions_object(found.conditions), "log_ratio": found.log_ratio}


def _turning(found: Experiment) -> tuple[float, float]:
    """Log-ratio of the optimal set's expectation to the print while the Earth turns: turned after gravity, or not."""
    column = _printed("optimal")
    figures = [experiment.optimal(found.conditions, each).expected for each in (True, False)]
    return float(experiment.log_ratio(figures[0], column)), float(experiment.log_ratio(figures[1], column))


def paper_report(found: Experiment, searched: Search) -> RenderableType:
    """What ``paper`` prints."""
    return Group(table2(found), *map(Text, sentences(found, searched)))


def table2(found: Experiment) -> Table:
    """Both sets: the print, the closed form, least squares and the filter."""
    title = f"Table 2: mean |error| over the deviation to be found, %, {found.repetitions} repetitions"
    table = Table(title=title, title_justify="left")
    table.add_column("\nparameter")
    for name in ("optimal set", "non-optimal set"):
        for k, heading in enumerate(("paper", "expected", "batch", "filter")):
            table.add_column(f"{name if k == 0 else ''}\n{heading}", justify="right")
    for k, name in enumerate(_order()):
        cells = [_cells(column, _printed(key), name)
                 for key, column in (("optimal", found.optimal), ("nonoptimal", found.nonoptimal))]  # fmt: skip
        table.add_row(symbol(name), *cells[0], *cells[1], end_section=k in (5, 8))
    return table


def markdown(found: Experiment, searched: Search) -> str:
    """The same in one page for the Rerun view."""
    head = "| % | optimal: paper | expected | batch | non-optimal: paper | expected | batch |\n|:--|--:|--:|--:|--:|--:|--:|\n"
    rows = [
        f"| {symbol(name)} | " + " | ".join(_cells(found.optimal, _printed("optimal"), name)[:3]
        + _cells(found.nonoptimal, _printed("nonoptimal"), name)[:3]) + " |"
        for name in _order()
    ]  # fmt: skip
    return head + "\n".join(rows) + "\n\n" + "\n\n".join(sentences(found, searched)) + "\n"


def _order() -> list[str]:
    """The rows of the paper: angles, scale factors, biases."""
    return [name for unit in dict.fromkeys(paper.UNITS) for name in _of_unit(unit)]


def _of_unit(unit: str) -> list[str]:
    return [name for name, own in zip(paper.SYMBOLS, paper.UNITS, strict=True) if own == unit]


def _cells(column: Column, printed: Floats, name: str) -> list[str]:
    k = paper.SYMBOLS.index(name)
    figures = (column.orientations.expected[k], column.least_squares[k], column.kalman[k])
    return [f"{printed[k]:.4f}", *(f"{figure:#.4g}" for figure in figures)]


def sentences(found: Experiment, searched: Search) -> list[str]:
    """What the figures say, what they rest on, and what is inferred."""
    return [_scatter(found), rank_sentence(found), _inferred(found), *_searched(searched), _earth(found),
            _conditioning(found), _filter(found)]  # fmt: skip


def _scatter(found: Experiment) -> str:
    ours, print_ = experiment.scatter(found.repetitions), experiment.scatter(experiment.REPETITIONS)
    off = np.abs(found.optimal.least_squares / _printed("optimal") - 1).max()
    expected = np.abs(_printed("optimal") / found.optimal.orientations.expected - 1).max()
    return (
        f"A mean of {found.repetitions} repetitions scatters by {_percent(ours)} (1σ), the print by {_percent(print_)}. "
        f"Optimal set: the print is at most {_percent(expected)} from the expectation, these runs at most "
        f"{_percent(off)} from the print. Expected: sqrt(2/pi) σ / |deviation|."
    )


def rank_sentence(found: Experiment) -> str:
    """Why the non-optimal set gives no finite errors as it is printed."""
    rank = int(found.fixed.rank.min())
    same = " and ".join(f"orientations {one} and {other} share the vertical" for one, other in found.fixed.same_vector)
    return (
        f"Non-optimal set with gravity fixed: {same}, so the accelerometers see {_WORDS[rank]} different vectors for four "
        f"unknowns, D has rank {rank} of 4, and the errors are infinite: as printed, the figures are not possible."
    )


def _inferred(found: Experiment) -> str:
    column, own = _printed("nonoptimal"), found.conditions
    closed, ran = (experiment.log_ratio(each, column) for each in
                   (found.nonoptimal.orientations.expected, found.nonoptimal.least_squares))  # fmt: skip
    return (
        "They are finite where the platform is held in inertial space and the Earth turns gravity in it. INFERRED, not "
        f"printed: {_described(own)}, {own.duration_s / 3600:.1f} h in all. "
        f"Rms log-ratio to the print: {closed:.2f} expected, {ran:.2f} in these runs."
    )


def _described(conditions: Conditions) -> str:
    sampled = "the accelerometers read together" if conditions.sampled == TOGETHER else (
        f"the accelerometers read one after another in the order {' '.join(conditions.sampled)}"
    )  # fmt: skip
    return (
        f"a sampling period of {conditions.period_s:.3g} s, latitude {conditions.latitude_deg:g}°, azimuth "
        f"{conditions.azimuth_deg:g}°, {_ABOUT[conditions.turns]}, {sampled}"
    )


def _searched(searched: Search) -> list[str]:
    together, in_turn, worst = searched.together, searched.in_turn, int(searched.bias_excess.argmax())
    return [
        f"Searched: {searched.tried} conditions ({len(AZIMUTHS_DEG)} azimuths, {len(PERIODS_S)} periods, "
        f"{len(experiment.TURNS)} readings of the turns, {len(experiment.SAMPLED)} orders of sampling). Nearest with "
        f"the accelerometers read together: {together.log_ratio:.3f}, {_described(together.conditions)}; no condition "
        f"at all can come below {searched.floor:.3f} while all three see the same vectors. Nearest one after another: "
        f"{in_turn.log_ratio:.3f}, {_described(in_turn.conditions)}.",
        f"True conditions would leave about {searched.scatter:.3f}, so none of these are: of so many, some come near "
        f"by chance. The print of accelerometer {worst + 1} is itself {searched.bias_excess[worst]:.2f} times what any "
        "directions allow for the error of its bias beside those of its angles and scale factor.",
    ]


def _earth(found: Experiment) -> str:
    turned, left = _turning(found)
    return (
        "The optimal set above has gravity fixed. With the Earth turning as inferred, its expectation is "
        f"{turned:.3f} from the print where each orientation is pointed at gravity as it stands on arrival, {left:.3f} "
        "where as it stood at first."
    )


def _conditioning(found: Experiment) -> str:
    parts = [
        f"{name} {', '.join(f'{value:.4g}' for value in each.condition_numbers)} "
        f"({each.condition_numbers_in_g.max():.3g} in units of g)"
        for name, each in (("optimal", found.optimal.orientations), ("non-optimal", found.nonoptimal.orientations))
    ]
    return f"Condition numbers of D for accelerometers 1, 2, 3: {'; '.join(parts)}; with gravity fixed infinite."


def _filter(found: Experiment) -> str:
    largest = max(found.optimal.difference_sigma, found.nonoptimal.difference_sigma)
    return (
        f"The filter and least squares differ by at most {largest:.2g} σ in any repetition: the paper's D is linear in "
        "the deviations, the filter's model is exact."
    )


def _percent(part: float) -> str:
    return f"{100 * part:.1f} %"
