"""Charts in Rerun's 2-D views: places are values, ticks are round; views of a run, a diagnosis, an improvement and a
comparison hold the numbers of their results."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import ROOT

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.residual_drivers import drivers_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, improve
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.information_share import information_shares
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import Session
from kf_calib.online.status import Judgement
from kf_calib.sources.files.recording import Recording
from kf_calib.views import rerun as view
from kf_calib.views.rerun import comparison, diagnosis, improvement, residuals
from kf_calib.views.rerun.chart import Axis, Chart, number
from kf_calib.views.rerun.explorer import drawn_values, signed
from kf_calib.views.rerun.file import new_stream
from kf_calib.views.rerun.growing import GrowingView
from kf_calib.views.rerun.names import per_si
from kf_calib.views.rerun.series import History
from kf_calib.views.rerun.sigmas import Falling
from kf_calib.views.screenshot import screenshot, viewer

RECORDINGS = ROOT / "recordings"


def run(name: str, *effects: str, **settings: object) -> Calibration:
    return calibrate(Recording(RECORDINGS / f"{name}.mcap"), Settings(effects=effects, **settings))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def hidden() -> Calibration:
    return run("hidden", "hysteresis")


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnose(RECORDINGS / "hidden.mcap")


@pytest.fixture(scope="module")
def improved(found: Diagnosis) -> Improvement:
    return improve(found.before)


def content(path: Path, component: str, timeline: str = "") -> dict[str, dict[int | None, list]]:
    """Values of a component by entity, and by the step of a timeline (None: for all times)."""
    from rerun.chunk import RrdReader

    out = defaultdict[str, dict[int | None, list]](dict)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = batch.select([name for name in batch.schema.names if name != "log_time"]).to_pydict()
        for k, values in enumerate(columns.get(component, [])):
            out[chunk.entity_path][columns[timeline][k] if timeline in columns else None] = values
    return out


def values_at(chart: Chart, places: list | Floats) -> Floats:
    """The values (n, 2) that stand at places in the sheet."""
    across, down = np.asarray(places, float).reshape(-1, 2).T

    def value(axis: Axis, share: Floats) -> Floats:
        if axis.log:
            return axis.low * (axis.high / axis.low) ** share
        return axis.low + share * (axis.high - axis.low)

    x = value(chart.x, (across - chart.corner[0]) / chart.width)
    return np.column_stack([x, value(chart.y, 1.0 - (down - chart.corner[1]) / chart.height)])


@pytest.mark.parametrize(
    ("axis", "texts"),
    [
        (Axis(0.02, 0.3, log=True), ["0.02", "0.05", "0.1", "0.2"]),
        (Axis(0.5, 2e6, log=True), ["1", "100", "10000", "10⁶"]),
        (Axis(1e-300, 2.0, log=True), None),
        (Axis(-2.2, 3.0), ["−2", "0", "2"]),
        (Axis(-251.64, -251.5), ["−251.60", "−251.55", "−251.50"]),
        (Axis(0.5, 24.5, whole=True), ["10", "20"]),
        (Axis(0.5, 2.5, whole=True), ["1", "2"]),
    ],
)
def test_ticks_are_round_and_tell_a_size(axis: Axis, texts: list[str] | None) -> None:
    found = axis.ticks(4)
    assert len(found) >= 2 and len({text for _, text in found}) == len(found)
    assert all(axis.low <= value <= axis.high for value, _ in found)
    if texts is not None:
        assert [text for _, text in found] == texts


@pytest.mark.parametrize("log", [False, True])
def test_an_axis_holds_what_it_is_made_for(log: bool) -> None:
    values = np.array([0.3, np.nan, 7.0, 2.0])
    axis = Axis.around(values, log=log)
    assert axis.low < 0.3 and axis.high > 7.0
    share = axis.share(np.array([axis.low, axis.high, 1e9, -1e9 if not log else 1e-9]))
    np.testing.assert_allclose(share, [0.0, 1.0, 1.0, 0.0])
    chart = Chart("x", Axis(0.0, 1.0), axis, corner=(30.0, 20.0))
    y = np.array([0.3, 7.0, 2.0])
    np.testing.assert_allclose(values_at(chart, chart.at(np.array([0.1, 0.5, 0.9]), y)),
                               np.column_stack([[0.1, 0.5, 0.9], y]), rtol=1e-9)  # fmt: skip
    for alike in (np.array([5.0, 5.0]), np.array([np.nan]), np.array([0.0])):
        same = Axis.around(alike, log=log)
        assert same.low < same.high and len(same.ticks(4)) >= (2 if log else 0)
    assert [number(value) for value in (0.0, 1234.0, 1e5, 2e-7, -3.0)] == ["0", "1230", "10⁵", "2·10⁻⁷", "−3"]


def test_curves_break_where_nothing_is_known() -> None:
    chart = Chart("x", Axis(0.0, 5.0), Axis(0.0, 5.0))
    parts = chart.strip(np.arange(6.0), np.array([np.nan, 1.0, 2.0, np.nan, np.nan, 3.0]))
    assert [len(part) for part in parts] == [2, 1]
    np.testing.assert_allclose(values_at(chart, parts[0]), [[1.0, 1.0], [2.0, 2.0]])


def test_sigmas_by_orientation_are_those_of_the_run(hidden: Calibration, tmp_path: Path) -> None:
    falling = Falling.of(hidden, History.of(hidden))
    path = view.save(hidden, tmp_path / "run.rrd")
    points = np.array(content(path, "Points2D:positions")["/each/curves/points"][None])
    drawn, at = list[Floats](), 0
    for k, chart in enumerate(falling.single()):
        known = np.flatnonzero(np.isfinite(falling.sigma[:, k]))
        drawn.append(values_at(chart, points[at : at + len(known)]))
        at += len(known)
        expected = [[*visit.estimate.sigma * per_si(), *visit.estimate.effect_sigma * 1e6 / 9.80665][k]
                    for visit in hidden.visits]  # fmt: skip
        np.testing.assert_allclose(drawn[-1][:, 0], falling.orientation[known], rtol=1e-4)
        np.testing.assert_allclose(drawn[-1][:, 1], np.array(expected)[known], rtol=1e-4)
    assert at == len(points) and len(drawn) == 15
    texts = content(path, "Points2D:labels")["/sigmas/frame/texts"][None]
    best, worst = np.sort(hidden.estimate.sigma[[2, 6, 10]] * 1e6)[[0, 2]]
    assert any(f"worst K₁ {worst:.3g}" in text and f"{best:.3g}" in text for text in texts)
    share = information_shares(hidden)[:, [2, 6, 10]].mean(axis=1).max()
    assert f"highest bar {100 * share:.0f} %" in texts


def test_effects_are_in_the_correlations(hidden: Calibration, tmp_path: Path) -> None:
    path = view.save(hidden, tmp_path / "run.rrd")
    labels = content(path, "Points2D:labels")["/correlation/rows"][None]
    assert labels[-3:] == ["h1", "h2", "h3"] and len(labels) == 15
    sigma = content(path, "Scalars:scalars", view.ORIENTATION)["/parameters/effects/h2/sigma"]
    assert sigma[24] == pytest.approx([hidden.estimate.effect_sigma[1] * 1e6 / 9.80665])


def test_runs_with_little_to_judge_by_show_residuals() -> None:
    faces = run("mems_faces")
    assert not residuals.predicted(faces) and [chart.path for chart in residuals.fit_charts(faces)] == ["fit/residual"]
    np.testing.assert_allclose(residuals.ratios(faces), faces.residuals_mps2 / mean_sigmas(faces))


def test_a_diagnosis_shows_what_each_explanation_leaves(found: Diagnosis, tmp_path: Path) -> None:
    path = view.save(found, tmp_path / "found.rrd")
    made, sigmas, driver = diagnosis.View(found), mean_sigmas(found.before), drivers_of(found.before)[0]
    before = content(path, "Points2D:positions")
    after = content(path, "Points2D:positions", diagnosis.EXPLANATION)
    charts = made.charts(driver)
    assert driver.symbol == "da" and found.explanations[0].name == "hysteresis"
    for i, channel in enumerate(("a1", "a2", "a3")):
        place = before[f"/explorer/before/{channel}/residuals"][None]
        ratios = found.before.residuals_mps2 / sigmas
        drawn = np.column_stack([drawn_values(driver)[:, i], ratios[:, i]])
        np.testing.assert_allclose(values_at(charts["before"][i], place), drawn, atol=1e-3)
        for rank, each in enumerate(made.explanations, 1):
            place = after[f"/explorer/left/{channel}/residuals"][rank]
            np.testing.assert_allclose(values_at(charts["left"][i], place)[:, 1], each.left_ratios[:, i], atol=1e-3)
        place = after[f"/explorer/effect/{channel}/residuals"][1]
        own = made.explanations[0]
        readings = (own.contribution_mps2 + own.left_mps2)[:, i] / sigmas[:, i]
        np.testing.assert_allclose(values_at(charts["effect"][i], place)[:, 1], readings, atol=1e-3)
    colours = content(path, "Points3D:colors", "")["/spheres/before/1/residuals"][None]
    assert len(colours) == len(found.before.visits)


def test_colours_of_residuals_tell_their_sign() -> None:
    blue, grey, orange = signed(np.array([-5.0, 0.0, 5.0])).astype(int)
    assert blue[2] > 200 > blue[0] and orange[0] > 200 > orange[2] and np.ptp(grey) < 10


def test_an_improvement_is_a_timeline_of_steps(improved: Improvement, tmp_path: Path) -> None:
    path = view.save(improved, tmp_path / "improved.rrd")
    made = improvement.View.of(improved)
    assert len(made.found) == 2
    points = content(path, "Points2D:positions")
    chart = improvement._error_chart(made)
    held = values_at(chart, points["/errors/held_out/points"][None])[:, 1]
    np.testing.assert_allclose(held, [each.held_out_rms_mps2 * 1e6 / 9.80665 for each in made.results], rtol=1e-3)
    inside = values_at(chart, points["/errors/within_the_run/points"][None])[:, 1]
    np.testing.assert_allclose(inside, [each.residual_rms_mps2 * 1e6 / 9.80665 for each in made.results], rtol=1e-3)
    told = content(path, "Points2D:labels")["/errors/p/told"][None]
    assert told[0].startswith("p = ") and float(told[0][4:]) < 1e-20
    steps = content(path, "Points2D:positions", improvement.STEP)["/explorer/a2/residuals"]
    panels = improvement._explorer(made)
    for step, ratios in enumerate(made.ratios):
        np.testing.assert_allclose(values_at(panels[1], steps[step])[:, 1], ratios[:, 1], atol=1e-3)
    words = content(path, "TextDocument:text", improvement.STEP)["/summary"]
    assert "hysteresis added" in words[1][0] and "first model" in words[0][0]
    h2 = improved.result.parameters["h2"]
    value = values_at(improvement._coefficient_charts(made)[1], points["/coefficients/1/value"][None])
    assert h2.value is not None
    np.testing.assert_allclose(value, [[1.0, h2.value * h2.per_si]], rtol=1e-3)


def test_p_that_underflows_is_a_bound(found: Diagnosis) -> None:
    lost = improvement.View.of(Improvement(replace(found, test=replace(found.test, misfit_p=0.0))))
    assert lost.p_values[0] == 1e-300
    chance = improvement._chance_chart(lost)
    assert 0.0 < chance.y.low < 1e-300 and len(chance.y.ticks(6)) >= 2


def test_a_comparison_shows_differences_by_orientation(tmp_path: Path) -> None:
    compared = compare(RECORDINGS / "mems_faces.mcap")
    path = view.save(compared, tmp_path / "compared.rrd")
    apart = np.abs(compared.running_sigma["batch"])
    points = content(path, "Points2D:positions")
    charts = comparison._charts(compared, np.arange(1, 7), apart)
    known = np.flatnonzero(apart[:, 6] > 0.0)
    drawn = values_at(charts[1], points["/apart/2/2/points"][None])
    np.testing.assert_allclose(drawn, np.column_stack([known + 1, apart[known, 6]]), rtol=1e-3)


def test_what_has_no_view_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no Rerun view of int"):
        view.save(3, tmp_path / "x.rrd")


def test_a_live_run_shows_targets_and_where_to_go(tmp_path: Path) -> None:
    session, told = Session(Recording(RECORDINGS / "mems_faces.mcap"), wanted={"K1": 1e-5}), list[Judgement]()
    session.listeners.append(told.append)
    session.run()
    judgement = next(each for each in told[::-1] if each.next_orientation is not None)
    stream = new_stream()
    encoded = stream.binary_stream()
    view.grow(judgement.result, stream, 0, True, judgement)
    path = tmp_path / "live.rrd"
    path.write_bytes(encoded.read() or b"")
    assert "target" in content(path, "Points2D:labels")["/sigmas/curves/texts"][None]
    going = judgement.next_orientation
    assert going is not None
    arrow = content(path, "Arrows3D:vectors")["/platform/next"][None][0]
    force = judgement.result.bench.specific_force(np.zeros(1), np.radians([going[0]]))[0]
    np.testing.assert_allclose(arrow, 1.25 * force / np.linalg.norm(force), atol=1e-6)
    assert judgement.verdict in content(path, "TextDocument:text")["/summary"][None][0]


@pytest.mark.draws
def test_the_file_of_a_run_that_goes_on_opens(tmp_path: Path) -> None:
    """As it is where the program was killed."""
    growing = GrowingView(tmp_path / "live.rrd", None)
    for count in (8, 16):
        growing.offer(run("hidden", left_out=tuple(range(count + 1, 25))))
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline and (growing._results.qsize() or not growing.began):
        time.sleep(0.05)
    before = -1
    while (size := (tmp_path / "live.rrd").stat().st_size) != before:
        before = size
        time.sleep(1.0)
    copy = tmp_path / "killed.rrd"
    copy.write_bytes((tmp_path / "live.rrd").read_bytes())
    assert copy.read_bytes().count(b"RRF2") == 1
    screenshot(copy, tmp_path / "x.png", (800, 600))
    growing.close()
    assert not growing.trouble


@pytest.mark.draws
def test_no_panel_complains(found: Diagnosis, improved: Improvement, tmp_path: Path) -> None:
    for result in (found, improved):
        with viewer(view.save(result, tmp_path / "x.rrd"), (1200, 700)) as client:
            client.take_screenshot()
            state = client.get_state()
        assert [(each.name, report.summary) for each in state.views for report in each.reports] == []
