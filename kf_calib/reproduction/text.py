"""The experiment of the paper as a report and as a JSON object: its Table 2 beside the figures computed here."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.reproduction import grebenkin2019
from kf_calib.reproduction.grebenkin2019 import NONOPTIMAL_PRINTED, OPTIMAL_PRINTED, TOGETHER, Conditions, Experiment
from kf_calib.reproduction.grebenkin2019_conditions import AZIMUTHS_DEG, PERIODS_S, ConditionFit, ConditionSearch
from kf_calib.views.json import members
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import ConsoleTable, table

_ABOUT = {
    "platform": "turns about the platform's axes, the third from the start",
    "platform-after-2": "turns about the platform's axes, the third after the second",
    "bench": "turns about the bench's axes, the third from the start",
    "bench-after-2": "turns about the bench's axes, the third after the second",
}
_WORDS = {1: "one", 2: "two", 3: "three"}


def paper_object(experiment: Experiment, searched: ConditionSearch) -> dict[str, Any]:
    """The JSON object of ``paper``; its table2 is in per cent, with ``optimal`` and ``nonoptimal`` by least squares."""
    sets = {"optimal": experiment.optimal, "nonoptimal": experiment.nonoptimal}
    return {
        "table2": [_row_object(experiment, symbol) for symbol in paper_parameters.SYMBOLS],
        **members(experiment, "repetitions", "seed"),
        "scatter": grebenkin2019.scatter(experiment.repetitions),
        **{
            name: {
                "log_ratio": float(grebenkin2019.log_ratio(column.least_squares, _paper_column(name))),
                "expected_log_ratio": float(grebenkin2019.log_ratio(column.orientations.expected, _paper_column(name))),
                **members(column.orientations, "condition_numbers", "condition_numbers_in_g", "rank"),
                "kalman_difference_sigma": column.difference_sigma,
            }
            for name, column in sets.items()
        },
        "nonoptimal_gravity_fixed": {
            **members(experiment.fixed, "rank", "condition_numbers", "same_vector"),
            "why": rank_sentence(experiment),
        },
        "conditions": {**_conditions_object(experiment.conditions), "inferred": True},
        "optimal_under_conditions": dict(zip(("turned_after", "turned_at_first"), _turning(experiment), strict=True)),
        "search": {
            "tried": searched.tried,
            "together": _found_object(searched.together),
            "in_turn": _found_object(searched.in_turn),
            "least_log_ratio_together": searched.floor,
            "log_ratio_of_scatter_alone": searched.scatter,
            "printed_bias_over_most_possible": searched.bias_excess,
        },
    }


def _paper_column(name: str) -> Floats:
    """Return the column (12,) that the paper prints for a set of orientations, in per cent."""
    return grebenkin2019.printed_column(OPTIMAL_PRINTED if name == "optimal" else NONOPTIMAL_PRINTED)


def _row_object(experiment: Experiment, name: str) -> dict[str, Any]:
    """Return the row of one parameter as a JSON object."""
    k, row = paper_parameters.SYMBOLS.index(name), {"parameter": name}
    for key, column in (("optimal", experiment.optimal), ("nonoptimal", experiment.nonoptimal)):
        row |= {
            key: column.least_squares[k],
            f"{key}_printed": _paper_column(key)[k],
            f"{key}_expected": column.orientations.expected[k],
            f"{key}_kalman": column.kalman[k],
        }
    return row


def _conditions_object(conditions: Conditions) -> dict[str, Any]:
    """Return the conditions of an experiment as a JSON object."""
    return {**vars(conditions), "duration_s": conditions.duration_s}


def _found_object(experiment: ConditionFit) -> dict[str, Any]:
    """Return the nearest conditions of the search with their log-ratio as a JSON object."""
    return {**_conditions_object(experiment.conditions), "log_ratio": experiment.log_ratio}


def _turning(experiment: Experiment) -> tuple[float, float]:
    """Return the log-ratios of the optimal set's expectation to the print if the Earth turns gravity during the run.

    The first is with each orientation set by gravity on arrival, the second by gravity at the start.
    """
    column = _paper_column("optimal")
    figures = [grebenkin2019.optimal(experiment.conditions, each).expected for each in (True, False)]
    return float(grebenkin2019.log_ratio(figures[0], column)), float(grebenkin2019.log_ratio(figures[1], column))


def paper_report(experiment: Experiment, searched: ConditionSearch) -> RenderableType:
    """The report that ``paper`` prints."""
    return Group(table2(experiment), *map(Text, sentences(experiment, searched)))


def table2(experiment: Experiment) -> ConsoleTable:
    """The table of both sets of orientations: print, expectation in closed form, least squares and filter."""
    title = f"Table 2: mean |error| over the deviation to be found, %, {experiment.repetitions} repetitions"
    columns = [f">{name}\npaper" for name in ("optimal set", "non-optimal set")]
    headings = [heading for first in columns for heading in (first, ">\nexpected", ">\nbatch", ">\nfilter")]
    units = dict(zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True))
    names = [name for unit in dict.fromkeys(units.values()) for name in units if units[name] == unit]
    rows = list[list[str]]()
    for name in names:
        at, cells = paper_parameters.SYMBOLS.index(name), [symbol(name)]
        for key, column in (("optimal", experiment.optimal), ("nonoptimal", experiment.nonoptimal)):
            figures = (column.orientations.expected[at], column.least_squares[at], column.kalman[at])
            cells += [f"{_paper_column(key)[at]:.4f}", *(f"{figure:#.4g}" for figure in figures)]
        rows.append(cells)
    return table(title, ("\nparameter", *headings), rows, (5, 8))


def sentences(experiment: Experiment, searched: ConditionSearch) -> list[str]:
    """What the figures show, on which conditions they rest, and which of these were inferred; in sentences."""
    return [
        _scatter(experiment), rank_sentence(experiment), _conditions_sentence(experiment), *_search_sentences(searched),
        _earth(experiment), _conditioning(experiment), _filter(experiment),
    ]  # fmt: skip


def _scatter(experiment: Experiment) -> str:
    """Return a sentence on the scatter of a mean of so many repetitions."""
    column = _paper_column("optimal")
    expected = np.abs(column / experiment.optimal.orientations.expected - 1).max()
    off = np.abs(experiment.optimal.least_squares / column - 1).max()
    return (
        f"Expected is sqrt(2/pi) σ / deviation; a mean of {experiment.repetitions} runs scatters about it by "
        f"{_percent(grebenkin2019.scatter(experiment.repetitions))} (1σ). Optimal set: the print is within "
        f"{_percent(expected)} of the expectation, these runs within {_percent(off)} of the print."
    )


def rank_sentence(experiment: Experiment) -> str:
    """A sentence on why the non-optimal set gives no finite errors as it is printed."""
    rank = int(experiment.fixed.rank.min())
    same = " and ".join(
        f"orientations {one} and {other} share the vertical" for one, other in experiment.fixed.same_vector
    )
    return (
        f"Non-optimal set with gravity fixed: {same}, so there are {_WORDS[rank]} different vectors for four unknowns; "
        f"D has rank {rank}, and the errors would be infinite."
    )


def _conditions_sentence(experiment: Experiment) -> str:
    """Return sentences on the conditions that were inferred from the paper's table."""
    column, hours = _paper_column("nonoptimal"), experiment.conditions.duration_s / 3600
    closed = grebenkin2019.log_ratio(experiment.nonoptimal.orientations.expected, column)
    ran = grebenkin2019.log_ratio(experiment.nonoptimal.least_squares, column)
    return (
        "They are finite where the platform is held in inertial space and the Earth turns gravity in it. Under which "
        f"conditions the paper does not say; INFERRED from its table: {_conditions_in_words(experiment.conditions)} "
        f"({hours:.1f} h in all), latitude {experiment.conditions.latitude_deg:g}°. "
        f"Rms log-ratio to the print: {closed:.2f} expected, {ran:.2f} in these runs."
    )


