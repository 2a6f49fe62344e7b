"""Effects along axes across the input axes, where these are turned by as much as the input axes are: by scipy alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from helpers.independent_bench import BENCH, G, IndependentBench, State
from helpers.long_runs import slow
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.estimation.axes_across import AxesAcross
from kf_calib.estimation.measurement_model import SQUARE, Model

KINDS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "cross-axis-square": lambda i, p, o: p * p,
    "cross-coupling-ip": lambda i, p, o: i * p,
    "cross-coupling-io": lambda i, p, o: i * o,
    "cross-coupling-po": lambda i, p, o: p * o,
    "output-square": lambda i, p, o: o * o,
    "second-order": lambda i, p, o: i * i,
}
SYMBOLS = dict(zip(KINDS, ["Kpp", "Kip", "Kio", "Kpo", "Koo", "K2_"], strict=True))


@dataclass(frozen=True)
class TurnedTriads(IndependentBench):
    """Three accelerometers, each with its own input, pendulous and output axis, turned by 10 mrad in the platform."""

    white_mps2: float = 2e-3

    @property
    def triads(self) -> np.ndarray:
        """Unit axes (accelerometers, i p o, 3)."""
        rng = np.random.default_rng([self.seed, 5])
        turns = [Rotation.from_rotvec(0.01 * rng.standard_normal(3)) for _ in range(3)]
        return np.array([turn.apply(np.roll(np.eye(3), -i, axis=0)) for i, turn in enumerate(turns)])

    def _sensors(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        _, scales, biases = super()._sensors(rng)
        return self.triads[:, 0], scales, biases


def run_with(kind: str, seed: int, coefficients: np.ndarray) -> IndependentBench:
    """A run with one effect of coefficients (3,), 1/(m/s^2)."""
    triads = TurnedTriads(seed).triads

    def bias(state: State) -> np.ndarray:
        force_mps2 = Rotation.from_euler("YZX", state.angles_rad).inv().apply([0.0, G, 0.0])
        changes = [KINDS[kind](*(force_mps2 @ axis for axis in triad)) for triad in triads]
        return np.stack(changes, axis=1) * coefficients

    return TurnedTriads(seed, bias=bias, bench=BENCH)


def coefficients_of(seed: int, size_g: float) -> np.ndarray:
    """Coefficients (3,), 1/(m/s^2), of a size in g/g^2."""
    return size_g / G * np.random.default_rng([seed, 9]).standard_normal(3)


@pytest.mark.parametrize(
    "kind, seed",
    [("cross-axis-square", 3), *slow(("cross-coupling-ip", 3), ("output-square", 3), ("cross-coupling-po", 3),
                                     ("cross-coupling-io", 4), ("second-order", 4))],
)  # fmt: skip
def test_a_large_effect_is_named_alone(kind: str, seed: int) -> None:
    """What is left where its axes are taken for those of the platform is not a second effect."""
    found = kf_calib.diagnose(run_with(kind, seed, coefficients_of(seed, 5e-3)), replicate=False)
    assert found.missing == (kind,) and found.sure, found.verdict
    assert found.after is not None and found.after.consistency.p_value > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_misfit_and_sigmas_are_those_of_axes_that_are_not_known(kind: str) -> None:
    p_values, errors = list[float](), list[float]()
    for seed in range(1, 41):
        truth = coefficients_of(seed, 3e-3)
        found = kf_calib.calibrate(run_with(kind, seed, truth), effects=[kind])
        assert found.consistency.p_value is not None
        p_values.append(found.consistency.p_value)
        estimates = [found.parameters[f"{SYMBOLS[kind]}{i}"] for i in (1, 2, 3)]
        errors += [(each.value - true) / each.sigma for each, true in zip(estimates, truth, strict=True)]
    assert kstest(p_values, "uniform").pvalue > 1e-3
    # sigmas are too wide where the axes turn with the input axis, which is known
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_where_all_axes_are_taken_for_square_they_may_be_off_by_what_is_stated() -> None:
    """Six faces in the hand: no input axis tells by how much."""
    model = Model(Bench((), G, angles=False), square=tuple(SQUARE))
    assert AxesAcross(model, model.nominal_state()).sizes == pytest.approx([model.bench.square_rad])
