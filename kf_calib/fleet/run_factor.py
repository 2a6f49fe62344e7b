"""What one run tells of its parameters and of every effect of the catalogue, as one triangular factor.

The whitened rows [H | G | z] of a run, H the columns of its model, G those of the effects that are not in the model and
z the readings, are reduced by one QR to the upper triangle R with R'R = [H | G | z]'[H | G | z]. Nothing of what linear
models can ask of the run is lost by this: estimates, their covariances and the chi-squared of any choice of the columns
follow from R alone. Factors of runs with coefficients in common are stacked and reduced by one more QR, exactly and in
any order (G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.paper_parameters import STATES
from kf_calib.dwells.qr import triangle
from kf_calib.effects import Effect, effect_named, names
from kf_calib.errors import InputError, check_number
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.score_test import whiten_model
from kf_calib.noise.noise_model import Noise


def column_name(effect: Effect | str, symbol: str) -> str:
    """The name of the column of one coefficient, for example ``second-order/K2_1``."""
    return f"{effect}/{symbol}"


@dataclass(frozen=True, repr=False)
class RunFactor:
    """The reduced factor of one run, in the noise of this run.

    Whitening divides by the noise that was found in the run (or stated): that of readings with its autocorrelation, the
    setting error of each dwell and the scatter from dwell to dwell. Rows of R have unit noise, so that factors of
    different runs can be stacked as they are. The log-determinant of the noise itself is not here: it is the same for
    every model of the run, and what a restricted likelihood needs besides, log |R_ii|, is on the diagonal.

    - run: where the recording is. unit, bench: names of the block and of the bench. date: of the first sample (ISO
      8601, UTC). None where it is not known.
    - columns (p,): names of the coefficients: ``sx1 sy1 sz1 b1 sx2 ... b3`` of the twelve states (without those that
      the frame fixes where no angles are used, which leaves nine), then ``effect/symbol`` of the effects.
    - width: number of the first columns that belong to the model of the run; the others are candidates.
    - factor (p + 1, p + 1): upper triangular [H | G | z], SI units. The last diagonal element is the norm of what no
      column explains. The readings are absolute: a solution of R x = z is the state itself, not a correction to it.
      A column is zero where the run shows nothing of the coefficient, as without a thermometer.
    - rows: number of whitened readings that were reduced (three channels, a parabola in each piece of a dwell).
    - constants: value of each constant inside an effect's columns, by the name of the effect; it is the same in every
      run.
    - nominal (12,): the nominal states, about which small rotations may be linearised where no estimate is at hand.
    - noise_estimated: whether setting error or scatter were estimated from the misfit of this very run.
    """

    run: str
    unit: str | None
    bench: str | None
    date: str | None
    columns: tuple[str, ...]
    width: int
    factor: Floats
    rows: int
    constants: dict[str, float]
    nominal: Floats
    noise_estimated: bool

    @cached_property
    def places(self) -> dict[str, int]:
        """The index of each column by its name."""
        return {name: k for k, name in enumerate(self.columns)}

    @cached_property
    def effects(self) -> dict[str, list[str]]:
        """The names of the columns of each effect, those of the model of the run first."""
        names = dict[str, list[str]]()
        for name in self.columns:
            effect, slash, _ = name.rpartition("/")
            if slash:
                names.setdefault(effect, []).append(name)
        return names

    @property
    def states(self) -> tuple[str, ...]:
        """The columns of the sensor's states: the first twelve, or nine without angles."""
        return tuple(name for name in self.columns if name in STATES)

    @property
    def model(self) -> tuple[str, ...]:
        """The columns of the model of the run: its states, and the effects it was evaluated with."""
        return self.columns[: self.width]

    def of(self, columns: Sequence[str]) -> Floats:
        """The factor (k + 1, k + 1) [R | z] of some columns in the order given, with all others fixed at zero.

        Raises KeyError if the run has no column of such a name.
        """
        kept = [*(self.places[name] for name in columns), len(self.columns)]
        return triangle(self.factor[:, kept])


def candidate_effects(model: Model) -> list[Effect]:
    """Effects of the catalogue that are not in the model and have columns in dwells; constants are at their usual
    value."""
    inside = {str(effect) for effect in model.effects}
    tried = (effect_named(name, model.bench) for name in names(model.bench) if name not in inside)
    return [effect for effect in tried if effect.scannable]


