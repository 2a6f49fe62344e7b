"""Figures of runs, comparisons, plans and the paper's experiment: what they draw is what the results say."""

import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.paths import ROOT
from helpers.synthetic import Run
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread

import kf_calib
from kf_calib import plot
from kf_calib.bench.bench import Bench
from kf_calib.design import optimality_criteria
from kf_calib.design.exact_design import Search
from kf_calib.design.gimbal_limits import GimbalLimits, Timing
from kf_calib.design.orientation_plan import Plan
from kf_calib.design.orientation_plan import plan as planned
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import Comparison, compare
from kf_calib.estimation.filter_history import history_of, innovation_tests
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import PRIORS, Settings
from kf_calib.reproduction import figures as paper
from kf_calib.reproduction.grebenkin2019 import OPTIMAL_PRINTED, Experiment, printed_column, repeat
from kf_calib.views.figures.style import blank, content_of, styled, ticks
from kf_calib.views.notation import label, written

HIDDEN = ROOT / "recordings" / "hidden.mcap"
MICRO_G = 1.0 / 9.80665e-6
ARCSEC = np.degrees(3600.0)
ONE_AXIS = np.radians([[0.0, 0.0, angle] for angle in (0, 30, 70, 110, 200, 300)])
ODD: dict[str, Callable[[], Calibration]] = {
    "one dwell": lambda: calibrate(Run(dwells=1, count=60), Settings(prior=PRIORS["navigation"])),
    "four dwells, nothing to judge by": lambda: calibrate(Run(dwells=4, count=60)),
    "one axis, not all determined": lambda: calibrate(Run(count=60, poses=ONE_AXIS)),
    "a walk, dwells left out": lambda: calibrate(
        Run(dwells=8, count=60), Settings(walk_mps2_per_sqrt_s=1e-5, left_out=(3, 8))
    ),
    "an effect that is not determined": lambda: calibrate(HIDDEN, Settings(effects=("hysteresis", "thermal-bias"))),
}


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(HIDDEN, Settings(effects=("hysteresis",)))


@pytest.fixture(scope="module")
def compared() -> Comparison:
    return compare(Run(seed=5, dwells=9, count=80, setting_deg=0.01))


@pytest.fixture(scope="module")
def made() -> Plan:
    bench = Bench.from_metadata({"axes": "y z x", "gravity_mps2": "9.81"})
    wanted = np.full(12, np.inf)
    wanted[2::4] = 4e-7
    search = Search(
        PredictedInformation.of_bench(bench, 1e-4, 1000, 30.0), GimbalLimits(bench), optimality_criteria.minimax(wanted)
    )
    return planned(search, 6, Timing(30.0, 20.0))


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return repeat(repetitions=3)


def panels(figure: Figure) -> list[Axes]:
    """All axes that show something, those of parts of the figure, too."""
    return [axes for axes in figure.get_axes() if axes.axison]


def titled(figure: Figure, words: str) -> Axes:
    """The panel whose title, or y label, begins with these words."""
    return next(each for each in panels(figure) if words in (each.get_title("left") + each.get_ylabel()))


def written_in(figure: Figure) -> list[str]:
    return [text.get_text() for axes in figure.get_axes() for text in axes.texts]


@pytest.mark.parametrize("name", ["compared", "experiment", *slow("result", "made")])
def test_every_figure_has_ink_units_and_nothing_cut_off(name: str, request: pytest.FixtureRequest) -> None:
    found = plot.figures(request.getfixturevalue(name))
    assert len(found) >= 2
    for title, draw in found.items():
        figure = draw()
        pixels = imread(io.BytesIO(content_of(figure, "png", 60.0)))
        assert pixels[..., :3].std() > 0.03, title
        assert (pixels[[0, -1]] == 1.0).all() and (pixels[:, [0, -1]] == 1.0).all(), f"{title}: cut off at an edge"
        for axes in panels(figure):
            assert axes.has_data() or axes.texts, (title, axes.get_title("left"))


def test_residuals_of_what_is_no_diagnosis_are_refused_in_words(result: Calibration) -> None:
    with pytest.raises(TypeError, match="not of a Calibration: give what diagnose returns"):
        kf_calib.plot.residuals(result)  # type: ignore[arg-type]


