"""Views of a run, of a diagnosis and of an improvement hold the numbers of their results."""

import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.known_runs import hidden_diagnosed, hidden_improved
from helpers.paths import RECORDINGS
from screenshot import screenshot, viewer

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import Session
from kf_calib.online.status import Judgement
from kf_calib.sources.files.recording import Recording
from kf_calib.support.units import shown_whole
from kf_calib.views import rerun as view
from kf_calib.views.rerun import diagnosis, improvement
from kf_calib.views.rerun.diagnosis import round_numbers
from kf_calib.views.rerun.growing import GrowingView
from kf_calib.views.rerun.names import new_stream
from kf_calib.views.rerun.series import VisitHistory, predicted
from kf_calib.views.rerun.spheres import signed


def run(name: str, *effects: str, **settings: object) -> Calibration:
    return calibrate(Recording(RECORDINGS / f"{name}.mcap"), Settings(effects=effects, **settings))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def hidden() -> Calibration:
    return run("hidden", "hysteresis")


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return hidden_diagnosed()


@pytest.fixture(scope="module")
def improved() -> Improvement:
    return hidden_improved()


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


def test_curves_of_a_run_hold_the_coefficients_of_its_effects(hidden: Calibration, tmp_path: Path) -> None:
    path = view.save_view(hidden, tmp_path / "run.rrd")
    curves = content(path, "Scalars:scalars", view.ORIENTATION)
    sigma = curves["/parameters/effects/h2/sigma"][24]
    assert sigma[0] == pytest.approx(hidden.estimate.effect_sigma[1] * 1e6 / 9.80665)
    h2 = hidden.parameters["h2"]
    assert h2.value is not None and curves["/parameters/effects/h2/deviation"][24] == pytest.approx(
        [h2.value * h2.per_si]
    )


def test_the_range_of_a_panel_holds_the_bands_of_the_last_two_thirds(hidden: Calibration) -> None:
    history = VisitHistory.of(hidden)
    for k in range(15):
        span = history.late_range(k)
        assert span is not None
        low, high = (history.deviation[:, k] + sign * history.sigma[:, k] for sign in (-1.0, 1.0))
        late = history.orientation >= 8
        assert span[0] < low[late].min() and high[late].max() < span[1] < high[late].max() + 0.2 * np.ptp(span)
    unseen = replace(history, sigma=np.full_like(history.sigma, np.nan))
    assert unseen.late_range(0) is None


def test_runs_with_little_to_judge_by_show_residuals(hidden: Calibration, tmp_path: Path) -> None:
    faces = run("mems_faces")
    assert predicted(hidden) and not predicted(faces)
    drawn = content(view.save_view(faces, tmp_path / "run.rrd"), "Scalars:scalars", view.ORIENTATION)
    ratios = faces.residuals_mps2 / mean_sigmas(faces)
    for i in range(3):
        values = drawn[f"/residual/a{i + 1}"]
        np.testing.assert_allclose([values[visit.dwell.number][0] for visit in faces.visits], ratios[:, i])


@pytest.mark.parametrize(
    ("low", "high", "numbers"),
    [
        (-2.2, 3.0, [-2, -1, 0, 1, 2, 3]),
        (-251.645, -251.495, [-251.64, -251.62, -251.6, -251.58, -251.56, -251.54, -251.52, -251.5]),
        (0.1, 7e5, [1e5, 2e5, 3e5, 4e5, 5e5, 6e5, 7e5]),
    ],
)
def test_numbers_at_an_axis_are_round(low: float, high: float, numbers: list[float]) -> None:
    np.testing.assert_allclose(round_numbers(low, high, 8), numbers, rtol=1e-12)


def test_a_diagnosis_shows_what_each_effect_must_explain_over_its_own_axis(found: Diagnosis, tmp_path: Path) -> None:
    """Places in the view are values: the numbers written at the axes say which."""
    path = view.save_view(found, tmp_path / "found.rrd")
    assert found.explanations[0].name == "hysteresis" and found.explanations[0].shapes[0].symbol == "da"
    texts, at = (content(path, f"Points2D:{what}", diagnosis.EXPLANATION) for what in ("labels", "positions"))
    for rank, each in enumerate(found.explanations[:5], 1):
        shape = each.shapes[0]
        per_si = shown_whole(shape.unit, float(np.nanmax(np.abs(shape.values)))).per_si
        for i, channel in enumerate(("a1", "a2", "a3")[: len(shape.channels)]):
            places = np.array(at[f"/driver/{channel}/numbers"][rank])[:-1]
            numbers = texts[f"/driver/{channel}/numbers"][rank][:-1]
            values = np.array([float(text.replace("−", "-")) for text in numbers])
            upward = places[:, 0] < 0.0
            to_axis, to_ratio = (np.polyfit(places[side, axis], values[side], 1)
                                 for side, axis in ((~upward, 0), (upward, 1)))  # fmt: skip
            to_ratio[1] -= 9.5 * to_ratio[0]  # a label hangs below its point
            points = np.array(at[f"/driver/{channel}/residuals"][rank])
            known = np.isfinite(shape.readings[:, i])
            readings, x = (shape.readings / shape.sigma)[known, i], shape.values[known, i] * per_si
            np.testing.assert_allclose(np.polyval(to_ratio, points[:, 1]), readings, atol=2e-3)
            np.testing.assert_allclose(np.polyval(to_axis, points[:, 0]), x, atol=2e-3 * np.ptp(x))
    curve = content(path, "LineStrips2D:strips", diagnosis.EXPLANATION)["/driver/a2/curve"][1]
    assert len(curve) == 3 and len(curve[0]) == 200  # the effect, less and plus its sigma


