"""How good the bench that drives itself is: time to the targets, names, coverage; and faults at random moments.

    tools/run_trial.py benches -o runs.jsonl --first 0 --count 20       # simulated benches, half with a hidden effect
    tools/run_trial.py faults -o faults.jsonl --count 100               # each through the command line
    tools/run_trial.py summary runs.jsonl faults.jsonl

A bench is drawn from its number: sensors of navigation grade, white noise, in half of the benches scatter and setting
error, which the bench states, and in every second one an effect of 10 to 40 sigma. Its targets are the sigmas that the
plan of 24 orientations, 30 s each, reaches in an orientation drawn from the 12th to the 24th. The times of that plan,
and of the paper's twelve orientations in their order, over and over, follow from the same prediction of the filter.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.design import optimality_criteria, orientation_plan
from kf_calib.design.exact_design import Scheme, Search
from kf_calib.design.gimbal_limits import PEAK_OVER_MEAN, GimbalLimits, Timing
from kf_calib.design.next_orientation import SlewTimes
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.session import Session
from kf_calib.online.suggestion import Itinerary
from kf_calib.positioning.drive import Drive
from kf_calib.positioning.loop import Rules
from kf_calib.positioning.opening import SimulatedPositioner
from kf_calib.sources.files.record_files import END_RECORD, decision_records
from kf_calib.sources.simulation.driven import FAULTS, DrivenBench
from kf_calib.sources.simulation.options import options_from_query, simulation

EFFECTS = (
    "second-order", "scale-asymmetry", "third-order", "odd-quadratic", "cross-coupling-io", "cross-axis-square",
    "base-tilt", "encoder-harmonic-1:z", "encoder-harmonic-2:x", "axis-nonorthogonality:z", "hysteresis", "bias-drift",
)  # fmt: skip
SAMPLE_HZ, DWELL_S, MOST = 20.0, 30.0, 96
KINDS = {"theta": "rad", "K": "1", "b": "m/s^2"}


class SteppedTime:
    """Lets a bench measure, and its session evaluate, while the loop sleeps."""

    tick_s = 0.25

    def __init__(self, bench: DrivenBench, session: Session) -> None:
        self.bench, self.session = bench, session

    def now_s(self) -> float:
        return self.bench.now_s

    def sleep(self, seconds: float) -> None:
        self.session.ingest(self.bench.advance(seconds))


def query_of(number: int) -> tuple[str, str]:
    """The simulated bench of a number, as a query, and the effect that it hides; empty where it hides none."""
    rng = np.random.default_rng([41, number])
    white = 10 ** rng.uniform(-5.0, -4.0)
    parts = [f"seed={number}", f"sample_hz={SAMPLE_HZ:g}", f"white_mps2={white:.3g}"]
    if rng.random() < 0.5:
        parts += [f"scatter_mps2={10 ** rng.uniform(-5.7, -4.7):.3g}"]
    if rng.random() < 0.5:
        parts += [f"setting_sigma_deg={10 ** rng.uniform(-4.3, -3.5):.3g}"]
    effect = str(rng.choice(EFFECTS)) if number % 2 else ""
    return "&".join([*parts, *([f"hide={effect}={rng.uniform(10.0, 40.0):.3g}sigma"] if effect else [])]), effect


@dataclass(frozen=True)
class Fixed:
    """Orientations in a fixed order, visited over and over: time (n,) and sigmas (n, 12) after each dwell."""

    time_s: Floats
    sigma: Floats

    @classmethod
    def of(cls, bench: Bench, white_mps2: float, poses: Floats, slew_times: SlewTimes, effect: str) -> Fixed:
        """With the effect in the model that has to be estimated beside the twelve; empty for none."""
        information = PredictedInformation.of_bench(bench, white_mps2, SAMPLE_HZ * (DWELL_S - 1.25), DWELL_S)
        model = Model.of(bench, (effect,) if effect else ())
        nothing = np.zeros((model.count, model.count))
        information = replace(information, model=model, state=model.nominal_state(), known=nothing)
        order = np.resize(np.arange(len(poses)), MOST)
        rows, factor, sigmas = information.rows(poses), information.start, list[Floats]()
        for k in order:
            factor = triangle(np.vstack([factor, rows[k]]))
            blind = optimality_criteria.is_unseen(factor).any()
            sigma = optimality_criteria.sigmas(factor) * information.units
            sigmas.append(np.full(12, np.inf) if blind else sigma[:12])
        way = np.vstack([np.zeros(poses.shape[1]), poses[order]])
        return cls(np.cumsum(slew_times.slews_s(way[:-1], way[1:]) + 1.0 + DWELL_S), np.array(sigmas))

    def reaches_s(self, wanted: Floats) -> float:
        """When all targets are reached; infinite where they never are."""
        reached = (self.sigma <= wanted * (1.0 + 1e-9)).all(axis=1)
        return float(self.time_s[np.argmax(reached)]) if reached.any() else math.inf


def planned_poses(bench: Bench, white_mps2: float, slew_times: SlewTimes, count: int = 24) -> Floats:
    """The poses of ``kf-calib plan --count 24``, in its order."""
    information = PredictedInformation.of_bench(bench, white_mps2, SAMPLE_HZ * (DWELL_S - 1.25), DWELL_S)
    search = Search(information, GimbalLimits(bench), optimality_criteria.D, Scheme())
    return orientation_plan.plan(search, count, Timing(DWELL_S, PEAK_OVER_MEAN * slew_times.rate_degps)).poses


def papers_poses(bench: Bench) -> Floats:
    """Poses with the directions of the paper's optimal set, accelerometer by accelerometer."""
    from kf_calib.sources.simulation.visit_plans import _angles_towards  # the search for gimbal angles

    directions = paper_parameters.optimal_directions(paper_parameters.nominal(bench.nominal)).reshape(-1, 3)
    rng = np.random.default_rng(0)
    return np.array([_angles_towards(direction, bench.axes, rng, bench.up) for direction in directions])


