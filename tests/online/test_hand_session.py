"""A sensor in the hand evaluated while it is turned: what replay gives, and which side is next."""

import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import Run
from helpers.thresholds import begins_at
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream, bench_without_angles, without_poses
from kf_calib.diagnosis.candidate_tests import LEVEL
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import HandJudgement, HandSession
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live import open_live
from kf_calib.sources.simulation.options import simulation
from kf_calib.sources.simulation.settings import SimulationOptions
from kf_calib.support.json_values import json_value
from kf_calib.views.console import plain
from kf_calib.views.json import replay_object
from kf_calib.views.live.content import content_of
from kf_calib.views.live.objects import line, live_object
from kf_calib.views.live.screen import screen

sys.path.insert(0, str(ROOT / "tools"))
from bench_emulator import Emulator, Pty

FACES = {"+y": [0, 0, 0], "-y": [0, 0, 180], "-x": [0, 90, 0], "+x": [0, -90, 0], "-z": [0, 0, -90], "+z": [0, 0, 90]}


class Board:
    """A board that is turned by hand: readings only, in small batches, with motion between the poses."""

    def __init__(self, poses: np.ndarray, seconds: float = 6.0, white: float = 0.02) -> None:
        count = round(50 * seconds)
        spread = (5e-3, 2e-2, 0.1)
        run = Run(4, len(poses), count, 50.0, white_mps2=white, spread=spread, poses=poses, gap_s=1.0)
        rng = np.random.default_rng(1)
        parts = np.split(run.accel.values, len(poses))
        moved = [np.concatenate([part, part[-1] + np.cumsum(rng.normal(size=(75, 3)), axis=0)]) for part in parts]
        values = np.concatenate(moved)
        self.accel = Stream(20_000_000 * np.arange(len(values), dtype=np.int64), values)
        self.bench: Bench = bench_without_angles("board", {"gravity_mps2": "9.81"})[0]
        self.warnings, self.fraction = list[str](), 1.0

    def __iter__(self) -> Iterator[Batch]:
        for begin in range(0, len(self.accel), 20):
            yield Batch(self.accel[begin : begin + 20], Stream.empty(4))


@dataclass
class Told:
    """The tasks of a run in their order, each once until another comes, and its judgements."""

    tasks: list[str]
    judged: list[HandJudgement]
    session: HandSession


def followed(board: Any, wanted: dict[str, float] | None = None) -> Told:
    """The run of a board of which every pose is judged before its next readings come, as it would be by hand."""
    told = Told([], [], HandSession(board, wanted=wanted))
    session, take = told.session, HandSession._take

    def taken(batch: Batch) -> None:
        take(session, batch)
        with session._lock:
            session._lock.wait_for(lambda: len(told.judged) >= session._closed, timeout=20.0)
        sides = session.standing.sides
        assert sides is None or sides.following != sides.last  # never the side that it lies on
        if not told.tasks or told.tasks[-1] != session.standing.task:
            told.tasks.append(session.standing.task)

    def heard(judgement: HandJudgement) -> None:
        with session._lock:
            session._show_sides(judgement.sides)
            told.judged.append(judgement)
            session._lock.notify_all()

    session._take = taken  # type: ignore[method-assign]
    session.listeners.append(heard)
    session.run()
    return told


def angles(*names: str) -> np.ndarray:
    return np.radians([FACES[name] for name in names])


@cache
def twelve() -> Told:
    spread = Rotation.random(5, np.random.default_rng(5)).as_euler("YZX")
    faces = angles("+y", "+y", "-y", "+x", "-x", "+z", "-z")
    return followed(Board(np.concatenate([faces, spread])), {"K1": 1e-3, "nu1": 1e-3})


def test_the_end_is_that_of_replay_and_each_pose_is_judged() -> None:
    told = twelve()
    final = told.judged[-1]
    replayed = calibrate(told.session.source)
    assert final.final and final.result is not None and not final.result.model.square
    np.testing.assert_array_equal(final.result.estimate.state, replayed.estimate.state)
    assert json_value(replay_object(final.result)) == json_value(replay_object(replayed))
    assert [len(each.dwells) for each in told.judged] == [*range(1, 13), 12]
    assert final.reached and final.consistent is True and final.sides.count == 11


def test_what_to_do_is_told_in_the_order_of_doing_it() -> None:
    tasks = twelve().tasks
    assert tasks[:5] == [
        "lay it on any side and hold it still",
        "hold still for 5 s",
        "enough: turn it to a new side: +z points up",
        "turn it to a new side: +z points up; then hold it still",
        "on this side it was in pose 1, which tells little more: turn it to a new side: +z points up",
    ]
    assert tasks[5:].count("hold still for 5 s") >= 7
    assert "turn it to a new side: +x points up, tilted 55 deg toward +y and +z; then hold it still" in tasks
    assert tasks[-1] == "every target is reached: end the run, or go on with more sides"


