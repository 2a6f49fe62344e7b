"""The coefficients of a data sheet are those of a sensor that nobody here simulates, within their sigmas."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.independent_bench import G, IndependentBench
from helpers.long_runs import slow
from helpers.paths import RECORDINGS

from kf_calib.bench.streams import Batch, Stream
from kf_calib.diagnosis.data_sheet import DataSheet, data_sheet
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.estimation.calibration import calibrate

G2, G3 = 1e-6 * G / G**2, 1e-6 * G / G**3  # 1 µg/g², 1 µg/g³ in SI
TRUTH = {
    "K2": G2 * np.array([12.0, -8.0, 5.0]), "K3": G3 * np.array([3.0, 4.0, -6.0]),
    "Kip": G2 * np.array([-7.0, 9.0, 4.0]), "Kio": G2 * np.array([6.0, -5.0, 8.0]),
    "Kpo": G2 * np.array([-4.0, 6.0, 7.0]),
}  # fmt: skip


@dataclass(frozen=True)
class NonlinearBench(IndependentBench):
    """With the coefficients of ``TRUTH``: pendulous axes y, z, x of accelerometers 1, 2, 3, output axes z, x, y."""

    factor: float = 1.0

    def __iter__(self) -> Iterator[Batch]:
        for batch in IndependentBench.__iter__(self):
            force = batch.accel.values  # to 1e-3, which is less than the sigmas tell
            pendulous, output = np.roll(force, -1, axis=1), np.roll(force, -2, axis=1)
            added = (
                TRUTH["K2"] * force**2 + TRUTH["K3"] * force**3 + TRUTH["Kip"] * force * pendulous
                + TRUTH["Kio"] * force * output + TRUTH["Kpo"] * pendulous * output
            )  # fmt: skip
            yield Batch(Stream(batch.accel.time_ns, force + self.factor * added), batch.pose)


def sheet_of(source: Any) -> DataSheet:
    refits = Refits(source)
    return data_sheet(diagnose(calibrate(source), refits), refits)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(1), *slow(range(10, 30))])
def test_coefficients_are_within_their_sigmas(seeds: range) -> None:
    scores = list[float]()
    for seed in seeds:
        rows = {row.symbol: row for row in sheet_of(NonlinearBench(seed, dwells=48)).rows}
        for symbol, truth in TRUTH.items():
            values, sigmas = np.array(rows[symbol].values), np.array(rows[symbol].sigmas)
            scores += ((values - truth) / sigmas).tolist()
            assert (np.abs(truth) > 3.0 * sigmas).all(), symbol
    assert np.abs(scores).max() < 4.5 and np.sqrt(np.mean(np.square(scores))) < 1.3


def test_k0_is_the_bias_over_the_scale_factor_and_its_sigma_that_of_draws() -> None:
    source = IndependentBench(4)
    sheet = sheet_of(source)
    k1, k0 = sheet.rows[:2]
    found, covariance = sheet.result.parameters, sheet.result.estimate.parameter_covariance
    drawn = np.random.default_rng(1).multivariate_normal(
        [found[name].value for name in ("K1", "b1")], covariance[2:4, 2:4], 100_000
    )
    ratio = drawn[:, 1] / drawn[:, 0]
    assert k0.values[0] == pytest.approx(found["b1"].value / found["K1"].value)
    assert k0.sigmas[0] == pytest.approx(ratio.std(), rel=0.01) and k1.sigmas[0] == found["K1"].sigma


def test_what_six_faces_do_not_tell_has_no_number() -> None:
    from kf_calib.sources.opening import opened

    rows = {row.symbol: row for row in sheet_of(opened(RECORDINGS / "mems_faces.mcap")).rows}
    for symbol in ("K2", "K3", "Kip", "Kio", "Kpo", "K0'", "Koq", "alpha", "K2v"):
        assert rows[symbol].values == (None, None, None) == rows[symbol].sigmas, symbol
    assert None not in rows["K0"].values


@pytest.mark.usefixtures("undrawn")
def test_the_page_and_the_json_have_the_sheet(run: Any, tmp_path: Path) -> None:
    words = ("report", RECORDINGS / "hidden.mcap", "--standard", "ieee1293", "-o", tmp_path / "page.html")
    rows = {row["symbol"]: row for row in run.json(*words)["data_sheet"]}
    assert rows["h"]["estimated"] == "found" and abs(rows["h"]["values"][1]) > 5 * rows["h"]["sigmas"][1]
    page = (tmp_path / "page.html").read_text()
    assert "Data sheet with the symbols of IEEE Std 1293" in page
    assert "coupling i × p" in page
    told = run.json("report", RECORDINGS / "mems_faces.mcap", "-o", tmp_path / "other.html")
    assert told["data_sheet"] is None and "Data sheet" not in (tmp_path / "other.html").read_text()
