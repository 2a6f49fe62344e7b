"""The parts of a calibration file, each a pydantic model: keys with types and limits; and whether the parts agree.

Most of what a file says follows from its state, the covariance of that, and the bench. It stands there in words of its
own for people and other programs, who may read one place or the other: what is written twice must be the same, and
where both differ, the file is refused: each ``refuse_...`` raises ValueError, which says what contradicts what.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT, STATES
from kf_calib.estimation.measurement_model import FRAME, SQUARE, Model
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.text import CONTROLS, LONGEST, cut, parse_date

Text = Annotated[str, StringConstraints(max_length=LONGEST, pattern=rf"^[^{CONTROLS}]*$")]
FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Three = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=-1e11, le=1e11, allow_inf_nan=False)]  # some thousand years
Warmth = Annotated[float, Field(ge=-273.15, le=1e4, allow_inf_nan=False)]
MOST_STATES, MOST_EFFECTS = 500, 100
"""Far more than a model can have that a bench could show; the time to check a file grows with their cubes."""
States = Field(max_length=MOST_STATES)
Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class FilePart(BaseModel):
    """What all parts have in common: exact types, no key that is not known."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def first_misfit(error: ValidationError) -> tuple[str, str, str]:
    """The place of the first thing that does not fit, what does not fit there, and pydantic's name for that."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    return cut(".".join(map(str, first["loc"])), 100), first["msg"].removeprefix("Value error, "), first["type"]


class SavedParameter(FilePart):
    """One of the twelve parameters, or a coefficient or constant of an effect; null where it was not determined."""

    symbol: Text
    value: FiniteNumber | None
    sigma: Positive | None
    unit: Text
    nominal: FiniteNumber


class SavedState(FilePart):
    """The state of the filter: affine, then the effects' coefficients; of a constant, ln(constant / its value).

    undetermined: symbols of the parameters and coefficients that the run did not determine.
    """

    symbols: Annotated[list[Text], States]
    values: Annotated[list[FiniteNumber], States]
    covariance: Annotated[list[Annotated[list[FiniteNumber], States]], States]
    undetermined: Annotated[list[Text], States]


class SavedProgram(FilePart):
    """A Python file that defines effects."""

    path: Text
    sha256: Sha256


class SavedEffect(FilePart):
    """An effect of the model: as ``--with`` takes it, with its constant where it has one."""

    text: Text
    constant: FiniteNumber | None = None


class SavedNoise(FilePart):
    """The noise model, 1 sigma."""

    sigma_mps2: Three
    inflation: Three
    dwell_sigma_mps2: Three
    dwell_sigma_stated: bool
    angle_sigma_deg: Positive
    angle_sigma_stated: bool
    walk_mps2_per_sqrt_s: Positive
    walk_of_each_mps2_per_sqrt_s: Three | None = None


class SavedConsistency(FilePart):
    """Whether model and measurements agree; null where nothing was left over to judge by."""

    consistent: bool | None
    p_value: Share | None
    nis_per_dof: Positive | None
    dof: Count
    residual_rms_mps2: Positive
    held_out_rms_mps2: Positive | None
    held_out_floor_mps2: Positive | None


class SavedDwell(FilePart):
    """One orientation: gimbal angles (null: attitude recorded), begin, end, readings used."""

    gimbal_deg: list[FiniteNumber] | None
    start_s: Seconds
    end_s: Seconds
    readings: Annotated[Count, Field(ge=1)]


class SavedConditions(FilePart):
    """Under which conditions it holds: when, how warm, which orientations. began: of the run; null if not known."""

    began: Text | None
    duration_s: Annotated[Seconds, Field(ge=0.0)]
    temperature_min_c: Warmth | None
    temperature_mean_c: Warmth | None
    temperature_max_c: Warmth | None
    dwells: list[SavedDwell]


class SavedProvenance(FilePart):
    """Where it comes from."""

    recording: Text
    sha256: Sha256 | None
    bench: dict[Text, Text]
    settings: dict[Text, Text]
    programs: list[SavedProgram]
    versions: dict[Text, Text]
    created: Text
    warnings: list[Text]


_LARGEST_VARIANCE = 1e60  # far beyond any, and products of a few are numbers still
_NEGATIVE = 1e-6  # of correlations that are rounded
_LEAST_VOLUME = 1e-6  # that unit vectors along the input axes span
_EXACT, _ROUNDED = 1e-9, 1e-6  # of values, of sigmas
_ROUNDED_ANGLE = 1e-12  # rad, of one that is near zero
_YEARS = range(1900, 9000)
_FRAME = {"theta1", "phi1", "nu2"}


def refuse_state(state: SavedState, fixed: Collection[str]) -> None:
    """Refuse a state of other symbols, or a covariance that is none; fixed: parameters that were not estimated."""
    count = len(state.symbols)
    if tuple(state.symbols[:STATE_COUNT]) != STATES or len(state.values) != count:
        raise ValueError("state has other symbols than its values need")
    _refuse_repeated(state.symbols, "state.symbols")
    unknown = set(state.undetermined) - {*paper_parameters.SYMBOLS, *state.symbols[STATE_COUNT:]}
    if unknown:
        raise ValueError(f"state.undetermined names {min(unknown)}, which is no parameter of this calibration")
    if fixed and not _FRAME <= set(fixed) <= _FRAME | {*SQUARE}:
        raise ValueError("fixed names other parameters than those of the frame, or of square axes")
    covariance = np.array(state.covariance) if all(len(row) == count for row in state.covariance) else np.zeros(0)
    if covariance.shape != (count, count) or not np.allclose(covariance, covariance.T, rtol=_EXACT, atol=0.0):
        raise ValueError(f"state.covariance is no symmetric matrix of {count} rows")
    if np.abs(covariance).max() > _LARGEST_VARIANCE:
        raise ValueError("state.covariance has numbers that no calibration has")
    _refuse_variances(covariance, state, fixed)


def _refuse_variances(covariance: Floats, state: SavedState, fixed: Collection[str]) -> None:
    """Refuse a matrix that is not positive definite where all is determined; what is fixed has no variance."""
    variances = np.diag(covariance)
    estimated = np.array([symbol not in state.undetermined for symbol in state.symbols])
    if _lacks_some_of_the_twelve(state):
        estimated[:STATE_COUNT] = False
    elif fixed:
        estimated[[*FRAME, *(SQUARE[angle] for angle in fixed if angle in SQUARE)]] = False
    if (variances[estimated] <= 0.0).any():
        symbol = state.symbols[int(np.flatnonzero(estimated & (variances <= 0.0))[0])]
        raise ValueError(f"state.covariance is no covariance: it has no positive variance of {symbol}")
    scale = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    relative = covariance / scale / scale[:, None]
    if not np.isfinite(relative).all() or (variances < 0.0).any() or np.linalg.eigvalsh(relative).min() < -_NEGATIVE:
        raise ValueError("state.covariance is no covariance: it has a negative variance")


def _lacks_some_of_the_twelve(state: SavedState) -> bool:
    return bool(set(state.undetermined) & set(paper_parameters.SYMBOLS))


def refuse_dependent_axes(state: SavedState) -> None:
    """Refuse input axes that lie in one plane, as no specific force follows from their readings."""
    rows = np.array(state.values[:STATE_COUNT]).reshape(3, 4)[:, :3]
    volume = abs(np.linalg.det(rows / np.linalg.norm(rows, axis=1, keepdims=True)))
    if not _lacks_some_of_the_twelve(state) and not volume > _LEAST_VOLUME:
        raise ValueError("state.values has three input axes that lie in one plane")


def refuse_parameters(
    parameters: Sequence[SavedParameter], state: SavedState, fixed: Collection[str], bench: Bench
) -> None:
    """Refuse values, sigmas and nominal values of the twelve that are not those of the state and the bench, and other
    parameters than the coefficients of the state first."""
    twelve = [(each.symbol, each.unit) for each in parameters[:STATE_COUNT]]
    if twelve != list(zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True)):
        raise ValueError(f"parameters must begin with {', '.join(paper_parameters.SYMBOLS)}")
    _refuse_repeated([each.symbol for each in parameters], "parameters")
    coefficients = state.symbols[STATE_COUNT:]
    if [each.symbol for each in parameters[STATE_COUNT : len(state.symbols)]] != coefficients:
        raise ValueError(f"parameters must have {', '.join(coefficients)} after the twelve, as the state has")
    affine = np.array(state.values[:STATE_COUNT])
    jacobian = paper_parameters.jacobian(affine)
    variances = np.diag(jacobian @ np.array(state.covariance)[:STATE_COUNT, :STATE_COUNT] @ jacobian.T)
    expected = zip(paper_parameters.parameters_of(affine), np.sqrt(variances), strict=True)
    nominal = [*paper_parameters.nominal(bench.nominal), *[0.0] * (len(parameters) - STATE_COUNT)]
    for parameter, (value, sigma) in zip(parameters, expected, strict=False):
        _compare(parameter, "its state", float(value), float(sigma), _ROUNDED_ANGLE)
    for parameter, expected_nominal in zip(parameters, nominal, strict=True):
        if not math.isclose(parameter.nominal, expected_nominal, rel_tol=_EXACT, abs_tol=_ROUNDED_ANGLE):
            raise ValueError(
                f"parameters say that {parameter.symbol} is nominally {parameter.nominal!r}, but its bench "
                f"{expected_nominal!r}"
            )
    unknown = {*state.undetermined, *fixed}
    for parameter in parameters[: len(state.symbols)]:
        if [parameter.value is None, parameter.sigma is None] != [parameter.symbol in unknown] * 2:
            raise ValueError(
                f"parameters and state.undetermined do not agree whether {parameter.symbol} was determined"
            )


def refuse_coefficients(
    parameters: Sequence[SavedParameter], state: SavedState, noise: SavedNoise, model: Model
) -> None:
    """Refuse coefficients and constants of effects that are not those of the state, in the units of the model."""
    if [each.symbol for each in model.coefficients] != state.symbols[STATE_COUNT:]:
        raise ValueError("state has other symbols than its effects: it was saved by another version")
    values, gains = model.natural(np.array(state.values))
    sigmas = np.sqrt(np.diag(state.covariance)[STATE_COUNT:]) * gains
    first = [
        (each.symbol, each.unit, value, sigma)
        for each, value, sigma in zip(model.coefficients, values.tolist(), sigmas.tolist(), strict=True)
    ]
    expected = [*first, *_beside_the_state(model, noise)]
    if [(each.symbol, each.unit) for each in parameters[STATE_COUNT:]] != [own[:2] for own in expected]:
        names = ", ".join(f"{symbol} in {unit}" for symbol, unit, *_ in expected)
        raise ValueError(f"parameters must have {names or 'nothing'} after the twelve, as its effects have")
    for parameter, (_, _, value, sigma) in zip(parameters[STATE_COUNT:], expected, strict=True):
        _compare(parameter, "its state" if sigma is not None else "another place", value, sigma)


def _beside_the_state(model: Model, noise: SavedNoise) -> Iterator[tuple[str, str, float, None]]:
    """Symbol, unit and value of what is estimated outside the filter, whose sigma stands nowhere else."""
    if (walk := model.intensity) is not None:
        yield walk.symbol, walk.unit, noise.walk_mps2_per_sqrt_s, None
    for effect in model.constants_beside_state:
        assert effect.unknown is not None
        yield effect.unknown.symbol, effect.unknown.unit, effect.value, None


def _compare(parameter: SavedParameter, where: str, value: float, sigma: float | None, rounded: float = 0.0) -> None:
    """Refuse a value or a sigma that is another one elsewhere; None where it is written nowhere else."""
    if parameter.value is not None and not math.isclose(parameter.value, value, rel_tol=_EXACT, abs_tol=rounded):
        raise ValueError(f"parameters say {parameter.symbol} = {parameter.value!r}, but {where} says {value!r}")
    if parameter.sigma is not None and sigma is not None and not math.isclose(parameter.sigma, sigma, rel_tol=_ROUNDED):
        raise ValueError(
            f"parameters say {parameter.symbol} has sigma {parameter.sigma!r}, but its covariance says {sigma!r}"
        )
    if parameter.sigma == 0.0:
        raise ValueError(f"parameters say {parameter.symbol} has sigma 0: nothing is known exactly")


def refuse_effects(chosen: Sequence[SavedEffect], state: SavedState) -> None:
    """Refuse an effect that is named twice, or more of them than the state has coefficients for; a random walk of the
    biases alone has none."""
    texts = ["".join(each.text.split()) for each in chosen]
    _refuse_repeated(texts, "effects")
    if len(texts) > len(state.symbols) - STATE_COUNT + 1:
        raise ValueError(f"there are {len(texts)} effects, but only {len(state.symbols) - STATE_COUNT} coefficients")


def refuse_judgement(judged: SavedConsistency) -> None:
    """Refuse a verdict that does not follow from its p-value."""
    if judged.consistent != (None if judged.p_value is None else judged.p_value >= LEVEL):
        raise ValueError(f"consistency says consistent = {judged.consistent}, which is not what its p_value says")


def refuse_conditions(conditions: SavedConditions, provenance: SavedProvenance, bench: Bench) -> None:
    """Refuse dates that are none, dwells that end before they begin, and angles of other gimbals than the bench's."""
    for name, text in (("conditions.began", conditions.began), ("provenance.created", provenance.created)):
        if text is not None and not _is_date(text):
            raise ValueError(f"{name} is {text[:40]!r}, which is no date")
    warmth = [conditions.temperature_min_c, conditions.temperature_mean_c, conditions.temperature_max_c]
    known = [each for each in warmth if each is not None]
    if known and (len(known) < len(warmth) or known != sorted(known)):
        raise ValueError("conditions has a mean temperature that is not between the lowest and the highest")
    for number, dwell in enumerate(conditions.dwells, 1):
        if dwell.end_s < dwell.start_s:
            raise ValueError(f"conditions.dwells: number {number} ends before it begins")
        if dwell.gimbal_deg is not None and len(dwell.gimbal_deg) != len(bench.axes):
            raise ValueError(f"conditions.dwells: number {number} has {len(dwell.gimbal_deg)} gimbal angles, its bench "
                             f"has {len(bench.axes)} axes")  # fmt: skip


def _is_date(text: str) -> bool:
    """Whether it is a date of ISO 8601 that can be told in UTC."""
    try:
        return parse_date(text).year in _YEARS
    except ValueError:
        return False


def _refuse_repeated(texts: Sequence[str], where: str) -> None:
    text, count = max(Counter(texts).items(), key=lambda item: item[1], default=("", 0))
    if count > 1:
        raise ValueError(f"{where} names {text[:60]!r} {'twice' if count == 2 else f'{count} times'}")