def test_a_poor_set_of_sides_is_told_and_not_fitted() -> None:
    told = list[HandJudgement]()
    session = HandSession(Board(angles("+y", "-y", "+x", "+y")))
    session.listeners.append(told.append)
    with pytest.raises(UnobservableError, match="4 poses do not determine K1, K3, b1, b3: turn it so that"):
        session.run()
    assert [each.result for each in told] == [None] * 4 and told[-1].sides.missing == ("K1", "K3", "b1", "b3")
    assert told[-1].sides.repeats == 1 and told[-1].sides.count == 3
    said = line(told[-1])
    assert "the side of pose 1 again" in said and "3 sides seen" in said and "not determined yet" in said


def judged(p_value: float | None, looks: int = 1, square: tuple[str, ...] = (), final: bool = False) -> HandJudgement:
    consistency = SimpleNamespace(p_value=p_value, consistent=p_value is not None and p_value >= LEVEL)
    result: Any = SimpleNamespace(consistency=consistency, model=SimpleNamespace(square=square))
    return HandJudgement(result, [], SimpleNamespace(missing=["x up"]), np.ones(12), looks, final)  # type: ignore[arg-type]


def test_all_looks_together_raise_a_false_alarm_as_often_as_one() -> None:
    shares = [begins_at(lambda p, k=k: judged(p, k).consistent, 1e-9, 1.0) for k in range(1, 400)]
    assert shares[:3] == pytest.approx([LEVEL / 2.0, LEVEL / 6.0, LEVEL / 12.0])
    assert 0.99 * LEVEL < sum(shares) < LEVEL
    assert judged(LEVEL / 4.0, final=True).consistent is False and judged(2.0 * LEVEL, 9, final=True).consistent


def test_a_verdict_waits_for_poses_that_test_each_other() -> None:
    none = HandJudgement(None, [], judged(0.5).sides, np.ones(12))
    waiting = (none, judged(None, square=("nu1",)), judged(None))
    assert [each.consistent for each in waiting] == [None, None, None]
    told = [each.verdict for each in (*waiting, judged(0.5), judged(1e-9), judged(1e-9, square=("nu1",)))]
    beginnings = [
        "x up not determined", "these angles are not told yet, and taken for square: nu1", "too few poses",
        "the sizes of gravity agree", "the sizes of gravity differ", "the sizes of gravity differ",
    ]  # fmt: skip
    assert all(one.startswith(other) for one, other in zip(told, beginnings, strict=True))


def test_screen_and_object_show_nine_parameters_with_their_targets() -> None:
    told = twelve()
    standing = replace(told.session.standing, judgement=told.judged[9], rest_s=3.2)
    shown = plain(screen(content_of(standing, None, "/dev/ttyACM0"), "q: end the run"), width=80)
    assert "still for 3 s of 5 s" in shown and "sides seen" in shown and "q: end the run" in shown
    assert "θ1" not in shown and "φ3" in shown and shown.count("ppm") == 3 and len(shown.splitlines()) <= 24
    made = live_object(told.judged[1], standing, None)
    assert made["pose"] == {"number": 2, "up": "+y", "repeats": 1} and made["next_side"]["turn"] == "-y points up"
    made = live_object(told.judged[-1], standing, None)
    assert made["final"] and made["targets_reached"] and made["targets"] == {"K1": 1e-3, "nu1": 1e-3}


def test_effects_are_refused_before_anything_is_read() -> None:
    with pytest.raises(InputError, match="leave out effects"):
        HandSession(Board(angles("+y")), Settings(effects="second-order"))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_a_board_on_a_serial_port_that_is_interrupted_gives_what_its_recording_gives(tmp_path: Path) -> None:
    options = SimulationOptions("mems", count=14, dwell_s=3.0, slew_degps=180.0, sample_hz=50.0, seed=2)
    run = simulation(options, {})
    bench = bench_without_angles("", run.bench.to_metadata())[0]

    class Silent:
        """The simulated bench without its angles."""

        def __init__(self) -> None:
            self.bench = bench

        def __iter__(self) -> Iterator[Batch]:
            yield from map(without_poses, run)

    emulator = Emulator(Silent(), Pty(), "json", speed=40.0)  # type: ignore[arg-type]
    emulator.in_background()
    with open_live(emulator.url, None, tmp_path / "hand.mcap", angles=False) as source:
        session = HandSession(source, every=False)
        threading.Timer(1.3, source.stop).start()
        final = session.run()
        emulator.stopping = True
    recording = Recording(tmp_path / "hand.mcap", angles=False)
    replayed = calibrate(recording)
    assert final.result is not None and 6 <= len(final.dwells) < 14
    np.testing.assert_array_equal(final.result.estimate.state, replayed.estimate.state)
    np.testing.assert_array_equal(final.result.estimate.covariance, replayed.estimate.covariance)
    assert final.result.counts == replayed.counts
    with pytest.raises(InputError, match="no angle or attitude topic"):
        Recording(tmp_path / "hand.mcap")
