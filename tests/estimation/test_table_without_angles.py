"""Tables of means without angles and without standard deviations: the noise comes from one number a pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow

import kf_calib
from kf_calib.bench.streams import Table
from kf_calib.errors import InputError, UnobservableError
from kf_calib.sources.opening import opened

SENSITIVITY = np.array([[1.01, 0.0, 0.0], [0.004, 0.99, 0.0], [-0.003, 0.002, 1.02]])
BIAS_MPS2 = np.array([0.2, -0.1, 0.3])
NOISE_MPS2 = 2e-3


def bare_table(seed: int, poses: int = 24, **bench: str) -> Table:
    """Six faces and random poses, read with noise."""
    rng = np.random.default_rng(seed)
    up = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(poses - 6, 3))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    means = 9.81 * up @ SENSITIVITY.T + BIAS_MPS2 + NOISE_MPS2 * rng.normal(size=(poses, 3))
    columns = {f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}
    return kf_calib.open_table(columns, {"gravity_mps2": "9.81", **bench}, angles=False)


@pytest.mark.parametrize("tables", [4, *slow(24)])
def test_the_noise_is_found_and_sigmas_are_those_of_the_errors(tables: int) -> None:
    """Over the tables, errors over sigma of scale factors and biases have the rms of Student's t with 15 degrees of
    freedom, sqrt(15 / 13), and the noise is that of the readings, not of what an unknown attitude leaves of it."""
    scores, noises = list[float](), list[float]()
    for seed in range(tables):
        run = kf_calib.calibrate(bare_table(seed))
        truth = {f"K{k + 1}": float(np.linalg.norm(SENSITIVITY[k])) for k in range(3)}
        truth |= {f"b{k + 1}": float(BIAS_MPS2[k]) for k in range(3)}
        for symbol, expected in truth.items():
            found = run.parameters[symbol]
            assert found.value is not None
            scores.append((found.value - expected) / found.sigma)
        noises.append(float(run.noise.scatter_mps2.mean()))
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx((15.0 / 13.0) ** 0.5, rel=0.2 * (24 / tables) ** 0.5)
    assert np.sqrt(np.mean(np.square(noises))) == pytest.approx(NOISE_MPS2, rel=0.15 * (24 / tables) ** 0.5)


@pytest.mark.parametrize("poses", [10, 13])
def test_too_few_poses_to_tell_their_noise_are_refused(poses: int) -> None:
    """Ten poses and nine parameters leave one number, not twenty-one."""
    with pytest.raises(InputError, match="too few to estimate the noise"):
        kf_calib.calibrate(bare_table(1, poses))
    stated = kf_calib.calibrate(bare_table(1, poses, scatter_sigma_mps2=str(NOISE_MPS2)))
    assert stated.parameters["K1"].sigma > 5e-5


def test_what_the_noise_was_taken_from_is_not_diagnosed() -> None:
    with pytest.raises(InputError, match="so that no misfit can be diagnosed"):
        kf_calib.diagnose(bare_table(1))
    assert kf_calib.diagnose(bare_table(1, scatter_sigma_mps2=str(NOISE_MPS2))).test.consistent


def test_equal_poses_without_noise_tell_no_scale_and_no_bias(tmp_path: Path) -> None:
    """A sum of squares loses what is weak beside 1e-18: a sigma was no number, and K3 was taken for known."""
    table = tmp_path / "three.csv"
    table.write_text("t,ax,ay,az\n" + "".join(f"{t},0,0,9.8\n" for t in (5, 4, 3)))
    source = opened(table, {"gravity_mps2": "9.81"}, angles=False)
    with pytest.raises(UnobservableError, match="3 poses do not determine K1, K2, K3, b1, b2, b3"):
        kf_calib.calibrate(source)