def _conditions_in_words(conditions: Conditions) -> str:
    """Return the conditions of an experiment in words."""
    order = " ".join(conditions.sampled)
    sampled = "together" if conditions.sampled == TOGETHER else f"one after another ({order}) in each orientation"
    return (
        f"accelerometers read {sampled}, a reading every {conditions.period_s:.3g} s, azimuth "
        f"{conditions.azimuth_deg:g}°, {_ABOUT[conditions.turns]}"
    )


def _search_sentences(searched: ConditionSearch) -> list[str]:
    """Return sentences on the search for conditions that give the paper's figures."""
    together, in_turn, worst = searched.together, searched.in_turn, int(searched.bias_excess.argmax())
    return [
        f"Of {searched.tried} conditions tried ({len(AZIMUTHS_DEG)} azimuths, {len(PERIODS_S)} periods, "
        f"{len(grebenkin2019.TURNS)} readings of the turns, {len(grebenkin2019.SAMPLED)} orders of sampling) the "
        "nearest are "
        f"{together.log_ratio:.3f}: {_conditions_in_words(together.conditions)}; and {in_turn.log_ratio:.3f}: "
        f"{_conditions_in_words(in_turn.conditions)}.",
        f"Read together, nothing can come below {searched.floor:.3f}, because θ1 and θ3, φ1 and ν2, ν1 and φ3 then "
        f"have equal errors. The print's own scatter would leave {searched.scatter:.3f}: neither is shown to be the "
        "paper's, and of so many some come near by chance. "
        f"The print for b{worst + 1} is {searched.bias_excess[worst]:.2f} times what any "
        "directions allow beside the print for that accelerometer's angles and scale factor.",
    ]


def _earth(experiment: Experiment) -> str:
    """Return sentences on the optimal set if the Earth turned during the run."""
    turned, left = _turning(experiment)
    return (
        "The optimal set above has gravity fixed. Were the Earth to turn as inferred, its expectation would be "
        f"{turned:.3f} from the print with each orientation set by gravity as it stands on arrival, {left:.3f} as it "
        "stood at first."
    )


def _conditioning(experiment: Experiment) -> str:
    """Return a sentence on the condition numbers of both sets."""
    parts = [
        f"{name} {orientations.condition_numbers.max():.4g} "
        f"({orientations.condition_numbers_in_g.max():.3g} in units of g)"
        for name, orientations in (
            ("optimal", experiment.optimal.orientations),
            ("non-optimal", experiment.nonoptimal.orientations),
        )
    ]
    return f"Condition number of D, the largest of the three: {', '.join(parts)}; with gravity fixed infinite."


def _filter(experiment: Experiment) -> str:
    """Return a sentence on the difference between filter and least squares."""
    largest = max(experiment.optimal.difference_sigma, experiment.nonoptimal.difference_sigma)
    return (
        f"Filter and least squares differ by at most {largest:.2g} σ in any repetition: D is linear in the deviations, "
        "the filter's model is exact."
    )


def _percent(part: float) -> str:
    """Return a share as text in per cent."""
    return f"{100 * part:.1f} %"
