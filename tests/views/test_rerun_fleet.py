"""The Rerun view of a fleet holds the numbers of its overview, by date and by unit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fleet_overviews import BENT, overview_with, rows_of

import kf_calib
from kf_calib.fleet.overview import FleetOverview, overview_of
from kf_calib.support.units import shown
from kf_calib.views.rerun import fleet, fleet_thinned
from kf_calib.views.rerun.fleet_dates import panels_of
from kf_calib.views.rerun.fleet_units import charts_of
from kf_calib.views.screenshot import viewer

MICRO_G = shown("m/s^2").per_si


@pytest.fixture(scope="module")
def found() -> FleetOverview:
    """A bench that bends, and a unit that lies far from the others."""
    return overview_with(lambda number: {"flexure": BENT}, outlying=3)


def logged(path: Path, component: str) -> dict[str, tuple[list[Any], list[list[Any]]]]:
    """Dates and values of a component by entity; no dates where it is there for all times."""
    from rerun.chunk import RrdReader

    out = dict[str, tuple[list[Any], list[list[Any]]]]()
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            dates = batch.column("date").to_pylist() if "date" in batch.schema.names else []
            out[chunk.entity_path] = (dates, batch.column(component).to_pylist())
    return out


def test_what_is_drawn_by_date_is_what_was_found(found: FleetOverview, tmp_path: Path) -> None:
    scalars = logged(Path(kf_calib.save_view(found, tmp_path / "fleet.rrd")), "Scalars:scalars")
    (track,) = found.tracks
    dates, values = (np.array(each) for each in scalars["/control/b1/run"])
    inside = np.abs(track.deviations) <= 3.0 * track.scatter
    np.testing.assert_allclose(values[:, 0], track.deviations[inside] * MICRO_G)
    own = np.array([each.replace(tzinfo=None) for each in track.dates if each], "datetime64[ns]")
    assert (dates.astype("datetime64[ns]") == own[inside]).all()
    levels = np.array([-2.0, 2.0, -3.0, 3.0])
    np.testing.assert_allclose(scalars["/control/b1/limits"][1], [levels * track.scatter * MICRO_G] * 2)
    np.testing.assert_allclose(np.array(scalars["/control/b1/sigma"][1])[:, 1], track.sigmas * MICRO_G)
    np.testing.assert_allclose(scalars["/sigma/b1/target"][1], [[2e-6 * MICRO_G]] * 2)
    counts = [value for (value,) in scalars["/weeks/consistent"][1]]
    assert counts == [*found.weeks.counts["consistent"], found.weeks.counts["consistent"][-1]]
    (panel,) = panels_of(found)
    for k, each in enumerate(panel.whole[0].coefficients):
        own, per_si = f"/bench/flexure/bench\\ 1/{each.symbol}", shown(each.unit).per_si
        np.testing.assert_allclose(scalars[f"{own}/all"][1], [[(each.value or 0.0) * per_si]] * 2)
        parts = [part.coefficients[k] for part in panel.parts]
        np.testing.assert_allclose(scalars[f"{own}/part"][1], [[(part.value or 0.0) * per_si] for part in parts])
        reach = [[((part.value or 0.0) + 2.0 * (part.sigma or 0.0)) * per_si] for part in parts]
        np.testing.assert_allclose(np.array(scalars[f"{own}/band"][1])[:-1, 1:], reach)


def test_units_stand_where_they_were_measured_and_outliers_are_named(found: FleetOverview, tmp_path: Path) -> None:
    path = fleet.save(found, tmp_path / "fleet.rrd")
    (places,), (chart,), (track,) = (
        logged(path, "Points2D:positions")["/units/points"][1],
        charts_of(found),
        found.tracks,
    )
    means = (track.units - track.nominal) * MICRO_G
    expected = chart.at(np.arange(1.0, 21.0), means)
    drawn = np.array(places)[len(track.values) :]  # the runs come first
    np.testing.assert_allclose(drawn[np.argsort(drawn[:, 0])], expected, rtol=1e-5)
    assert "unit03" in logged(path, "Points2D:labels")["/units/texts"][1][0]


def test_the_page_of_text_tells_what_was_found_and_what_is_not_drawn(
    found: FleetOverview, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_thinned, "MOST", 15)
    path = fleet.save(replace(found, remarks=("a | remark.",)), tmp_path / "fleet.rrd")
    ((text,),) = logged(path, "TextDocument:text")["/summary"][1]
    assert "**40 runs** of 20 units on 1 bench, 2026-01-01 to 2026-10-01" in text
    assert "flexure is of the bench" in text and "| flexure | bench 1 | dX |" in text
    assert "- **unit03** (" in text and "b1 is" in text
    assert "reached in 40 of 40 runs" in text and "**Note**: a | remark." in text
    assert "one run in 3 is drawn" in text and "one unit in 2 is drawn" in text
    drawn = logged(path, "Scalars:scalars")["/sigma/b1/run"][1]
    assert len(drawn) == len(found.tracks[0].values[::3])


def test_a_fleet_without_dates_has_a_page_and_its_units(tmp_path: Path) -> None:
    rows = [{**row, "date": None} for row in rows_of(5)]
    rows[0] |= {"unit": "<ü|1>/*", "run": "s3://x/ü.mcap"}
    found = overview_of("fleet", rows, {}, None, ())
    path = fleet.save(found, tmp_path / "fleet.rrd")
    assert not logged(path, "Scalars:scalars") and "/units/points" in logged(path, "Points2D:positions")
    nothing = fleet.save(overview_of("fleet", [], {}, None, ()), tmp_path / "none.rrd")
    assert "**0 runs**" in logged(nothing, "TextDocument:text")["/summary"][1][0][0]
    assert "10 runs without a date" in logged(path, "TextDocument:text")["/summary"][1][0][0]


@pytest.mark.draws
def test_no_panel_complains(found: FleetOverview, tmp_path: Path) -> None:
    with viewer(fleet.save(found, tmp_path / "fleet.rrd", "Control charts"), (1200, 800)) as client:
        client.take_screenshot()
        state = client.get_state()
    assert [(each.name, report.summary) for each in state.views for report in each.reports] == []
    assert {"b₁, µg: run less mean of its unit", "what was found"} <= {each.name for each in state.views}
