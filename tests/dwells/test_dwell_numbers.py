"""A dwell has one number, from 1, wherever a person or a program reads it; one that is not used keeps its own."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import Run

from kf_calib.bench.streams import Stream
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import Session
from kf_calib.support.json_values import json_value
from kf_calib.views import console
from kf_calib.views.diagnosis import diagnosis_report
from kf_calib.views.json import replay_object
from kf_calib.views.live import objects
from kf_calib.views.rerun.series import ORIENTATION, VisitHistory, ends

pytestmark = pytest.mark.filterwarnings("error")
COUNT = 300
USED = [1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12]


def run() -> Run:
    """Twelve dwells; the third has too few readings to be used, and readings of the eighth were disturbed."""
    out = Run(seed=4, dwells=12, batch=COUNT)
    out.accel.values[7 * COUNT + 30 + 3 * np.arange(30), 2] -= 0.1
    kept = np.ones(len(out.accel), bool)
    kept[2 * COUNT : 3 * COUNT - 9] = False
    out.accel = Stream(out.accel.time_ns[kept], out.accel.values[kept])
    return out


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(run())


def test_visits_are_numbered_from_one(result: Calibration) -> None:
    assert [visit.dwell.number for visit in result.visits] == USED
    assert sorted({number for _, number, _ in result.trace()}) == USED


def test_findings_name_dwells_by_these_numbers(result: Calibration) -> None:
    assert result.readings.outliers.dwells == (8,)
    assert json_value(replay_object(result))["readings"]["outliers"]["dwells"] == [8]
    assert any("crowded in dwell 8 " in warning for warning in result.warnings)


def test_the_rerun_timeline_counts_by_these_numbers(result: Calibration) -> None:
    assert ends(result.visits)[ORIENTATION].tolist() == USED
    history = VisitHistory.of(result)
    assert history.orientation[history.whole].tolist() == USED
    assert set(history.after(result.visits[:4]).orientation.tolist()) == set(USED[4:])
    assert history.after(()).orientation.tolist() == history.orientation.tolist()


@pytest.mark.slow
def test_the_table_of_a_diagnosis_names_dwells_by_these_numbers() -> None:
    spoilt = run()
    at = slice(6 * COUNT - COUNT + 9, 7 * COUNT - COUNT + 9)  # of the seventh dwell
    spoilt.accel.values[at] += 1e-3
    shown = console.plain(diagnosis_report(diagnose(calibrate(spoilt)), details=True))
    first = shown[shown.index("Where it fails") :].splitlines()[4]
    assert first.split("│")[1].strip() == "7"


@pytest.mark.slow
def test_a_live_run_numbers_its_dwells_from_one() -> None:
    session, lines = Session(run(), Settings()), list[str]()
    session.listeners.append(lambda judgement: lines.append(objects.line(judgement)))
    session.run()
    assert [int(line.split()[1]) for line in lines] == [*USED, USED[-1]]
