"""Tables on screens of any width: a number of the wide one is in the narrow one, whole."""

import re
from collections import Counter
from collections.abc import Callable

import pytest
from helpers.paths import ROOT
from helpers.synthetic import Run
from rich.console import RenderableType

from kf_calib.bench.bench import Bench
from kf_calib.cli.acquire import _hidden_table
from kf_calib.design import optimality_criteria
from kf_calib.design.exact_design import Search
from kf_calib.design.gimbal_limits import GimbalLimits, Timing
from kf_calib.design.orientation_plan import plan
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.stepwise_selection import improve
from kf_calib.effects import effect_named, names
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import Comparison, Way
from kf_calib.estimation.observability import visibility_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import Session
from kf_calib.reproduction import text as paper
from kf_calib.reproduction.grebenkin2019 import repeat
from kf_calib.sources.files.recording import Recording
from kf_calib.views import catalogue, console, diagnosis, improvement
from kf_calib.views import plan as plans
from kf_calib.views.live.content import content_of
from kf_calib.views.live.screen import screen
from kf_calib.views.terminal import Bar, ConsoleTable

HIDDEN = ROOT / "recordings" / "hidden.mcap"
BENCH = Bench.from_metadata({"axes": "y z x", "gravity_mps2": "9.81"})


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(Recording(HIDDEN), Settings(effects=("second-order",)))


def _live(result: Calibration) -> RenderableType:
    session = Session(Run(dwells=5, count=60), wanted={"K1": 1e-9})
    session.run()
    return screen(content_of(session.standing, None, "run"))


def _compared(result: Calibration) -> RenderableType:
    ways = {name: Way(result.estimate, 16.374, 21.0, 2.3e-7, 4.5e-12) for name in ("block", "filterpy", "batch")}
    return console.comparison_table(Comparison(result, ways, ("rounding only",)))


def _plan(result: Calibration) -> RenderableType:
    search = Search(PredictedInformation.of_bench(BENCH, 1e-4, 100, 30.0), GimbalLimits(BENCH), optimality_criteria.D)
    return plans.plan_report(plan(search, 4, Timing(30.0, 20.0)), beside_paper=True)


def _visible(result: Calibration) -> RenderableType:
    chosen = [effect_named(name, result.bench) for name in ("magnetic", "thermal-bias", "warm-up")]
    return catalogue.sight_report(visibility_of(result.fit, chosen), result.model, "a recording")


REFITS = Refits()
"""What a diagnosis has computed, an improvement need not again."""
SAID: dict[str, Callable[[Calibration], RenderableType]] = {
    "replay": console.summary,
    "model": lambda result: console.model_table(result.model),
    "compare": _compared,
    "diagnose": lambda result: diagnosis.diagnosis_report(diagnose(result, REFITS)),
    "improve": lambda result: improvement.improvement_report(improve(result, refits=REFITS), None),
    "effects": lambda result: catalogue.overview([effect_named(name, BENCH) for name in names(BENCH)]),
    "effects NAME": lambda result: catalogue.details([effect_named("warm-up", BENCH)]),
    "effects --recording": _visible,
    "simulate --hide help": lambda result: _hidden_table(),
    "plan": _plan,
    "paper": lambda result: paper.table2(repeat(repetitions=2)),
    "live": _live,
}


@pytest.mark.parametrize("command", SAID)
def test_no_number_is_cut_on_a_narrow_screen(command: str, result: Calibration) -> None:
    said = SAID[command](result)
    wide = _numbers(console.plain(said, width=250))
    assert wide
    for width in (110, 80, 60, 40):
        narrow = console.plain(said, width=width)
        assert "…" not in narrow
        assert not wide - _numbers(narrow), (width, wide - _numbers(narrow))
        assert max(map(len, narrow.splitlines())) <= width


def _numbers(text: str) -> Counter[str]:
    return Counter(re.findall(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", text))


def _table() -> ConsoleTable:
    table = ConsoleTable(title="Sizes")
    table.add_column("name")
    table.add_column("p", justify="right")
    table.add_column("")
    table.add_row("a long name of two lines", "7.3e-12", Bar("█" * 20))
    return table


def test_a_narrow_screen_does_without_the_frame_then_without_bars_then_has_records() -> None:
    framed, plain_lines, barless, records = (console.plain(_table(), width=width) for width in (60, 46, 30, 20))
    assert "┃" in framed and "█" * 20 in framed
    assert "┃" not in plain_lines and "█" * 20 in plain_lines
    assert "█" not in barless and "7.3e-12" in barless
    assert records.splitlines() == ["Sizes", "a long name of two", "  lines: p 7.3e-12"]