def test_sigmas_are_those_of_the_run_and_the_largest_is_named(result: Calibration) -> None:
    figure, history = plot.convergence(result), history_of(result)
    shown = [each for each in figure.get_axes() if each.get_yscale() == "log"]
    scales = [*[ARCSEC, ARCSEC, 1e6, MICRO_G] * 3, *[MICRO_G] * 3]
    lines = [line for axes in (*sorted(shown[:12], key=lambda each: _place(each)), shown[12]) for line in axes.lines]
    assert len(lines) == 15
    for k, (line, scale) in enumerate(zip(lines, scales, strict=True)):
        assert line.get_xdata() == pytest.approx(history.numbers)
        assert np.allclose(line.get_ydata(), history.sigmas[:, k] * scale, equal_nan=True)
    named = [text for text in written_in(figure) if "largest of its kind" in text]
    sigma = result.estimate.sigma
    places = [np.argmax(np.where(np.arange(12) % 4 == kind, sigma, 0.0)) for kind in (2, 3)]
    symbols = ("theta1", "phi1", "K1", "b1", "nu1", "nu2", "K2", "b2", "theta3", "phi3", "K3", "b3")
    assert len(named) == 3 and all(any(label(symbols[k]) in text for text in named) for k in places)
    assert any(re.search(rf"{label('K1')}  0\.\d+ ppm", text) for text in written_in(figure))


def _place(axes: Axes) -> tuple[int, int]:
    """Column and row of a panel in its grid."""
    spec = axes.get_subplotspec()
    assert spec is not None
    return spec.colspan.start, spec.rowspan.start


def test_innovations_and_nis_are_those_of_the_run() -> None:
    result = calibrate(HIDDEN)
    figure, tests = plot.convergence(result), innovation_tests(result)
    nis, ratios = titled(figure, "NIS:"), titled(figure, "Innovations")
    drawn = {int(x): y for line in nis.lines[1:] for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)}
    assert drawn == {n: v for n, v, dof in zip(tests.numbers.tolist(), tests.nis, tests.dof, strict=True) if dof > 0}
    assert nis.get_title("left") == f"NIS: {tests.high.sum()} of {len(drawn)} dwells above the band"
    values = np.array([line.get_ydata() for line in ratios.lines[3:]]).T
    assert np.allclose(values, tests.ratios, equal_nan=True)


def test_shares_of_information_add_up_to_the_whole(result: Calibration) -> None:
    figure = plot.information(result)
    means = [np.sum(line.get_ydata()) for line in titled(figure, "Share").lines[1:]]
    assert means == pytest.approx([100.0] * 3)
    mesh = titled(figure, "The same").collections[0]
    assert np.asarray(mesh.get_array()).reshape(15, -1).sum(axis=1) == pytest.approx([100.0] * 15)


def test_correlations_are_drawn_where_there_are_any(result: Calibration) -> None:
    assert "−.70" in written_in(plot.correlations(result)), "of K1 and h1"
    (said,) = written_in(plot.correlations(calibrate(HIDDEN)))
    assert said.startswith("All correlations of parameters are smaller than 0.3: the largest")


def test_directions_are_where_gravity_was_and_point_up_for_what_is_too_large() -> None:
    result = calibrate(HIDDEN)
    first = plot.directions(result).get_axes()[0]
    up, down = first.collections
    signs = result.residuals_mps2[:, 0] >= 0.0
    assert (len(up.get_offsets()), len(down.get_offsets())) == (signs.sum(), (~signs).sum())
    force = np.array([dwell.means[1:4] for dwell in result.fit.dwells])[signs]
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    assert np.asarray(up.get_offsets())[:, 1] == pytest.approx(np.arcsin(unit[:, 1]), abs=1e-5)


def test_engines_and_costs_are_those_of_the_comparison(compared: Comparison) -> None:
    figure = plot.three_ways(compared)
    lines = {line.get_label().split(":")[0]: line for line in titled(figure, "largest difference").lines}
    for name, words in (("filterpy", "filterpy"), ("batch", "batch least squares")):
        expected = np.nanmax(np.abs(compared.running_sigma[name][3:]), axis=1)
        assert np.asarray(lines[words].get_ydata())[3:] == pytest.approx(expected)
    bars = [bar.get_width() for bar in titled(figure, "Time").patches]
    assert bars == [way.wall_s for way in compared.ways.values()]
    assert [bar.get_width() for bar in titled(figure, "Peak").patches] == [w.peak_mb for w in compared.ways.values()]


def test_allan_deviation_is_in_micro_g_of_seconds(compared: Comparison) -> None:
    allan = compared.allan
    assert allan is not None
    first = plot.allan_deviation(compared).get_axes()[0]
    white, readings = first.lines[0], first.containers[0].lines[0]
    assert readings.get_xdata() == pytest.approx(allan.tau_s)
    assert readings.get_ydata() == pytest.approx(allan.deviation_mps2[:, 0] / 9.80665e-6)
    assert white.get_ydata() == pytest.approx(allan.white_mps2[:, 0] / 9.80665e-6)
    assert (first.get_xlabel(), first.get_ylabel()) == ("length of a cluster τ, s", "Allan deviation, µg")