def drawn_targets(number: int, fixed: Fixed) -> dict[str, float]:
    """Targets by symbol, by kind: what the plan reaches in one of its last orientations."""
    at = int(np.random.default_rng([42, number]).integers(11, 24))
    at += int(np.argmax(np.isfinite(fixed.sigma[at:]).all(axis=1)))  # what an effect leaves blind, takes longer
    kinds = [symbol.rstrip("123") for symbol in paper_parameters.SYMBOLS]
    by_kind = {kind: max(fixed.sigma[at, k] for k in range(12) if _alike(kinds[k], kind)) for kind in KINDS}
    return {symbol: float(by_kind[next(kind for kind in KINDS if _alike(symbol.rstrip("123"), kind))])
            for symbol in paper_parameters.SYMBOLS}  # fmt: skip


def _alike(kind: str, other: str) -> bool:
    return kind == other or (other == "theta" and kind in ("phi", "nu"))


def one_bench(number: int) -> dict[str, Any]:
    """Drive a bench to its targets, adding what is missing; and the times of the fixed orders."""
    query, effect = query_of(number)
    run, began_s = simulation(options_from_query(query), {}), time.process_time()
    bench, slew_times, white = run.bench, SlewTimes(), run.noise.white_mps2
    fixed = Fixed.of(bench, white, planned_poses(bench, white, slew_times), slew_times, effect)
    paper = Fixed.of(bench, white, papers_poses(bench), slew_times, effect)
    targets = drawn_targets(number, fixed)
    wanted = np.array([targets[symbol] for symbol in paper_parameters.SYMBOLS])
    device, session = DrivenBench(run, None, [0.0] * 3), Session.fed(bench, Settings(), targets, auto=True)
    named = list[tuple[int, tuple[str, ...]]]()
    session.listeners.append(lambda judgement: _note(named, session, judgement.result))
    itinerary = Itinerary(bench, slew_times, ends_when_named=False)
    rules = Rules(itinerary.limits, slew_times)
    drive = Drive(SimulatedPositioner(device), session, itinerary, rules, SteppedTime(device, session))
    outcome = drive.run()
    final = session.finish()
    parameters, truth = list(final.result.parameters.items())[:12], run.sensors.parameters
    pulls = [(value.value - truth[symbol]) / value.sigma for symbol, value in parameters]
    sigma = final.result.estimate.sigma[:12]
    return {
        "number": number, "query": query, "effect": effect, "ended": outcome.ended, "why": outcome.why,
        "lasted_s": outcome.lasted_s, "orientations": len(final.result.visits), "fixed_s": fixed.reaches_s(wanted),
        "whole_plan_s": float(fixed.time_s[23]), "paper_s": paper.reaches_s(wanted), "named": named,
        "model": list(final.result.settings.effects), "consistent": final.consistent,
        "reached": bool((sigma <= wanted).all()), "worst": float((sigma / wanted).max()), "pulls": pulls,
        "missing": list(final.diagnosis.missing), "cpu_s": time.process_time() - began_s,
    }  # fmt: skip


def _note(named: list[tuple[int, tuple[str, ...]]], session: Session, result: Any) -> None:
    """Keep after how many orientations the model has grown."""
    model = tuple(session.settings.effects)
    if model and (not named or named[-1][1] != model):
        named.append((len(result.visits), model))


@dataclass
class Broken:
    """A run with a fault: what it was, and what came of it. ``right``: whether all is as it has to be."""

    fault: str
    at_s: float
    code: int
    said: str
    stopped: bool
    whole: bool
    right: bool


CODES = {"SIGINT": 130, "SIGTERM": 143}
SAYS = {
    "stuck": "did not begin", "stall": "instead of", "off": "instead of", "drive": "drive tripped",
    "link": "MAY STILL MOVE", "readback": "leaps", "runaway": "off its way", "SIGINT": "Ctrl-C", "SIGTERM": "SIGTERM",
    "disk": "nothing can be recorded",
}  # fmt: skip


