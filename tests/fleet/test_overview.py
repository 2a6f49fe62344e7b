"""Many runs together: the command's last word, the page and the figures, and what is said where something lacks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fleet_overviews import BENT, overview_with, rows_of
from helpers.fleet_workers import recorded
from helpers.run_factors import run_factor_of

import kf_calib
from kf_calib.estimation import bench_model
from kf_calib.fleet.overview import overview_of
from kf_calib.fleet.page import fleet_page
from kf_calib.fleet.pooled_diagnosis import pooled_diagnosis
from kf_calib.fleet.text import short_name
from kf_calib.views.figures import figures

pytestmark = [pytest.mark.xdist_group("fleet"), pytest.mark.usefixtures("at_once")]


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of three units on a bench that bends by more than each run alone could miss."""
    return recorded(tmp_path_factory.mktemp("bent"), runs=3, units=3, dwells=9, of_bench=("flexure=8sigma",))


@pytest.mark.slow
def test_the_command_ends_with_what_all_runs_show_together(bent: Path, run: Any, tmp_path: Path) -> None:
    printed = run.json("fleet", bent, "-o", tmp_path / "fleet")
    first, *others = printed["pooled"]
    assert (first["effect"], first["borne_by"]) == ("flexure", "bench") and first["probability"] > 0.9
    assert [each["of"] for each in first["coefficients"]] == ["bench-1"] * 3
    assert {each["borne_by"] for each in others} <= {"none", None} and printed["remarks"] == []
    (model,) = printed["bench_models"]
    known = bench_model.read_bench_model(model)
    assert (known.bench, known.runs, known.terms[0].effect) == ("bench-1", 3, "flexure")
    one = next(bent.rglob("*.mcap"))
    rows = kf_calib.open_fleet(tmp_path / "fleet").rows(["run", "diagnosis"]).to_pylist()
    (alone,) = (row["diagnosis"] for row in rows if row["run"] == str(one))
    with_model = run.json("diagnose", one, "--bench-model", model)
    assert json.loads(alone)["p_value"] < 1e-3 < 0.01 < with_model["p_value"]
    assert kf_calib.open_fleet(tmp_path / "fleet").pooled().findings[0].effect == "flexure"
    Path(model).write_text("# mine\n")
    code, out, err = run("fleet", bent, "-o", tmp_path / "fleet")
    assert code == 2 and "show flexure" in out and f"{model} is not as kf-calib fleet wrote it, and was left" in err


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--no-pooled"], []),
        ([], ["the runs were not diagnosed together: that needs two that did not fail, and there is 1."]),
    ],
)
def test_what_is_lacking_is_said(bent: Path, run: Any, tmp_path: Path, given: list[str], says: list[str]) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_text("no recording")
    runs = [next(bent.rglob("*.mcap")), bad]
    printed = run.json("fleet", *runs, "-o", tmp_path / "fleet", *given)
    assert (printed["pooled"], printed["bench_models"], printed["remarks"]) == (None, [], says)
    assert {"unit": str(bad), "chance": 0.0, "reasons": ["bad.mcap failed"]} in printed["another_look"]


def test_a_unit_goes_by_its_name_or_that_of_its_recording() -> None:
    assert list(map(short_name, ("lab/7", "/lab/7.mcap", "s3://lab/7.mcap"))) == ["lab/7", "7.mcap", "7.mcap"]


def test_a_unit_outside_the_population_is_named_first() -> None:
    found = overview_with(outlying=7)
    assert [look.unit for look in found.looks] == ["unit07"] and "b1 is" in found.looks[0].reasons[0]
    assert overview_with().looks == ()
    (track,) = found.tracks
    assert track.scatter == pytest.approx(1e-6, rel=0.4)  # of single runs, about the mean of two
    assert len(found.weeks.begins) == 40 and found.weeks.counts == {"consistent": (1,) * 40}


def test_units_of_a_bench_that_was_repaired_are_counted_once() -> None:
    def hidden(number: int) -> dict[str, Any]:
        own = {"second-order": np.array([8.0, -8.0, 8.0])} if number % 10 < 4 else {}
        return own | ({"flexure": 2.0 * BENT} if number < 15 else {})

    runs = [run_factor_of(k, hidden, unit=f"unit{k % 10}") for k in range(30)]
    some = next(each for each in pooled_diagnosis(runs).findings if each.effect == "second-order")
    assert sorted(each.unit for each in some.units) == [f"unit{k}" for k in range(10)]


def test_a_control_chart_has_shewharts_limits_from_the_standard_deviation_pooled_over_the_units() -> None:
    rows = rows_of(20, outlying=3)
    rows[5]["parameters"][0]["value"] += 2e-5
    chart = figures(overview_of("fleet", rows, {}, None, ()))["Control charts"]().axes[0]
    values = np.array([row["parameters"][0]["value"] for row in rows]).reshape(2, 20)  # a unit a column
    pooled = np.sqrt(np.mean(np.var(values, axis=0, ddof=1)))
    micro_g = 9.80665e-6
    heights = {line.get_label(): abs(line.get_ydata()[0]) for line in chart.lines}  # type: ignore[index]
    assert heights["control limit, 3σ"] == pytest.approx(3.0 * pooled / micro_g, rel=1e-9)
    assert heights["warning limit, 2σ"] == pytest.approx(2.0 * pooled / micro_g, rel=1e-9)
    limits = sorted(text.get_text().replace("−", "-").split() for text in chart.texts)
    assert [name for name, _ in limits] == ["LCL", "UCL"]
    assert [float(value) for _, value in limits] == pytest.approx(
        [s * 3.0 * pooled / micro_g for s in (-1, 1)], rel=5e-3
    )
    (outside,) = (line for line in chart.lines if line.get_label() == "out of control")
    assert len(outside.get_xdata()) == 2  # type: ignore[arg-type]  # both runs of the unit that moved, one on each side


def test_runs_of_units_that_were_measured_once_scatter_about_the_mean_of_all() -> None:
    (track,) = overview_of("fleet", rows_of(12)[:12], {}, None, ()).tracks
    assert track.scatter == pytest.approx(np.std(track.values, ddof=1), rel=1e-9)


@pytest.mark.parametrize(("count", "told"), [(2, False), (3, True)])
def test_one_of_three_units_can_lie_outside_and_none_of_two(count: int, told: bool) -> None:
    rows = rows_of(count)[:count]
    rows[0]["parameters"][0]["value"] += 1.0
    (track,) = overview_of("fleet", rows, {}, None, ()).tracks
    assert (track.chances < 1.0).any() == told


def test_every_figure_and_the_page_are_drawn() -> None:
    found = overview_with(lambda number: {"flexure": BENT}, outlying=3)
    drawn = {title: draw() for title, draw in figures(found).items()}
    axes = drawn["Errors of the bench over time"].axes[0]
    assert "flexure" in axes.get_title(loc="left") and len(axes.containers) == 3
    assert "unit03" in {each.get_text() for each in drawn["Parameters over the units"].axes[0].texts}
    assert "40 of 40" in {each.get_text() for each in drawn["Sigma achieved"].axes[0].texts}
    html = fleet_page(found, ["kf-calib fleet runs -o fleet"]).html
    assert "40 runs agree with their models" in html and html.count("<svg") == len(drawn)
    assert "flexure is of the bench" in html