def test_spheres_of_a_diagnosis_show_what_each_explanation_leaves(found: Diagnosis, tmp_path: Path) -> None:
    path = view.save_view(found, tmp_path / "found.rrd")
    before = content(path, "Points3D:radii")["/spheres/before/2/residuals"][None]
    ratios = np.abs(found.before.residuals_mps2 / mean_sigmas(found.before))[:, 1]
    np.testing.assert_allclose(before, 0.03 + 0.09 * np.minimum(ratios / 4.0, 1.0), rtol=1e-5)
    left = content(path, "Points3D:radii", diagnosis.EXPLANATION)["/spheres/left/2/residuals"]
    assert np.mean(left[1]) < np.mean(before) - 0.01
    for rank, each in enumerate(found.explanations[:5], 1):
        expected = 0.03 + 0.09 * np.minimum(np.abs(each.unexplained_ratios[:, 1]) / 4.0, 1.0)
        np.testing.assert_allclose(left[rank], expected, rtol=1e-5)


def test_a_disturbed_dwell_has_a_red_ring_where_it_lies_and_the_colours_have_a_key(
    found: Diagnosis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kf_calib.views.rerun.diagnosis.disturbed_dwells", lambda diagnosis: [7])
    path = view.save_view(found, tmp_path / "view.rrd")
    force = next(visit.dwell.means[1:4] for visit in found.before.visits if visit.dwell.number == 7)
    (ring,) = content(path, "LineStrips3D:strips")["/spheres/before/1/disturbed"][None]
    middle = np.mean(np.array(ring)[:-1], axis=0)
    assert middle == pytest.approx(force / np.linalg.norm(force), abs=1e-3)
    assert content(path, "LineStrips3D:labels")["/spheres/before/1/disturbed"][None] == ["dwell 7: disturbed"]
    assert content(path, "Points3D:labels")["/spheres/key"][None] == ["−4σ", "−2σ", "0σ", "+2σ", "+4σ"]


def test_colours_of_residuals_tell_their_sign() -> None:
    blue, grey, orange = signed(np.array([-5.0, 0.0, 5.0])).astype(int)
    assert blue[2] > 200 > blue[0] and orange[0] > 200 > orange[2] and np.ptp(grey) < 10


def test_an_improvement_is_a_timeline_of_steps(improved: Improvement, tmp_path: Path) -> None:
    path = view.save_view(improved, tmp_path / "improved.rrd")
    results = [improved.start.before, improved.result]
    curves = content(path, "Scalars:scalars", improvement.STEP)
    micro_g = 1e6 / 9.80665
    for step, result in enumerate(results):
        assert result.held_out_rms_mps2 is not None
        assert curves["/error/held_out"][step] == pytest.approx([result.held_out_rms_mps2 * micro_g])
        assert curves["/error/within_run"][step] == pytest.approx([result.residual_rms_mps2 * micro_g])
    assert curves["/error/held_out"][1][0] < 0.7 * curves["/error/held_out"][0][0]
    assert curves["/log10_p/model"][0][0] < -20.0 < -2.0 < curves["/log10_p/model"][1][0]
    assert curves["/log10_p/accepted"][1] == [-2.0]
    words = content(path, "TextDocument:text", improvement.STEP)["/summary"]
    assert "hysteresis added" in words[1][0] and "first model" in words[0][0]
    h2 = improved.result.parameters["h2"]
    assert h2.value is not None and h2.sigma is not None
    assert {step: value for step, value in curves["/coefficients/h2/value"].items()} == {
        1: pytest.approx([h2.value * h2.per_si])
    }
    low, high = curves["/coefficients/h2/band"][1]
    assert (high - low) / 2.0 == pytest.approx(h2.sigma * h2.per_si)


def test_p_that_underflows_is_a_bound(found: Diagnosis) -> None:
    lost = improvement.View(Improvement(replace(found, test=replace(found.test, misfit_p=0.0))))
    assert lost.log10_p[0] == pytest.approx(-300.0)


def test_what_has_no_view_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no Rerun view of int"):
        view.save_view(3, tmp_path / "x.rrd")


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
    last = len(judgement.result.visits)
    targets = content(path, "Scalars:scalars", view.ORIENTATION)["/parameters/a1/K1/target"]
    assert targets[last] == pytest.approx([10.0])  # ppm
    going = judgement.next_orientation
    assert going is not None
    arrow = content(path, "Arrows3D:vectors")["/platform/next"][None][0]
    force = judgement.result.bench.specific_force(np.zeros(1), np.radians([going[0]]))[0]
    np.testing.assert_allclose(arrow, 1.25 * force / np.linalg.norm(force), atol=1e-6)
    assert judgement.verdict in content(path, "TextDocument:text")["/summary"][None][0]


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.draws
def test_no_panel_complains(found: Diagnosis, improved: Improvement, tmp_path: Path) -> None:
    for result in (found, improved):
        with viewer(view.save_view(result, tmp_path / "x.rrd"), (1200, 700)) as client:
            client.take_screenshot()
            state = client.get_state()
        assert [(each.name, report.summary) for each in state.views for report in each.reports] == []