def one_fault(number: int, folder: Path) -> Broken:
    """A run by the command line in a process of its own, broken by a fault at a random moment."""
    rng = np.random.default_rng([43, number])
    kinds = [*FAULTS, "SIGINT", "SIGTERM", "disk"]
    fault, at_s = kinds[number % len(kinds)], float(rng.uniform(2.0, 90.0))
    recording = folder / f"{number}.mcap"
    url = f"sim://?seed={number}&sample_hz=20" + (f"&fault={fault}&fault_s={at_s:.2f}" if fault in FAULTS else "")
    if fault in CODES:
        url, at_s = url + "&speed=30", at_s / 30.0
    words = [sys.executable, "-m", "kf_calib.cli", "run", "--positioner", url, "--record", str(recording), "--json",
             "--target", "K=0.05ppm"]  # fmt: skip
    limit = int(rng.uniform(6_000, 60_000)) if fault == "disk" else 0
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               preexec_fn=(lambda: _small_disk(limit)) if limit else None)  # fmt: skip
    if fault in CODES:
        while not recording.exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(at_s)
        process.send_signal(getattr(signal, fault))
    _, said = process.communicate(timeout=900)
    ends, stopped = decision_records(recording, END_RECORD), "The table was stopped and stands at" in said
    is_told = fault == "disk" or (len(ends) == 1 and ends[0]["stopped"] == str(stopped).lower())
    whole = _is_whole(recording, len(ends), fault)
    code = CODES.get(fault, 2)
    right = process.returncode == code and SAYS[fault] in said and whole and is_told and stopped != (fault == "link")
    return Broken(fault, at_s, process.returncode, said.strip().splitlines()[0][:300], stopped, whole, right)


def _small_disk(limit: int) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"


def _is_whole(recording: Path, ends: int, fault: str) -> bool:
    """Whether the recording can be read to its end, and tells how the drive ended (where there was room)."""
    from kf_calib.sources.files.recording import Recording

    if not recording.exists():
        return False
    read = Recording(recording)
    samples = sum(len(batch.accel) for batch in read)
    return samples > 0 and (fault == "disk" or (not read.warnings and ends == 1))


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the runs and of the faults in some lines."""
    runs, faults = [line for line in lines if "query" in line], [line for line in lines if "fault" in line]
    figures: dict[str, Any] = {"benches": len(runs), "faults": len(faults)}
    if faults:
        figures["faults_right"] = sum(line["right"] for line in faults)
        figures["faults_wrong"] = dict(Counter(line["fault"] for line in faults if not line["right"]))
    if runs:
        ended = [run for run in runs if run["ended"] == "targets"]
        for name in ("fixed_s", "paper_s", "whole_plan_s"):
            ratios = np.array([run["lasted_s"] / run[name] for run in ended])
            quantiles = np.percentile(ratios, [25, 50, 75, 95]) if len(ratios) else np.full(4, np.nan)
            figures[f"time_over_{name}"] = quantiles.round(3).tolist()
        pulls = np.abs([run["pulls"] for run in ended if _is_right(run)])
        named = [run for run in runs if run["effect"] and run["named"]]
        figures |= {
            "ended": dict(Counter(run["ended"] for run in runs)),
            "false_stops": sum(not run["reached"] for run in ended),
            "hidden": sum(bool(run["effect"]) for run in runs), "named": len(named),
            "named_wrongly": [run["number"] for run in runs if run["model"] and run["effect"] not in run["model"]],
            "named_after": sorted(run["named"][0][0] for run in named),
            "coverage_95": round(float((pulls < 1.96).mean()), 4) if len(pulls) else None,
            "values": int(pulls.size),
            "orientations": sorted(run["orientations"] for run in runs),
        }  # fmt: skip
    return figures


def _is_right(run: dict[str, Any]) -> bool:
    """Whether the model in the end is that of the bench."""
    return run["model"] == [run["effect"]] * bool(run["effect"])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("benches", "faults"):
        sub = commands.add_parser(name)
        sub.add_argument("-o", type=Path, required=True, metavar="FILE.jsonl")
        sub.add_argument("--first", type=int, default=0)
        sub.add_argument("--count", type=int, default=20 if name == "benches" else 100)
    commands.add_parser("summary").add_argument("files", type=Path, nargs="+")
    chosen = parser.parse_args()
    if chosen.command == "summary":
        lines = [json.loads(line) for path in chosen.files for line in path.read_text().splitlines()]
        print(json.dumps(summary(lines), indent=1))
        return
    with tempfile.TemporaryDirectory() as folder:
        for number in range(chosen.first, chosen.first + chosen.count):
            made = one_bench(number) if chosen.command == "benches" else asdict(one_fault(number, Path(folder)))
            with chosen.o.open("a") as file:
                file.write(json.dumps(made) + "\n")


if __name__ == "__main__":
    main()