def run_factor(fitted: Fit) -> RunFactor:
    """The reduced factor of a fit: its model and, where angles are known, all effects of the catalogue. Of which run it
    is, the fit does not know."""
    linearised = fitted.linearised
    model, state, folded = linearised.model, linearised.state, linearised.dwells.folded
    added = candidate_effects(model) if model.bench.angles else []
    with one_blas_thread():
        rows, before = whiten_model(linearised, fitted.noise, added, state)
        slow = slice(model.count, before)  # the slow part of a stated scatter, of which the prior is among the rows
        ordered = np.hstack([rows[:, slow], rows[:, : model.count], rows[:, before:]])
        lacking = max(ordered.shape[1] - len(ordered), 0)
        upper = triangle(np.pad(ordered, ((0, lacking), (0, 0))))[before - model.count :, before - model.count :]
    kept = [k for k in range(len(upper)) if k not in model.fixed]
    inside = [*STATES, *_names(model.effects, states=True)]
    return RunFactor(
        "", None, None, None,
        columns=tuple(name for k, name in enumerate([*inside, *_names(added)]) if k not in model.fixed),
        width=model.count - len(model.fixed),
        factor=triangle(upper[:, kept]) if model.fixed else upper,
        rows=3 * int(np.minimum(folded.pieces.counts, folded.width).sum()),
        constants={str(each): float(each.value) for each in (*model.effects, *added) if each.unknown is not None},
        nominal=Model(model.bench).nominal_state(),
        noise_estimated=_has_estimated_parts(fitted.noise),
    )  # fmt: skip


def _names(effects: Sequence[Effect], states: bool = False) -> list[str]:
    """Return the names of the columns of effects; of those in a model (``states``), with their unknown constants."""
    return [
        column_name(effect, each.symbol)
        for effect in effects
        for each in (effect.states if states else effect.coefficients)
    ]


def _has_estimated_parts(noise: Noise) -> bool:
    """Tell whether the noise has a part from dwell to dwell that was estimated from the misfit."""
    setting = noise.setting_rad > 0.0 and not (noise.setting.stated or noise.attitude_unknown)
    return setting or (not noise.scatter.stated and bool(noise.scatter_mps2.any()))


@dataclass(frozen=True)
class ReferenceUnit:
    """unit: its name in the runs. scale (3,): its scale factors K1, K2, K3. sigma (3,): how well these are known.
    sha256: of the recording that they are from.

    One run cannot tell a wrong gravity from scale factors that are all wrong by the same share. Runs of a unit whose
    scale factors are known can.
    """

    unit: str
    scale: tuple[float, float, float]
    sigma: tuple[float, float, float]
    sha256: str | None = None

    def __post_init__(self) -> None:
        for scale, sigma in zip(self.scale, self.sigma, strict=True):
            check_number(f"a scale factor of the reference unit {self.unit}", scale)
            check_number(f"a sigma of the reference unit {self.unit}", sigma)
            if not sigma:
                raise InputError(f"the reference unit {self.unit} has a sigma of 0: state how well it is known.")

    def known(self, factor: RunFactor, runs: int) -> Floats:
        """The factor [H | G | z] of a run of this unit with what is known of it: K_i = s_i . E_i as three readings.

        runs: how many of this unit there are. What is known is known once, so each of them has its share of it.

        Raises InputError if the run has not all twelve states, as without angles.
        """
        if len(factor.states) < len(STATES):
            raise InputError(f"{factor.run}: the reference unit {self.unit} needs a run with platform angles.")
        upper, width = factor.factor, factor.width
        states = np.linalg.lstsq(upper[:width, :width], upper[:width, -1], rcond=1e-12)[0]
        rows, sigma = np.zeros((3, upper.shape[1])), np.sqrt(runs) * np.array(self.sigma)
        for i in range(3):
            own = [factor.places[f"s{part}{i + 1}"] for part in "xyz"]
            rows[i, own] = states[own] / np.linalg.norm(states[own]) / sigma[i]
            rows[i, -1] = self.scale[i] / sigma[i]
        return triangle(np.vstack([upper, rows]))