def test_a_plan_shows_its_sigmas_and_targets(made: Plan) -> None:
    figure = plot.plan(made)
    axes = next(each for each in figure.get_axes() if "scale factor" in each.get_xlabel())
    ends = [bar.get_x() + bar.get_width() for bar in axes.patches]
    assert ends == pytest.approx(made.sigma[-1, 2:12:4] * 1e6)
    assert [line.get_xdata()[0] for line in axes.lines] == pytest.approx([0.4] * 3)
    assert made.targets[2] == 4e-7 and np.isinf(made.targets[3])
    curves = plot.predicted_sigmas(made).get_axes()
    assert any(np.allclose(line.get_ydata(), made.sigma[:, 2] * 1e6, equal_nan=True) for axes in curves
               for line in axes.lines if len(line.get_ydata()) == 7)  # fmt: skip


def test_a_plan_for_all_parameters_alike_has_no_targets() -> None:
    assert all(aim.tolerated is None for aim in optimality_criteria.NAMED.values())


def test_table_2_has_the_printed_figures(experiment: Experiment) -> None:
    (axes,) = paper.table2(experiment).get_axes()
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert lines["optimal: printed in the paper"] == pytest.approx(printed_column(OPTIMAL_PRINTED))
    assert lines["non-optimal: filter, here"] == pytest.approx(experiment.nonoptimal.kalman)


def test_design_matrices_have_rows_of_plus_and_minus_g_in_the_optimal_set(experiment: Experiment) -> None:
    """Each reading of the optimal set has gravity along one axis of the platform; only the Earth turns it elsewhere."""
    optimal, others = np.split(np.array([axes.get_images()[0].get_array() for axes in
                                         paper.design_matrices(experiment).get_axes()[:6]]), 2)  # fmt: skip
    assert optimal.shape == (3, 400, 4)
    angles_and_scale = np.sort(np.abs(optimal[:, :, :3]), axis=2)
    expected = np.broadcast_to([0.0, 0.0, 1.0], angles_and_scale.shape)
    np.testing.assert_allclose(angles_and_scale, expected, atol=1e-4)  # nominal φ is not quite 0
    assert (optimal[:, :, 3] == 1.0).all() and np.ptp(others[:, :100, 1]) > 0.01


def test_sigmas_of_the_experiment_end_at_those_expected(experiment: Experiment) -> None:
    """But for the prior, which is 5e3 times wider in the optimal set."""
    first = paper.falling(experiment).get_axes()[0]
    optimal = np.asarray(first.lines[0].get_ydata())
    assert len(optimal) == 401 and optimal[-1] == pytest.approx(
        experiment.optimal.orientations.sigma[0] * ARCSEC, rel=1e-4
    )


@pytest.mark.parametrize("name", [next(iter(ODD)), *slow(*list(ODD)[1:])])
def test_odd_runs_have_all_figures(name: str) -> None:
    for draw in plot.figures(ODD[name]()).values():
        figure = draw()
        figure.draw_without_rendering()
        assert any(axes.has_data() for axes in figure.axes)


def test_a_notebook_shows_a_figure(result: Calibration) -> None:
    picture = imread(io.BytesIO(plot.convergence(result)._repr_png_()))
    assert picture.shape[1] == 80 * 11 and np.ptp(picture[..., :3]) > 0.5


def test_a_result_is_saved_as_png_svg_and_pdf_with_a_page_a_figure(run, tmp_path: Path) -> None:
    files = {kind: tmp_path / f"run.{kind}" for kind in ("png", "svg", "pdf")}
    options = [word for kind, path in files.items() for word in (f"--{kind}", path)]
    code, out, err = run("plan", "--count", 4, *options)
    assert code == 0 and err == "" and all(f"saved {path}" in out for path in files.values())
    assert files["png"].read_bytes().startswith(b"\x89PNG") and b"<svg" in files["svg"].read_bytes()
    assert len(re.findall(rb"/Type /Page\b", files["pdf"].read_bytes())) == 2


@pytest.mark.parametrize("value, text", [
    (0.05, "0.05"), (20_000.0, "20,000"), (1e-8, "10⁻⁸"), (2e-8, "2·10⁻⁸"), (1e7, "10⁷"), (0.0, "0"),
])  # fmt: skip
def test_numbers_on_axes_are_written_out(value: float, text: str) -> None:
    assert written(value) == text


@pytest.mark.parametrize("low, high", [(0.011, 0.05), (0.3, 400.0), (1e-9, 1e4), (90.0, 400.0)])
def test_a_logarithmic_axis_has_two_to_eight_labels_within_it(low: float, high: float) -> None:
    found = ticks(low, high)
    assert 2 <= len(found) <= 8 and low <= found[0] and found[-1] <= high


def test_symbols_are_the_papers_and_text_of_users_stays_as_it_is() -> None:
    assert [label(each) for each in ("theta1", "nu2", "K2_3", "h1")] == ["θ₁", "ν₂", "K2₃", "h₁"]
    with styled():
        figure = blank()
        figure.text(0.5, 0.5, "a$b$c")
    assert ">a$b$c<" in content_of(figure, "svg", letters_as="none").decode()
