"""Commands whose numbers are stored: what they print with ``--json``, and the files that they write."""

import json
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from helpers.calibrations import simulated
from helpers.command_line import CommandLine
from helpers.paths import RECORDINGS
from helpers.recordings import read
from helpers.result_numbers import ResultNumbers
from helpers.run_factors import campaign_of
from helpers.synthetic import Run
from kf_calib import calibrate
from kf_calib.bench.streams import Batch
from kf_calib.exchange import calibration_file
from kf_calib.exchange.verification import verify
from kf_calib.exports import TARGETS
from kf_calib.fleet.pooled_diagnosis import pooled_diagnosis
from kf_calib.online.session import Session
from kf_calib.online.status import Judgement, RunStatus
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.opening import opened
from kf_calib.support.json_values import json_value
from kf_calib.views.exchange import verification_object
from kf_calib.views.json import replay_object
from kf_calib.views.live.objects import live_object

printed = CommandLine().json

Made = Callable[[Path], Mapping[str, Any]]
"""Numbers of a case, made with a folder to write to."""

STATEMENT = """
number = "1"
issued = 2026-11-23
received = 2025-06-10
decision_rule = "guard band"
limits = { K = "500 ppm", b = "100 ug" }
[[uncertainty]]
effect = "gravity-error"
size = "2 ppm"
k = 2.0
source = "report"
[[uncertainty]]
effect = "axis-nonorthogonality:z"
size = "2 arcsec"
dof = 8.0
"""
BAG = {"axes": "y z x", "gravity_mps2": "9.81"}
PLANS: Mapping[str, str] = {
    "D": "--count 9 --limit z=-90:90", "A": "--count 8 --criterion A",
    "minimax": "--count 12 --criterion minimax --target K=5ppm --target b=10ug",
    "hand": "--no-angles --count 12",
}  # fmt: skip


def plans(folder: Path) -> Mapping[str, Any]:
    return {name: printed("plan", *words.split()) for name, words in PLANS.items()}


def look_ups(folder: Path) -> Mapping[str, Any]:
    """Contents of recordings, the catalogue of effects, and the paper's table."""
    files = ("hidden.mcap", "mems_faces.mcap", "hand.mcap", "twelve_poses.csv", "six_faces.xlsx")
    told = {name: printed("info", RECORDINGS / name) for name in files}
    return told | {"effects": printed("effects"), "paper": printed("paper")}


def written(path: Path, seed: int, day: int) -> Path:
    """A saved calibration of a simulated run of some day."""
    saved = calibration_file.saved(calibrate(simulated(seed)), "run.mcap", "0" * 64, datetime(2025, 6, day, tzinfo=UTC))
    calibration_file.write_calibration(path, saved)
    return path


def uses(folder: Path) -> Mapping[str, Any]:
    """History, verification, certificate and exports of calibrations."""
    paths = [written(folder / f"{seed}.json", seed, 1 + 7 * seed) for seed in range(4)]
    (folder / "lab.toml").write_text(STATEMENT)
    saved, lab = calibration_file.open_calibration(paths[0]), folder / "lab.toml"
    verified = verify(saved, saved.model(), simulated(10_000, 8, moved={"K1": 3e-5}))
    certified = ("certificate", paths[0], "--statement", lab, "--xml", folder / "c.xml", "-o", folder / "c.pdf")
    told = {
        "history": printed("history", *paths, "--tolerance", "K=20ppm", "--tolerance", "b=100ug"),
        "verify": json_value(verification_object(verified)), "certificate": printed(*certified),
        "saved": json.loads(paths[0].read_text()), "figures": ResultNumbers().add(verified, "verify").figures,
    }  # fmt: skip
    return told | {f"export {to}": exported(paths[0], to, folder / f"export-{to}") for to in TARGETS}


def exported(path: Path, to: str, target: Path) -> Mapping[str, Any]:
    told = printed("export", path, "--to", to, "-o", target, "--lossy")
    return {"told": told, "numbers": numbers_in(target.read_text())}


def numbers_in(text: str) -> list[float]:
    """The decimal numbers of a text."""
    return [float(word) for word in re.findall(r"(?<![\w.])-?\d+\.\d+(?:e[-+]?\d+)?(?![\w.])", text)]


def readers(folder: Path) -> Mapping[str, Any]:
    """What the readers of files give: counts, first and last samples, and sums."""
    told = {name: streams(read(Recording(RECORDINGS / name))) for name in ("hidden.mcap", "mems_faces.mcap")}
    told["hand.mcap"] = streams(read(Recording(RECORDINGS / "hand.mcap", angles=False)))
    told["bench_bag"] = streams(read(Recording(RECORDINGS / "bench_bag", BAG)))
    poses = calibrate(opened(RECORDINGS / "twelve_poses.csv", BAG))
    faces = calibrate(opened(RECORDINGS / "six_faces.xlsx", {"gravity_mps2": "9.81"}))
    return told | json_value({"poses": replay_object(poses), "faces": replay_object(faces)})


def streams(batch: Batch) -> Mapping[str, Any]:
    told = dict[str, Any]()
    for name, stream in (("accel", batch.accel), ("pose", batch.pose), ("temperature", batch.temperature)):
        ends = [stream.values[0], stream.values[-1], stream.values.sum(axis=0)] if len(stream) else []
        told[name] = {"count": len(stream), "ends": [each.tolist() for each in ends]}
        told[name]["ns"] = [str(int(each)) for each in stream.time_ns[[0, -1]]] if len(stream) else []
        told[name]["rate"] = float(1e9 / np.median(np.diff(stream.time_ns))) if len(stream) > 1 else 0.0
    return told


def live(folder: Path) -> Mapping[str, Any]:
    """The judgements of a run while it goes on, and the last one whole."""
    told, session = dict[str, Any](), Session(Run(dwells=8, count=100, batch=200))
    session.listeners.append(lambda judged: told.update({str(len(told)): of_judgement(judged, session.standing)}))
    final = session.run()
    return told | {"figures": ResultNumbers().add(final, "judged").figures}


def of_judgement(judged: Judgement, standing: RunStatus) -> Mapping[str, Any]:
    """What ``live`` says beside what ``replay`` and ``diagnose`` do, and the largest of what they say."""
    told = json_value(live_object(judged, standing, None))
    return {key: told[key] for key in ("p_value", "consistent", "looks", "time_left_s", "next_orientation", "model")}


def pooled(folder: Path) -> Mapping[str, Any]:
    """Many runs together."""
    bent = np.array([2.5, -2.0, 2.0])
    hidden = lambda number: {  # noqa: E731
        "flexure": bent * (number < 9),
        "second-order": 1.7 * np.random.default_rng([number, 2]).standard_normal(3),
    }
    return {"figures": ResultNumbers().add(pooled_diagnosis(campaign_of(16, hidden)), "pooled").figures}


COMMANDS: Mapping[str, Made] = {
    "plans": plans, "look_ups": look_ups, "uses": uses, "readers": readers, "live": live, "pooled": pooled,
}  # fmt: skip
"""Run by the fast tests."""
