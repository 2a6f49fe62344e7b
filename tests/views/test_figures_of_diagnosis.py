"""Figures of a diagnosis and of an improvement: ink in every panel, real units, and the numbers of the results."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.altered import Altered, short_run
from helpers.hidden_effects import noisy_run, noisy_source, run
from helpers.known_runs import diagnosed, hidden_diagnosed, improved
from helpers.long_runs import slow
from helpers.synthetic import Run
from matplotlib.axes import Axes
from matplotlib.container import BarContainer
from matplotlib.figure import Figure

from kf_calib import plot
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.stepwise_selection import Improvement, begin, extend, improve, undone
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.filter_history import readings_of, worst_dwell
from kf_calib.support.units import shown_in, significant
from kf_calib.views.figures.style import label_ticks, ticks, wrapped

MICRO_G = 9.80665e-6


def panels(figure: Figure) -> list[Axes]:
    """Arranged and with its words in their places, without a pixel drawn; what has been so stays so."""
    if figure.stale:
        figure.draw_without_rendering()
    return figure.get_axes()


def assert_ink(figure: Figure) -> None:
    """Every panel holds data or words, none of its words are cut off by the edge, and every axis has a quantity."""
    width, height = figure.canvas.get_width_height()
    for axes in panels(figure):
        shown = axes.has_data() or axes.texts or axes.get_title("left") or axes.collections
        assert shown or not axes.axison, axes  # the last row may have places that nothing fills
        words = [axes.title, axes._left_title, axes._right_title, axes.xaxis.label, axes.yaxis.label, *axes.texts]  # type: ignore[attr-defined]
        for text in (each for each in words if each.get_text() and each.get_visible() and axes.axison):
            box = text.get_window_extent()
            assert box.x0 > -2 and box.x1 < width + 2 and box.y0 > -2 and box.y1 < height + 2, text.get_text()


def axes_of(figure: Figure, title: str) -> Axes:
    return next(axes for axes in panels(figure) if axes.get_title("left").startswith(title))


@pytest.mark.parametrize("hidden", [
    ("triple-product=25sigma",),
    *slow(
        ((),), (("second-order=15sigma",),), (("bias-drift=15sigma",),), (("sinusoid=30sigma",),),
        (("second-order=15sigma", "hysteresis=15sigma"),),
    ),
])  # fmt: skip
def test_every_figure_of_a_diagnosis_has_ink_in_every_panel(hidden: tuple[str, ...]) -> None:
    for title, draw in plot.figures(diagnosed(*hidden)).items():
        figure = draw()
        assert_ink(figure)
        assert len(figure.get_axes()) >= 1, title


@pytest.mark.slow
def test_bars_of_suspects_are_their_shares_and_those_that_do_not_fit_are_hatched() -> None:
    explained = hidden_diagnosed().explanations
    figure = plot.suspects(hidden_diagnosed())
    axes = axes_of(figure, "What each explains")
    bars = [bar for container in axes.containers if isinstance(container, BarContainer) for bar in container]
    assert [bar.get_width() for bar in bars] == pytest.approx([100.0 * each.share for each in explained])  # type: ignore[operator]
    assert [bar.get_hatch() is None for bar in bars] == [each.fits for each in explained]
    assert [label.get_text() for label in axes.get_yticklabels()] == [each.name for each in explained]
    said = [text.get_text() for text in axes.texts]
    assert said[0].startswith("fits, p = 7.9e-30")
    assert said[1].startswith("fits, p =" if explained[1].fits else "does not fit, p =")
    assert axes.get_xlabel().endswith("%")


@pytest.mark.parametrize("hidden", [("triple-product=25sigma",), *slow(((),))])
def test_bars_of_probabilities_are_those_of_the_table(hidden: tuple[str, ...]) -> None:
    table = diagnosed(*hidden).table
    assert table is not None
    families, explanations = panels(plot.hypotheses(diagnosed(*hidden)))
    widths = [patch.get_width() for patch in families.patches]  # type: ignore[attr-defined]
    assert widths[0] == pytest.approx(100.0 * next(iter(table.families.values())))
    names = [label.get_text() for label in explanations.get_yticklabels()]
    assert len(names) == len(table.listed) + 1 and names[-1].endswith(("other", "others"))
    area = sum(patch.get_width() * patch.get_height() for patch in explanations.patches)  # type: ignore[attr-defined]
    assert area == pytest.approx(100.0)  # the rows sum to one, whatever families they belong to


@pytest.mark.parametrize(
    "hidden", [("triple-product=25sigma",), *slow((("second-order=15sigma", "hysteresis=15sigma"),))]
)
def test_cells_of_the_matrix_are_overlaps_and_a_walk_that_takes_any_path_has_none(hidden: tuple[str, ...]) -> None:
    diagnosis = diagnosed(*hidden)
    axes = axes_of(plot.suspects(diagnosis), "Overlap")
    names = [label.get_text() for label in axes.get_yticklabels()]
    test = diagnosis.test
    assert len(names) >= 2 and test.effects.walk not in names
    cells = {tuple(int(x) for x in text.get_position()): text.get_text() for text in axes.texts}
    for row, one in enumerate(names):
        for column, other in enumerate(names):
            overlap = test.effects.candidate(one).overlap(test.effects.candidate(other))
            assert cells[column, row] == f"{overlap:.2f}"


def test_separation_is_that_of_the_advice() -> None:
    going = hidden_diagnosed().next_orientation
    assert going is not None
    axes = axes_of(plot.suspects(hidden_diagnosed()), "Next: gimbals at")
    bars = [bar.get_width() for container in axes.containers for bar in container]
    assert bars == pytest.approx([going[0].before, going[0].after])
    assert all(f"{angle:g}" in axes.get_title("left") for angle in going[0].gimbal_deg)


def test_what_could_hide_names_every_effect_once() -> None:
    diagnosis = hidden_diagnosed()
    figure = plot.detection_limits(diagnosis)
    first, second, below = panels(figure)
    rows = [label.get_text() for axes in (first, second) for label in axes.get_yticklabels()]
    assert sorted(rows) == sorted(each.name for each in diagnosis.detectable)
    text = " ".join(below.texts[0].get_text().split())
    assert all(name in text and why in text for name, why in ((each.name, each.why) for each in diagnosis.unseen))
    assert [label.get_text() for label in first.get_xticklabels()] == ["0.01", "0.1", "1", "10", "100", "1,000"]
    sizes = {each.name: each for each in diagnosis.detectable}
    ends = {round(bar.get_y() + 0.5 * bar.get_height()): bar.get_x() + bar.get_width() for bar in second.patches}
    for k, label in enumerate(second.get_yticklabels()):
        each = sizes[label.get_text()]
        usual = each.typical.of(diagnosis.grade)
        assert (k in ends) == (usual is not None)
        if usual is not None:
            assert ends[k] == pytest.approx(min(usual[1] / each.minimum, 1000.0))


@pytest.mark.slow
def test_residuals_of_single_dwells_are_drawn_in_micro_g_or_si() -> None:
    diagnosis = hidden_diagnosed()
    figure = plot.residuals(diagnosis)
    with shown_in("si"):
        words = panels(plot.residuals(diagnosis))
    assert (words[0].get_ylabel(), words[-1].get_xlabel()) == (
        "accelerometer 1, m/s^2", "last step along the input axis, m/s^2")  # fmt: skip
    first = panels(figure)[0]
    drawn = first.containers[0].lines[0].get_ydata()  # type: ignore[union-attr]
    assert np.asarray(drawn) == pytest.approx(diagnosis.before.residuals_mps2[:, 0] / MICRO_G)
    assert first.get_ylabel() == "accelerometer 1, µg"
    assert panels(figure)[-1].get_xlabel() == "last step along the input axis, g"
    rms = np.sqrt(np.mean(diagnosis.before.residuals_mps2[:, 0] ** 2)) / MICRO_G
    assert first.get_title("right") == f"rms {rms:#.2g} µg"


def headings(figure: Figure) -> list[list[str]]:
    """The lines above the columns of an improvement."""
    return [axes.get_title("left").split("\n") for axes in panels(figure) if axes.get_title("left")]


@pytest.mark.slow
def test_errors_fall_in_the_figure_as_in_the_result() -> None:
    state = improved("second-order=15sigma")
    figure = plot.improvement(state)
    assert_ink(figure)
    results = [state.start.before, *(step.result for step in state.steps)]
    start, added, effect = headings(figure)
    assert (start[0], added[0], effect[0]) == ("0: start", "1: + second-order", "second-order")
    for result, (_, error, p_value) in zip(results, (start, added), strict=True):
        rms, floor = result.held_out_rms_mps2 or 0.0, state.floor_mps2 or 1.0
        assert error == f"held out {rms / MICRO_G:.3g} µg = {rms / floor:.2f} × noise" and p_value.startswith("p ")
    below = axes_of(figure, "second-order")
    middles = [container.lines[0].get_xdata()[0] for container in below.containers[1::2]]  # type: ignore[union-attr]
    parameters = [state.result.parameters[f"K2_{i}"] for i in (1, 2, 3)]
    assert middles == pytest.approx([(p.value or 0.0) * p.per_si for p in parameters])
    left, right = below.get_xlim()
    assert left < 0.0 < right and below.get_xlabel() == "coefficient ± 1σ and 2σ, µg/g²"


@pytest.mark.slow
def test_undone_steps_and_choices_left_open_have_columns() -> None:
    refits = Refits()
    state = extend(begin(run("bias-drift=15sigma"), refits), refits, ("second-order",), "user")
    state = undone(state, refits)
    figure = plot.improvement(state)
    assert_ink(figure)
    words = [" ".join(lines[:2]) for lines in headings(figure)]
    assert words[1].startswith("1: + second-order (undone)")
    chosen = [f"{k}: + {each.name}?" for k, each in enumerate(state.alternatives, start=2)]
    assert all(word.startswith(text) for word, text in zip(words[2:], chosen, strict=True))


@pytest.mark.parametrize("made", [
    lambda: begin(calibrate(Run(seed=1, dwells=4, count=100)), Refits()),
    *slow(lambda: begin(run(), Refits()), lambda: improve(noisy_run(walk_mps2_per_sqrt_s=3e-6, seed=4))),
])  # fmt: skip
def test_odd_improvements_are_drawn(made: object) -> None:
    """Consistent at once, no degrees of freedom, a walk."""
    state = made()  # type: ignore[operator]
    assert isinstance(state, Improvement)
    for draw in plot.figures(state).values():
        assert_ink(draw())


def test_residuals_of_each_step_share_their_axes() -> None:
    state = improved("second-order=15sigma")
    axes = panels(plot.improvement(state))[:-1]
    assert len(axes) == 3 * (1 + len(state.steps))
    assert len({each.get_ylim() for each in axes}) == len({each.get_xlim() for each in axes}) == 1
    drawn = [np.asarray(each.lines[-1].get_ydata(), float) for each in axes]
    before, after = (np.sqrt(np.mean(np.square(drawn[k::2]))) for k in (0, 1))
    assert after < 0.5 * before and after < 1.3


def test_readings_of_a_dwell_have_the_mean_of_its_residual(tmp_path: Path) -> None:
    source = Run(seed=2, count=500, batch=700)
    result = calibrate(source)
    number = worst_dwell(result)
    readings = readings_of(source, result, number)
    k = [visit.dwell.number for visit in result.visits].index(number)
    assert readings.every == 1 and len(readings.time_s) == result.visits[k].dwell.count
    assert readings.differences_mps2.mean(axis=0) == pytest.approx(result.visits[k].residual_mps2, abs=1e-12)
    some = readings_of(source, result, number, most=100)
    assert len(some.time_s) <= 100 and some.every == -(-readings.count // 100)
    assert np.array_equal(some.differences_mps2, readings.differences_mps2[:: some.every])
    figure = plot.dwell(source, result)
    assert_ink(figure)
    assert f"Dwell {number}, reading by reading" in panels(figure)[0].get_title("left")
    with pytest.raises(InputError, match="there is no dwell 99"):
        plot.dwell(source, result, 99)


SLIPPED, SLIP_MPS2 = 9, np.array([0.02, -0.01, 0.3])


def slipped() -> Altered:
    """A run in whose dwell 9 something slips halfway: the readings are others from there to the end of the dwell."""
    made = short_run(dwell_s=12.0)
    arrival_s, leave_s = (float(at[SLIPPED - 1]) * 1e-9 for at in (made.motion.arrive_ns, made.motion.leave_ns))

    def readings(time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
        late = (time_s > 0.5 * (arrival_s + leave_s)) & (time_s < leave_s + 0.1)
        return values + late[:, None] * SLIP_MPS2

    return Altered(made, readings)


@pytest.mark.slow
def test_a_disturbed_dwell_is_drawn_reading_by_reading_from_its_arrival_on() -> None:
    diagnosis = diagnose(slipped())
    title, draw = next(iter(plot.figures(diagnosis).items()))
    assert title == f"Dwell {SLIPPED}, reading by reading" and diagnosis.disturbed_dwell == SLIPPED
    readings = diagnosis.disturbed_readings
    assert readings is not None and readings.left_out
    jump = np.diff([half.mean(axis=0) for half in np.array_split(readings.differences_mps2, 2)], axis=0)[0]
    assert jump == pytest.approx(SLIP_MPS2, rel=0.1, abs=2e-3), "both halves are there"
    used = readings.time_s >= readings.start_s - 1e-9
    assert not used.all() and readings.differences_mps2[used].mean(axis=0) == pytest.approx(
        readings.mean_mps2, abs=1e-9
    )
    assert_ink(draw())
    where = plot.residuals(diagnosis)
    marked = [text for axes in panels(where) for text in axes.texts if text.get_text() == f"dwell {SLIPPED}"]
    assert len(marked) == 3 and panels(where)[-1].get_xlabel().startswith("time, ")
    with pytest.raises(InputError, match="no readings of a disturbed dwell"):
        plot.disturbed_dwell(replace(diagnosis, disturbed_readings=None))


@pytest.mark.parametrize(("hidden", "words"), [
    ("memory=40sigma", "force along the input axis less what is remembered"),
    *slow(
        ("thermal-lag=60sigma", "temperature through the fitted lag, less 25 °C"),
        ("thermal-hysteresis=40sigma", "temperature through the fitted play, less 25 °C"),
    ),
])  # fmt: skip
def test_an_effect_with_a_constant_of_its_own_is_a_line_over_what_the_fit_made_of_it(hidden: str, words: str) -> None:
    before = run(hidden)
    after = Refits().with_effects(before, (hidden.partition("=")[0],))
    (shape,) = Explanation((hidden.partition("=")[0],), before, after).shapes
    assert shape.words == words and shape.is_curve
    for values, component in zip(shape.values.T, shape.component.T, strict=True):
        line = np.polyval(np.polyfit(values, component, 1), values)
        assert np.abs(component - line).max() < 1e-3 * np.ptp(component)


@pytest.mark.slow
def test_what_the_verdict_does_not_name_has_no_picture() -> None:
    """Dwells that scatter: the likeliest effect is in the list of suspects, and not what the residuals are drawn as."""
    diagnosis = diagnose(noisy_source(scatter_mps2=3e-5, states={"scatter_sigma_mps2": 0.0}))
    assert diagnosis.test.consistent is False and not diagnosis.missing
    assert diagnosis.explanation is None and diagnosis.explanations
    titles = [axes.get_title("left") for axes in panels(plot.residuals(diagnosis))]
    assert titles[0] == "Residuals of twelve parameters" and not any("must explain" in title for title in titles)


@pytest.mark.slow
def test_bars_of_noise_alone_stand_before_those_of_the_scatter_that_was_estimated() -> None:
    diagnosis = diagnose(noisy_source("second-order=60sigma", scatter_mps2=3e-5, states={"scatter_sigma_mps2": None}))
    shape = diagnosis.explanations[0].shapes[0]
    assert np.median(shape.bars[1] / shape.bars[0]) > 3.0
    figure = plot.residuals(diagnosis)
    bars = [np.ptp(np.array(each.get_segments())[:, :, 1], axis=1) for each in panels(figure)[0].collections]
    pale, alone = bars[0] / 2.0 * MICRO_G, bars[1] / 2.0 * MICRO_G
    assert (alone, pale) == (pytest.approx(shape.bars[0][:, 0]), pytest.approx(shape.bars[1][:, 0]))
    said = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert "1σ with the scatter that was estimated" in said


def test_the_sphere_shows_every_dwell_before_and_after() -> None:
    diagnosis = hidden_diagnosed()
    figure = plot.on_the_sphere(diagnosis)
    maps = [axes for axes in panels(figure) if axes.name == "mollweide"]
    assert len(maps) == 6
    for axes in maps:
        assert sum(len(each.get_offsets()) for each in axes.collections) == len(diagnosis.before.visits)
    drawn = np.concatenate([np.asarray(each.get_array()) for each in maps[0].collections])
    assert sorted(drawn) == pytest.approx(sorted(diagnosis.residual_ratios[:, 0]))
    assert figure.get_axes()[-1].get_ylabel() == "residual / σ"


def test_decades_are_labelled_with_their_values() -> None:
    axes = Figure().subplots()
    axes.set_yscale("log")
    axes.set_ylim(0.03, 400.0)
    label_ticks(axes.yaxis, ticks(0.03, 400.0))
    axes.figure.canvas.draw()
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0.1", "1", "10", "100"]


def test_words_of_effects_stay_whole() -> None:
    assert wrapped("second-order + cross-coupling-ip", 16) == "second-order +\ncross-coupling-ip"
    assert significant(11234567.0) == "11200000" and significant(0.0012345, 2) == "0.0012"
    assert significant(0.13, zeros=True) == "0.130" and significant(0.0, zeros=True) == "0"
