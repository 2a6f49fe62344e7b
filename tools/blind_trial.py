"""Blind trial: recordings with a hidden effect through the command line, and how often the program is right.

usage: .venv/bin/python tools/blind_trial.py [--runs N] [--seed S] [--only FIGURE ...] [--resume FILE] [--pool FILE ...]

Each trial is made by ``simulate`` (the nonlinear truth), told by ``diagnose --json`` or ``improve --json``, and judged
by the truth in the side file. A name is right where it is the hidden effect's, or one that spans the same space of
readings in this run, worked out from the recording. A recording that the program refuses to judge counts as not right.
``--runs``: trials for each effect and size (``COUNTS`` has the other figures'); ``--resume``: outcomes are kept there
as they come, and a trial that is there is not made again. Development runs use small seeds; a release is reported with
a seed of its own, of six digits.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: a process a core is enough

import contextlib
import dataclasses
import io
import itertools
import json
import math
import shlex
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from best_possible import Columns, Effect, Process, best_possible, best_possible_pairs

from kf_calib.bench.arrays import Floats
from kf_calib.design.next_orientation import ENOUGH
from kf_calib.effects import Effect as Known
from kf_calib.effects import effect_named, names
from kf_calib.errors import KfCalibError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import Candidate, scan
from kf_calib.estimation.settings import Settings
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.injected import Kind, NoSizeError, catalogue

# Few readings, and time enough for drifts and time constants to show: half an hour in about a second of computing.
BENCH = (
    "--dwell-s", "60", "--sample-hz", "6", "--angle-hz", "4", "--slew-degps", "20", "--gravity", "9.81",
    "--latitude", "50", "--temperature-swing", "5", "--temperature-period-s", "700", "--warm-up-c", "4",
    "--warm-up-s", "500",
)  # fmt: skip
NOISES: dict[str, tuple[str, ...]] = {
    "white": (),
    "AR(1) 0.9": ("--ar1", "0.9"),
    "1/f": ("--flicker", "1e-5"),
    "scatter": ("--scatter", "5e-5"),
    "unstated": ("--unstated",),
}
UNDERSTATED: dict[str, tuple[tuple[str, ...], str]] = {
    "scatter": (("--scatter", "4e-6", "--scatter-sigma", "0"), "0.0002"),
    "setting error": (("--angle-sigma", "0.0002"), "0.0004"),
}
"""Options, and the setting error in deg, of runs whose dwells scatter by more than the recording states."""
PLANS: dict[str, tuple[str, ...]] = {
    "spread": (),
    "six faces": ("--plan", "faces"),
    "monotone": ("--plan", "monotone"),
    "six dwells": ("--orientations", "6"),
}
FIGURES = (
    "noise", "name", "unstated", "power", "invisible", "outside", "pair", "plans", "improve", "advice", "ideal",
    "benches", "understated",
)  # fmt: skip
COUNTS: dict[str, float] = {
    "noise@white": 500, "noise": 60, "name": 1, "unstated": 0.25, "power": 4, "invisible": 0.2, "outside": 2,
    "pair": 40, "plans@nothing": 8, "plans": 0.2, "improve": 0.4, "advice": 1, "ideal": 2, "benches": 30,
    "understated": 15,
}  # fmt: skip
"""Trials a unit of ``--runs``: in all, or for each effect (and size, and plan) that is hidden; at least one."""

_SPREAD_PLANS = 50  # of a seed of the trial: to spread orientations takes as long as to simulate a run through them
_SAME = 1.0 - 1e-6
_APART = 0.7
_LIKE = 0.9  # overlap of what may be taken for each other at 8 sigma
_FEW = 12  # orientations
_SIZES = (8, 10, 15)  # sigma
_FAR = 40  # sigma: the misfit is many times the noise
_PAIR_SIZE = 10  # sigma, of each
_LARGE = 100  # sigma, or times
_ALONE, _EXACT = 1000, 0.01  # sigma; the part of what is hidden that a name may leave
_DWELL_S = float(BENCH[BENCH.index("--dwell-s") + 1])
_POWER = (0.86, 0.94)
_SECOND = 5_000_000  # from the seed of a run to that of its second run
_WALK = "bias-walk"
_SCATTERING = ", where dwells may scatter, too"
_BENCH_SIZES = (10, 15, 30)  # sigma
_ENOUGH = 20  # trials; fewer are shown and not judged

Hit = TypeVar("Hit", bool, float)


@dataclass(frozen=True)
class Task:
    """One trial.

    figure: family, then what sets it apart, as ``name@10``. play: a key of ``PLAYS``. setting: error of setting an
    orientation, deg; the recording states it unless the options say otherwise.
    """

    figure: str
    play: str
    seed: int
    hidden: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    setting: str = "0.0002"

    @property
    def family(self) -> str:
        return self.figure.split("@")[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is hidden."""
        return tuple(text.partition("=")[0] for text in self.hidden)

    @property
    def plan(self) -> str:
        """The file of orientations; empty where ``simulate`` draws them itself."""
        if "--plan" in self.options:
            return f"monotone-{self.seed}.csv" if "monotone" in self.options else ""
        number = self.seed // 10_000_000 * _SPREAD_PLANS + self.seed % _SPREAD_PLANS
        return "" if "--orientations" in self.options else f"spread-{number}.csv"

    def simulate(self, path: Path | str, *more: str) -> list[str]:
        """Words of the command line that makes the recording."""
        hidden = [word for text in self.hidden for word in ("--hide", text)]
        plan = ["--plan", self.plan] if self.plan else []
        return [
            "simulate", str(path), *BENCH, "--setting", self.setting, *self.options, *plan, "--seed", str(self.seed),
            *hidden, *more, "--json",
        ]  # fmt: skip

    @property
    def command(self) -> str:
        """To see it again."""
        told = "improve" if self.play == "improve" else "diagnose"
        return f"kf-calib {shlex.join(self.simulate('t.mcap', '--overwrite')[:-1])} && kf-calib {told} t.mcap"


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was said of it.

    truth: names hidden; same: pairs of a hidden name and a name said that mean the same in this run; extra: what the
    figure needs beside. error: why there is nothing to judge; refused: it was the program that gave no answer, which
    counts as not right.
    """

    task: Task
    truth: tuple[str, ...] = ()
    first: str | None = None
    names: tuple[str, ...] = ()
    ambiguity: tuple[str, ...] = ()
    same: tuple[tuple[str, str], ...] = ()
    consistent: bool | None = None
    p_value: float | None = None
    invisible: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict[str, Any])
    seconds: dict[str, float] = field(default_factory=dict[str, float])
    error: str = ""
    refused: bool = False

    @classmethod
    def read(cls, content: dict[str, Any]) -> Outcome:
        """From JSON, where tuples are lists."""
        task, *plain = ({k: _tuples(v) for k, v in own.items()} for own in (content["task"], content))
        kept = {"extra": content["extra"], "seconds": content["seconds"]}
        return cls(**{**plain[0], **kept, "task": Task(**task)})

    @property
    def named(self) -> str | None:
        """What was named first, None for nothing and for unknown."""
        return None if self.first == "unknown" else self.first

    def means_truth(self, name: str | None) -> bool:
        return name in {said for _, said in self.same}

    @property
    def right(self) -> bool:
        return self.named is not None and self.means_truth(self.named)

    @property
    def held(self) -> bool:
        """The ambiguity set holds every hidden effect."""
        return all(any((true, said) in self.same for said in self.ambiguity) for true in self.truth)

    @property
    def wrong(self) -> bool:
        """A name was given, and what is hidden is not among those it cannot be told from."""
        return self.named is not None and not (
            self.means_truth(self.named) or any(map(self.means_truth, self.ambiguity))
        )

    @property
    def found(self) -> bool:
        """Every hidden effect was named."""
        return all(any((true, said) in self.same for said in self.names) for true in self.truth)

    @property
    def nothing_else(self) -> bool:
        return all(map(self.means_truth, self.names))


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


# --- one trial -------------------------------------------------------------------------------------------------------


def run(*words: str) -> dict[str, Any]:
    """One command of the program, in this process, and the object it prints."""
    from kf_calib.cli import cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        cli.main(list(words), standalone_mode=False)
    return json.loads(printed.getvalue())


def played(task: Task) -> Outcome:
    """The outcome of a trial; its files are gone afterwards."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        try:
            with contextlib.chdir(folder):
                return PLAYS[task.play](task)
        except NoSizeError as error:
            return Outcome(task, task.names, error=str(error))
        except KfCalibError as error:
            return Outcome(task, task.names, error=str(error), refused=True)
        except Exception as error:  # a failure of the program, and no reason to lose the other trials
            where = traceback.extract_tb(error.__traceback__)[-1]
            said = f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
            return Outcome(task, task.names, error=said, refused=True)


def simulated(task: Task, path: Path, times: dict[str, float] | None = None) -> dict[str, Any]:
    """Make the recording, and its plan beside it; what the side file says."""
    with _timed({} if times is None else times, "simulate"):
        if task.plan:
            kind, _, number = task.plan.removesuffix(".csv").partition("-")
            np.savetxt(task.plan, _orientations(kind, int(number)), delimiter=",")
        run(*task.simulate(path, "--overwrite"))
    return json.loads(path.with_suffix(".truth.json").read_text())


@lru_cache(maxsize=2 * _SPREAD_PLANS)
def _orientations(kind: str, seed: int) -> list[tuple[float, ...]]:
    """Gimbal angles, deg: spread over the sphere; ``monotone``: in the order of the middle one."""
    from kf_calib.sources.simulation.visit_plans import spread_plan

    rows = [visit.gimbal_deg for visit in spread_plan(24, seed=seed)]
    return rows if kind == "spread" else sorted(rows, key=lambda row: row[1])


def diagnosed(task: Task) -> Outcome:
    """Simulate, diagnose, compare with the side file."""
    path, times = Path("trial.mcap"), dict[str, float]()
    effects = simulated(task, path, times)["effects"]
    with _timed(times, "diagnose"):
        said = run("diagnose", str(path), "--json")
    missing = said["missing"]
    names = tuple(said.get("all_missing") or ([missing] if missing and missing != "unknown" else []))
    known = tuple(effect["name"] for effect in effects)
    with _timed(times, "judge"):
        same = _meaning_the_same(task, path, effects, {*names, *said["ambiguity_set"]})
    return Outcome(
        task, known, missing, names, tuple(said["ambiguity_set"]), same, said["consistent"], said["p_value"],
        tuple(said["invisible"]),
        {
            "verdict": said["verdict"],
            "driver": (said["unknown"] or {}).get("driver"),
            "may_be_scatter": said["may_be_scatter"],
            "true_drivers": [effect["driver"] for effect in effects],
            "sizes": [effect["size_sigma"] for effect in effects],
        },
        times,
    )  # fmt: skip


@contextlib.contextmanager
def _timed(times: dict[str, float], part: str) -> Iterator[None]:
    start = time.process_time()
    yield
    times[part] = time.process_time() - start


def _meaning_the_same(
    task: Task, path: Path, effects: Sequence[dict[str, Any]], said: Iterable[str]
) -> tuple[tuple[str, str], ...]:
    """Pairs of a hidden name and a name said that mean the same readings beside the twelve parameters.

    They span the same space in this run, or what was hidden is, reading for reading, what the other name means, and
    that is the simpler one: a magnetic sensitivity that is the same of all three accelerometers is a tilt of the base.
    """
    truth = [effect["name"] for effect in effects]
    others = sorted(set(said) - set(truth))
    pairs = {(name, name) for name in truth}
    if truth and others:
        spaces = candidates(path, [*truth, *others])
        pairs |= {
            (true, other)
            for true, other in itertools.product(truth, others)
            if any(_one_space(a, b) for a, b in itertools.product(spaces.get(true, []), spaces.get(other, [])))
        }
        for effect in effects:
            most = max((each.dof for each in spaces.get(effect["name"], [])), default=0)
            simpler = [name for name in others if any(each.dof < most for each in spaces.get(name, []))]
            if simpler and effect["size_sigma"]:
                pairs |= {(effect["name"], other) for other in _reading_for_reading(task, effect, simpler)}
    return tuple(sorted(pairs))


def _reading_for_reading(task: Task, effect: dict[str, Any], others: Sequence[str]) -> list[str]:
    """Those names that explain all of a hidden effect, to a hundredth of its size; of one of a thousand sigma alone."""
    path = Path("alone.mcap")
    simulated(_sized(task, effect, _ALONE / effect["size_sigma"]), path)
    spaces, residual = _scanned(path, [effect["name"], *others])
    falls = {name: max(float(np.sum((each.basis.T @ residual) ** 2)) for each in own) for name, own in spaces.items()}
    return [name for name in others if falls[name] > (1.0 - _EXACT**2) * falls[effect["name"]]]


def _one_space(one: Candidate, other: Candidate) -> bool:
    return one.dof == other.dof and one.within(other)


def candidates(path: Path, wanted: Sequence[str] | None = None) -> dict[str, list[Candidate]]:
    """Columns of effects in a recording beside what the twelve absorb; one with an unknown at the values of a grid."""
    return _scanned(path, wanted)[0]


def _scanned(
    path: Path, wanted: Sequence[str] | None = None, white_mps2: float | None = None, looked_for: bool = False
) -> tuple[dict[str, list[Candidate]], Floats]:
    """Candidates by name, and the residual in their frame; in white noise, where that is given.

    looked_for: of an oscillation the frequencies at which the program looks for a slow one.
    """
    result = _calibrated(path)
    noise = result.noise.judging
    if white_mps2 is not None:
        noise = dataclasses.replace(noise, sigma_mps2=np.full(3, white_mps2), inflation=np.ones(3))
    found = scan(result.fit.carried, noise, _with_columns(result, wanted, looked_for))
    return _by_name(found.candidates), found.residual


def _calibrated(path: Path) -> Calibration:
    return calibrate(Recording(path))


def _with_columns(result: Calibration, wanted: Sequence[str] | None = None, looked_for: bool = False) -> list[Known]:
    """Effects of the program that are columns, one with an unknown at the values of a grid."""
    from kf_calib.diagnosis.candidate_tests import slow_hz

    bench, out = result.model.bench, list[Known]()
    for name in names(bench):
        effect = effect_named(name, bench)
        if wanted is None and effect.oscillates:  # known by its line in the spectrum: a slow one mimics whatever drifts
            continue
        if (wanted is None or name in wanted) and not effect.dynamic and not effect.walks:
            if effect.unknown is None:
                out.append(effect)
            else:
                slow = effect.oscillates and looked_for
                values = slow_hz(result.fit, effect) if slow else effect.unknown.grid(2.0)
                out += [effect.at(value) for value in values]
    return out


def _by_name(found: Iterable[Candidate]) -> dict[str, list[Candidate]]:
    spaces = dict[str, list[Candidate]]()
    for candidate in found:
        spaces.setdefault(str(candidate.effect), []).append(candidate)
    return spaces


def outside(task: Task) -> Outcome:
    """An effect of no catalogue; overlap: the part of it that one known effect can mimic.

    Of an effect of 100 sigma, so that noise does not matter, and of all its 100 sigma: what the dwells' means show of
    it is less where it goes on within dwells. The noise is the truth's, not what so large an effect makes of it.
    """
    large = dataclasses.replace(task, hidden=tuple(f"{name}={_LARGE}sigma" for name in task.names))
    truth = simulated(large, Path("large.mcap"))
    spaces, residual = _scanned(Path("large.mcap"), None, truth["noise"]["white_mps2"])
    falls = {name: max(float(np.sum((each.basis.T @ residual) ** 2)) for each in own) for name, own in spaces.items()}
    nearest = max(falls, key=lambda name: falls[name])
    overlap = min(1.0, math.sqrt(falls[nearest]) / truth["effects"][0]["size_sigma"])
    outcome = diagnosed(task)
    outcome.extra.update(overlap=overlap, nearest=nearest)
    return outcome


def pair(task: Task) -> Outcome:
    """Two effects at once; overlap: cosine of the smallest angle between what each can do."""
    outcome = diagnosed(task)
    spaces = candidates(Path("trial.mcap"), outcome.truth)
    one, other = (spaces.get(name, []) for name in outcome.truth)  # none of what has no columns, as a random walk
    outcome.extra["overlap"] = max((a.overlap(b) for a, b in itertools.product(one, other)), default=0.0)
    return outcome


@lru_cache(maxsize=256)
def stated_sizes(task: Task) -> dict[str, tuple[float, int, int]]:
    """Of a run with nothing hidden: the smallest size stated for each effect; of which coefficient, of how many."""
    path = Path("clean.mcap")
    simulated(task, path)
    said = run("diagnose", str(path), "--json")["detectable"]
    spaces, out = candidates(path), dict[str, tuple[float, int, int]]()
    for each in said:
        own = spaces.get(each["effect"], [])  # none of an oscillation: its frequency is not one of a grid
        if len(own) == 1:  # the value of an unknown that the size holds for is not stated
            lengths = np.linalg.norm(own[0].columns, axis=0)
            lengths[own[0].hidden | (lengths == 0.0)] = np.inf
            out[each["effect"]] = each["minimum"], int(np.argmin(lengths)), len(lengths)
    return out


def power(task: Task) -> Outcome:
    """The worst coefficient at the smallest size stated, the others zero: is anything noticed?

    By the test that ``diagnose`` begins with; to name what it has noticed takes it most of its time.
    """
    from kf_calib.diagnosis.candidate_tests import assess_candidates

    (name,) = task.hidden
    stated = stated_sizes(dataclasses.replace(task, hidden=()))
    if name not in stated:
        return Outcome(task, task.names, error=f"{name}: no smallest size of one coefficient is stated")
    size, worst, count = stated[name]
    if count != len(catalogue()[name.partition(":")[0]].coefficients):
        return Outcome(task, task.names, error=f"{name}: its coefficients are not those of the truth")
    sizes = [repr(size) if k == worst else "0" for k in range(count)]
    path, times = Path("trial.mcap"), dict[str, float]()
    effects = simulated(dataclasses.replace(task, hidden=(f"{name}={','.join(sizes)}",)), path, times)["effects"]
    with _timed(times, "notice"):
        test = assess_candidates(calibrate(Recording(path)).fit)
    extra = {"sizes": [effect["size_sigma"] for effect in effects], "size": size, "worst": worst}
    return Outcome(task, task.names, consistent=test.consistent, p_value=test.p_value, extra=extra, seconds=times)


def invisible(task: Task) -> Outcome:
    """What a clean run calls invisible, against what the truth adds beside the twelve (the rank of its Jacobian)."""
    path = Path("clean.mcap")
    simulated(task, path)
    said = run("diagnose", str(path), "--json")
    kinds = [kind for kind in known_kinds() if kind.counted is None]
    texts = tuple(f"{kind.name}={_largest(kind)!r}" for kind in kinds)
    truth = simulated(dataclasses.replace(task, hidden=texts), Path("all.mcap"))["effects"]
    unseen = {effect["name"] for effect in truth if effect["size_sigma"] is None}
    known = {each["effect"] for each in run("effects", "--json")["effects"]} & {effect["name"] for effect in truth}
    differ = sorted((unseen & known) ^ (set(said["invisible"]) & known))
    return Outcome(task, invisible=tuple(said["invisible"]), extra={"differ": differ, "unseen": sorted(unseen)})


def _largest(kind: Kind) -> float:
    """A size at which it shows where it ever does: of a dead zone the widest that is looked for."""
    from kf_calib.effects.sensor import DeadZone

    return DeadZone.unknown.high if kind.name == DeadZone.name else kind.typical("navigation")[1]


def known_kinds() -> list[Kind]:
    """Kinds of the catalogue that have a size in sigma."""
    return [kind for kind in catalogue().values() if kind.known and kind.stage != "record"]


def improve(task: Task) -> Outcome:
    """``improve``, and the model it arrives at, fitted to a second run: the twelve and their sigmas against the truth.

    In the second run, of which the selection knows nothing, sensors, orientations and noise are other ones.
    """

    path, again, times = Path("trial.mcap"), Path("again.mcap"), dict[str, float]()
    effects = simulated(task, path, times)["effects"]
    with _timed(times, "improve"):
        said = run("improve", str(path), "--json")
    known, model = tuple(effect["name"] for effect in effects), tuple(said["model"])
    same = _meaning_the_same(task, path, effects, model)
    told = simulated(dataclasses.replace(task, seed=task.seed + _SECOND), again)
    truth = told.get("parameters_at_end", told["parameters"])  # where biases walk, theirs are those at the end
    estimate = calibrate(Recording(again), Settings(effects=model)).estimate
    error = estimate.parameters - np.array(list(truth.values()))
    held_out, floor = said["held_out_rms_mps2"], said["held_out_floor_mps2"]
    extra = {
        "stopped": said["stopped_because"],
        "nees": float(error @ np.linalg.solve(estimate.parameter_covariance, error)),
        "inside": int(np.sum(np.abs(error) < 1.96 * estimate.sigma)),
        "held_out": held_out / floor if held_out and floor else None,
    }
    first = model[0] if model else "unknown" if said["stopped_because"] == "unknown" else None
    return Outcome(task, known, first, model, (), same, extra=extra, seconds=times)


def advice(task: Task, advised: int = 4, random: int = 12) -> Outcome:
    """Twelve orientations, an ambiguous pair: how far apart, in sigma, after the advised and after random ones.

    Fewer than four where nothing more is advised.
    """
    from kf_calib.sources.simulation.visit_plans import spread_plan

    rows = [visit.gimbal_deg for visit in spread_plan(_FEW, seed=task.seed)]
    truth, said = _on_plan(task, rows)
    rivals = [name for name in said["ambiguity_set"] if name != truth["name"]]
    if said["missing"] in (None, "unknown") or not rivals or truth["name"] not in said["ambiguity_set"]:
        return Outcome(task, task.names, said["missing"], error="not ambiguous to begin with")
    fixed, here, more = _sized(task, truth, 1.0), said, list(rows)
    count = 0
    while count < advised and here["next_orientation"] is not None:
        next_ = here["next_orientation"]
        more += [tuple(next_["gimbal_deg"])] * max(1, round((next_["stay_s"] or 0.0) / _DWELL_S))
        count += 1
        _, here = _on_plan(fixed, more)
    others = [visit.gimbal_deg for visit in spread_plan(random, seed=task.seed + _SECOND)]
    plans = {"before": rows, "advised": more, "random": [*rows, *others]}
    apart = {which: _separation(task, truth, rivals, plan) for which, plan in plans.items()}
    if not apart["random"]:
        return Outcome(task, task.names, said["missing"], error="only process noise to be told from: it has no columns")
    extra = {**apart, "rivals": rivals, "count": count, "dwells": len(more) - len(rows)}
    return Outcome(task, task.names, said["missing"], ambiguity=tuple(said["ambiguity_set"]), extra=extra)


def ideal(task: Task) -> Outcome:
    """How often the likeliest effect is the right one where all but the readings is known beforehand; and where, beside
    that, dwells may scatter by more than is stated."""
    path = Path("clean.mcap")
    simulated(task, path)
    spaces, constants, walk, scatter = _possible(path)
    alike = {
        (a, b)
        for a, b in itertools.product(spaces, spaces)
        if a == b or any(itertools.starmap(_one_space, itertools.product(spaces[a], spaces[b])))
    }
    same = {name: {b for a, b in alike if a == name} for name in spaces} | {_WALK: {_WALK}}
    effects: dict[str, Effect] = {
        name: Columns([each.basis for each in own], [constants[name].basis] if name in constants else [])
        for name, own in spaces.items()
    }
    effects[_WALK] = walk
    apart = [
        (a, b)
        for a, b in itertools.combinations(spaces, 2)
        if max(itertools.starmap(Candidate.overlap, itertools.product(spaces[a], spaces[b]))) < _APART
    ]
    apart += [(name, _WALK) for name in spaces]
    extra: dict[str, Any] = {
        f"{size}{words}": best_possible(effects, same, size, seed=task.seed, rivals=rivals)
        for size in _SIZES
        for words, rivals in (("", {}), (_SCATTERING, {"scatter": scatter}))
    }
    extra["pairs"] = best_possible_pairs(effects, same, _PAIR_SIZE, apart, seed=task.seed)
    return Outcome(task, extra=extra)


def _possible(path: Path) -> tuple[dict[str, list[Candidate]], dict[str, Candidate], Process, Process]:
    """Columns of the visible effects of a run; those of them at the constant they are hidden with, where they have one;
    a random walk of the biases from dwell to dwell, and scatter of dwells, in the same frame."""
    result = _calibrated(path)
    bench, middles_s = result.model.bench, np.array([0.5 * (d.start_s + d.end_s) for d in result.fit.dwells])
    steps = [effect_named(f"step = t > {at:.3f}*s", bench) for at in 0.5 * (middles_s[1:] + middles_s[:-1])]
    grids = _with_columns(result)
    inner = {name: catalogue()[name.split(":")[0]].inner for name in {str(each) for each in grids}}
    constants = [effect_named(name, bench).at(own["tau"]) for name, own in inner.items() if "tau" in own]
    found = scan(result.fit.carried, result.noise.judging, [*grids, *constants, *steps]).candidates
    seen = [each for each in found[: len(grids)] if each.dof]
    hidden = {str(each.effect): each for each in found[len(grids) : -len(steps)] if each.dof}
    after = np.array([each.columns for each in found[-len(steps) :]])  # (D - 1, d, 3), of each channel from a dwell on
    walk = after * np.sqrt(np.diff(middles_s))[:, None, None]
    none = np.zeros_like(after[:1])  # of all dwells: a bias
    alone = np.concatenate([none, after]) - np.concatenate([after, none])
    walks, scatters = (Process(np.concatenate(list(each), axis=1)) for each in (walk, alone))
    return _by_name(seen), hidden, walks, scatters


def _on_plan(task: Task, rows: Sequence[Sequence[float]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The one hidden effect and the diagnosis of a run through these orientations."""
    truth = _through(task, rows, Path("few.mcap"))
    return truth["effects"][0], run("diagnose", "few.mcap", "--json")


def _through(task: Task, rows: Sequence[Sequence[float]], path: Path) -> dict[str, Any]:
    np.savetxt("plan.csv", rows, delimiter=",")
    return simulated(dataclasses.replace(task, options=("--plan", "plan.csv")), path)


def _sized(task: Task, truth: dict[str, Any], factor: float) -> Task:
    """With the effect as large as it was, times ``factor``, whatever the orientations are."""
    sizes = ",".join(repr(factor * size) for size in truth["sizes"].values())
    return dataclasses.replace(task, hidden=(f"{truth['name']}={sizes}",))


def _separation(task: Task, truth: dict[str, Any], rivals: Sequence[str], rows: Sequence[Sequence[float]]) -> float:
    """What of the hidden effect neither the twelve nor a rival explain, in sigma; the smallest over the rivals.

    Of an effect a hundred times as large, so that noise does not matter.
    """
    noise = _through(_sized(task, truth, _LARGE), rows, Path("large.mcap"))["noise"]
    spaces, signal = _scanned(Path("large.mcap"), [truth["name"], *rivals], noise["white_mps2"], looked_for=True)
    others = [each.basis for name in rivals for each in spaces.get(name, [])]  # none of a random walk
    return min((float(np.linalg.norm(signal - basis @ (basis.T @ signal))) for basis in others), default=0.0) / _LARGE


def confusable(names: Sequence[str]) -> list[str]:
    """Effects that another one nearly mimics in a dozen orientations."""
    from kf_calib.sources.simulation.visit_plans import spread_plan

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        _through(Task("", "", 1), [visit.gimbal_deg for visit in spread_plan(_FEW, seed=1)], Path("few.mcap"))
        spaces = {name: own for name, own in candidates(Path("few.mcap")).items() if name in names}
    pairs = itertools.permutations(spaces, 2)
    near = {
        a for a, b in pairs if _LIKE < max(p.overlap(q) for p, q in itertools.product(spaces[a], spaces[b])) < _SAME
    }
    return [name for name in names if name in near]


_BESIDE_THE_TWELVE = {"magnetic": ";up=0"}
"""Without the part that is exactly a change of the twelve: of these, the truth says what they were without it."""

PLAYS: dict[str, Callable[[Task], Outcome]] = {
    "diagnose": diagnosed, "outside": outside, "pair": pair, "power": power, "invisible": invisible,
    "improve": improve, "advice": advice, "ideal": ideal,
}  # fmt: skip


# --- which trials ----------------------------------------------------------------------------------------------------


def visible_effects(options: tuple[str, ...] = ()) -> list[str]:
    """Names that this kind of run shows and that can be hidden: the stated ones that are not called invisible."""
    clean = Task("", "", 1, (), options)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        simulated(clean, Path("clean.mcap"))
        unseen = set(run("diagnose", "clean.mcap", "--json")["invisible"])
    hideable = {kind.name: kind for kind in known_kinds()}
    names = [each["effect"] for each in run("effects", "--json")["effects"]]
    kinds = {name: hideable[name.split(":")[0]] for name in names if name.split(":")[0] in hideable}
    return [n for n, kind in kinds.items() if n not in unseen or (kind.counted and _has_size(clean, n))]


def _has_size(task: Task, name: str) -> bool:
    """What comes with the effect makes it visible."""
    return not played(dataclasses.replace(task, play="diagnose", hidden=(f"{name}=10sigma",))).error


def outside_effects() -> list[str]:
    kinds = [kind for kind in catalogue().values() if not kind.known]
    return [
        f"{kind.name}:{axis}" if axis else kind.name for kind in kinds for axis in ("zx" if kind.per_axis else [""])
    ]


def tasks(
    families: Sequence[str], runs: int, seed: int, effects: Sequence[str] = (), setting: str = Task.setting
) -> list[Task]:
    """All trials, each with a seed of its own whatever else is asked for; ``effects``: only these are hidden."""
    needed = set(families) - {"noise", "invisible", "outside"}
    visible = list(effects) or (visible_effects() if needed else [])
    return [task for each in families for task in _family_tasks(each, runs, seed, effects, visible, setting)]


def _any_bench(drawn: np.random.Generator) -> tuple[tuple[str, ...], str, list[str]]:
    """Options of a bench unlike that of the other trials, its setting error, and its axes; its noise is stated."""

    def one(*values: str) -> str:
        return values[drawn.integers(len(values))]

    mems = drawn.random() < 0.5
    count, dwell_s, rate_hz, size = (
        one("12", "18", "24", "36"),
        one("10", "20", "60", "120"),
        one("4", "10", "40"),
        5e-5,
    )
    if float(count) * float(dwell_s) * float(rate_hz) > 90_000:
        rate_hz = "10"
    size *= 100.0 if mems else 1.0
    noises = (), (), ("--ar1", "0.5"), ("--ar1", "0.9"), ("--flicker", repr(size / 5)), ("--scatter", repr(size))
    axes = one("y z x", "y z x", "x y z", "z x", "y x")
    options = [
        "--grade", "mems" if mems else "navigation", "--orientations", count, "--dwell-s", dwell_s,
        "--sample-hz", rate_hz, "--angle-hz", one("1", "4", "10"), "--slew-degps", one("5", "20", "60"),
        "--temperature-swing", one("0", "2", "5", "10"), "--temperature-period-s", one("700", "3600"),
        "--warm-up-c", one("0", "4"), "--axes", axes, *noises[drawn.integers(len(noises))],
    ]  # fmt: skip
    if drawn.random() < 0.3:
        options += ["--encoder-sigma", one("0.0001", "0.001")]
    if drawn.random() < 0.2:
        options += ["--outlier-rate", "0.001", "--outlier-size", repr(100 * size)]
    return tuple(options), one("0", "0.002", "0.02") if mems else one("0", "0.0002", "0.002"), axes.split()


def _count(of: str, runs: int) -> range:
    return range(max(1, round(COUNTS[of] * runs)))


def _family_tasks(
    family: str, runs: int, seed: int, effects: Sequence[str], visible: Sequence[str], setting: str
) -> list[Task]:
    drawn, first = np.random.default_rng(seed), 10_000_000 * seed + 100_000 * FIGURES.index(family)
    made, numbers = list[Task](), itertools.count(first)

    def add(
        which: str, hidden: Sequence[str] = (), options: tuple[str, ...] = (), number: int | None = None,
        setting: str = setting,
    ) -> None:  # fmt: skip
        play = family if family in PLAYS else "diagnose"
        seed = next(numbers) if number is None else number
        made.append(Task(f"{family}@{which}", play, seed, tuple(hidden), options, setting))

    if family == "noise":
        for name, options in NOISES.items():
            for _ in _count(f"noise@{name}" if f"noise@{name}" in COUNTS else "noise", runs):
                add(name, options=options)
    elif family == "power":  # the sizes stated for one run serve all effects
        for round_, name in itertools.product(_count(family, runs), visible):
            add("stated", [name], number=first + round_)
    elif family == "ideal":
        for _ in _count(family, runs):
            add("any")
    elif family == "understated":
        for what, (options, own_setting) in UNDERSTATED.items():
            for _ in _count(family, runs):
                add(what, options=options, setting=own_setting)
    elif family == "invisible":
        for name, _ in itertools.product(PLANS, _count(family, runs)):
            add(name, options=PLANS[name])
    elif family == "pair":
        for _ in _count(family, runs) if len(visible) > 1 else ():
            add(f"{_PAIR_SIZE}", [f"{name}={_PAIR_SIZE}sigma" for name in drawn.choice(visible, 2, replace=False)])
    elif family == "benches":
        for number in _count(family, runs):
            options, own_setting, axes = _any_bench(drawn)
            name, _, place = str(drawn.choice(visible)).partition(":")
            hidden = f"{name}{f':{drawn.choice(axes)}' if place else ''}={drawn.choice(_BENCH_SIZES)}sigma"
            what, hides = ("nothing", []) if number % 3 == 0 else ("one", [hidden])
            add(f"other benches, {what} hidden", hides, options, setting=own_setting)
    elif family == "plans":
        for plan in ("six faces", "monotone", "six dwells"):
            for _ in _count("plans@nothing", runs):
                add(f"{plan}, nothing hidden", options=PLANS[plan])
            shown = list(effects) or (list(visible) if plan == "monotone" else visible_effects(PLANS[plan]))
            for effect, _ in itertools.product(shown, _count(family, runs)):
                add(f"{plan}, one hidden", [f"{effect}=10sigma"], PLANS[plan])
    else:
        sizes = {"name": _SIZES, "unstated": (10, _FAR), "outside": (15,), "improve": (15,), "advice": (8,)}[family]
        kinds = {"outside": outside_effects, "advice": lambda: list(effects) or confusable(visible)}
        hidden = kinds.get(family, lambda: visible)()
        options = NOISES["unstated"] if family == "unstated" else ()
        rest = _BESIDE_THE_TWELVE if family == "improve" else {}
        for size, name, _ in itertools.product(sizes, hidden, _count(family, runs)):
            add(str(size), [f"{name}={size}sigma{rest.get(name, '')}"], options)
    return made


# --- figures ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figure:
    """One line of the report. low, high: 95 % limits; bar: what is asked for; meets: None where not judged.

    refused: how many of the figure's family the program gave no answer to; each counts as not right.
    """

    name: str
    value: float
    low: float
    high: float
    count: int
    bar: str = ""
    meets: bool | None = None
    refused: int = 0


def rate(name: str, hits: Sequence[bool], least: float | None = None, most: float | None = None) -> Figure:
    """A share with its exact 95 % limits (Clopper, Pearson)."""
    from scipy.stats import binomtest

    if not hits:
        return Figure(name, float("nan"), 0.0, 1.0, 0, _bar(least, most), None)
    found = binomtest(sum(hits), len(hits)).proportion_ci(0.95, method="exact")
    value = sum(hits) / len(hits)
    judged = (least, most) != (None, None) and len(hits) >= _ENOUGH
    meets = (least or 0.0) <= value <= (1.0 if most is None else most) if judged else None
    return Figure(name, value, float(found.low), float(found.high), len(hits), _bar(least, most), meets)


def _bar(least: float | None, most: float | None) -> str:
    if least is not None and most is not None:
        return f"{least:.0%} to {most:.0%}"
    return f">= {least:.0%}" if least is not None else f"<= {most:.0%}" if most is not None else ""


def figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    """Every figure that these outcomes allow."""
    done = [each for each in outcomes if each.refused or not each.error]
    groups = dict[str, list[Outcome]]()
    for each in sorted(done, key=lambda each: FIGURES.index(each.task.family)):
        groups.setdefault(each.task.figure, []).append(each)
    out = list[Figure]()
    for figure, own in groups.items():
        refused = sum(each.refused for each in own)
        found = _FIGURES[own[0].task.family](figure.partition("@")[2], own)
        out += [dataclasses.replace(each, refused=refused) for each in found if each.count]
    blind = [each.named not in each.invisible for each in done if each.named]
    return (
        [*out, rate("a name that is given is not of an effect it calls invisible", blind, least=1.0)] if blind else out
    )


def alarmed(each: Outcome) -> bool:
    return each.refused or each.consistent is False


def _noise(which: str, own: list[Outcome]) -> Iterator[Figure]:
    alarms = rate(f"false alarm, {which}", [alarmed(each) for each in own], most=0.03)
    if which == "white":
        enough = alarms.count >= 1000
        alarms = dataclasses.replace(
            alarms, bar="<= 2 % (upper limit, of 1000)", meets=alarms.high <= 0.02 if enough else None
        )
    yield alarms
    yield rate(f"a name given, {which}", [each.named is not None for each in own])


def _name(which: str, own: list[Outcome]) -> Iterator[Figure]:
    least, worst = {"8": (0.93, 0.75), "10": (0.96, None), "15": (0.98, 0.90)}.get(which, (None, None))
    stated = "" if own[0].task.family == "name" else ", nothing stated"
    yield rate(f"right name first, n = {which}{stated}", [each.right for each in own], least)
    lowest, hits = _worst((each.truth[0], each.right) for each in own)
    yield rate(f"worst effect, n = {which}{stated}: {lowest}", hits, worst)
    given = [each for each in own if each.ambiguity or each.refused]
    yield rate(f"ambiguity set holds the truth, n = {which}{stated}", [each.held for each in given], 0.99)
    sizes = [len(each.ambiguity) for each in own if each.ambiguity]
    if sizes:
        size, (low, high) = float(np.median(sizes)), np.percentile(sizes, [2.5, 97.5])
        yield Figure(f"median size of the set, n = {which}{stated}", size, low, high, len(sizes), "1", size == 1.0)
    yield rate(f"wrong name, n = {which}{stated}", [each.wrong for each in own])


def _understated(which: str, own: list[Outcome]) -> Iterator[Figure]:
    said = f"{which} stated too small"
    yield rate(f"{said}: noticed", [each.consistent is False for each in own])
    yield rate(f"{said}: a name", [each.named is not None for each in own])
    yield rate(f"{said}: a name without saying that it may be scatter", [_undoubted(each) for each in own], most=0.05)


def _undoubted(each: Outcome) -> bool:
    return each.refused or (each.named is not None and not each.extra.get("may_be_scatter", False))


def _worst(found: Iterable[tuple[str, Hit]]) -> tuple[str, list[Hit]]:
    """The effect with the smallest share of hits, and its hits."""
    by_effect = _by_effect(found)
    lowest = min(by_effect, key=lambda name: (np.mean(by_effect[name]), name))
    return lowest, by_effect[lowest]


def _by_effect(found: Iterable[tuple[str, Hit]]) -> dict[str, list[Hit]]:
    out = dict[str, list[Hit]]()
    for name, hit in found:
        out.setdefault(name, []).append(hit)
    return out


def _power(_: str, own: list[Outcome]) -> Iterator[Figure]:
    found = [(each.truth[0], each.consistent is False) for each in own]
    yield rate("power at the stated size, all effects", [hit for _, hit in found], *_POWER)
    for name, hits in sorted(_by_effect(found).items()):
        each = rate(f"power at the stated size, {name}", hits, *_POWER)
        if each.meets is not None:  # of one effect there are never enough trials for 4 %: the limits must reach it
            each = dataclasses.replace(each, meets=each.low <= _POWER[1] and each.high >= _POWER[0])
        yield each


def _invisible(which: str, own: list[Outcome]) -> Iterator[Figure]:
    differ = sorted({name for each in own for name in each.extra.get("differ", ())})
    yield rate(f"invisible list exact, {which}" + f": not {', '.join(differ)}" * bool(differ),
               [not each.refused and not each.extra["differ"] for each in own], 1.0)  # fmt: skip


def overlap_of(each: Outcome) -> float:
    """0 where it was refused, so that it is judged."""
    return float(each.extra.get("overlap", 0.0))


def _outside(which: str, every: list[Outcome]) -> Iterator[Figure]:
    own = [each for each in every if overlap_of(each) < _APART]
    hits = [each.first == "unknown" for each in own]
    yield rate(f"outside the catalogue, n = {which}: unknown", hits, 0.90)
    if own:
        lowest, hits = _worst((each.truth[0], each.first == "unknown") for each in own)
        yield rate(f"outside the catalogue: unknown, worst effect: {lowest}", hits)
    yield rate("outside the catalogue: a wrong name", [each.named is not None for each in own], most=0.05)
    told = [each for each in own if each.first == "unknown" or each.refused]
    yield rate("outside the catalogue: driver right, of unknown", [driver_right(each) for each in told], 0.80)
    near = [each.first == "unknown" for each in every if overlap_of(each) >= _APART]
    yield rate(f"outside, but overlap >= {_APART}: unknown", near)


def driver_right(each: Outcome) -> bool:
    """What drives, without which of it: "angle of gimbal 2, 3 a turn" is "angle"."""
    said = each.extra.get("driver") or ""
    for end in (",", "(", " of gimbal"):
        said = said.split(end)[0]
    return not each.refused and said.strip() == each.extra["true_drivers"][0]


def _pair(which: str, every: list[Outcome]) -> Iterator[Figure]:
    own = [each for each in every if overlap_of(each) < _APART]
    yield rate(f"two at once, n = {which} each: both found", [each.found for each in own], 0.85)
    nothing_else = [each.nothing_else and not each.refused for each in own]
    yield rate("two at once: nothing else", nothing_else, 0.95)
    yield rate("two at once: one of them found", [any(map(each.means_truth, each.names)) for each in own])


def _plans(which: str, own: list[Outcome]) -> Iterator[Figure]:
    if "one hidden" in which:
        yield rate(f"{which}: a wrong name", [each.wrong for each in own], most=0.0)
        yield rate(f"{which}: noticed", [each.consistent is False for each in own])
        yield rate(f"{which}: right name first", [each.right for each in own])
    else:
        yield rate(f"{which}: false alarm", [alarmed(each) for each in own], most=0.03)
        yield rate(f"{which}: a name", [each.named is not None for each in own], most=0.01)


def _improve(which: str, own: list[Outcome]) -> Iterator[Figure]:
    settled = [each for each in own if each.extra.get("stopped") == "consistent"]
    yield rate(f"improve, n = {which}: ends consistent", [each in settled for each in own])
    ambiguous = [each.extra.get("stopped") == "ambiguous" for each in own]
    yield rate(f"improve, n = {which}: ends ambiguous", ambiguous)
    yield rate("after improve: the right effect and no other", [each.right and each.nothing_else for each in settled])
    ratios = [each.extra["held_out"] for each in settled if each.extra["held_out"]]
    if ratios:
        mean, (low, high) = float(np.mean(ratios)), np.percentile(ratios, [2.5, 97.5])
        yield Figure("after improve: held-out rms / floor, mean", mean, low, high, len(ratios), "<= 1.05", mean <= 1.05)
    yield from _covered("in a second run", settled)
    yield from _covered("in a second run, right effect", [each for each in settled if each.right], judged=False)


def _covered(where: str, own: list[Outcome], judged: bool = True) -> Iterator[Figure]:
    """Errors of the twelve against their covariance; the limits of the NEES are those of its mean, were it right."""
    from scipy.stats import chi2

    if own:
        nees, count = float(np.mean([each.extra["nees"] for each in own])), len(own)
        low, high = chi2.ppf([0.025, 0.975], 12 * count) / count
        meets = bool(low <= nees <= high) if judged and count >= _ENOUGH else None
        bar = "in its 95 % band" if judged else ""
        yield Figure(f"after improve, {where}: NEES of the twelve, mean", nees, low, high, count, bar, meets)
        hits = [k < each.extra["inside"] for each in own for k in range(12)]
        bars = (0.92, 0.98) if judged else (None, None)
        yield rate(f"after improve, {where}: 95 % intervals cover", hits, *bars)


def _advice(_: str, own: list[Outcome]) -> Iterator[Figure]:
    for most, words in ((ENOUGH, f", up to {ENOUGH:g} sigma"), (math.inf, "")):
        pairs = [[min(each.extra.get(key, 0.0), most) for key in ("advised", "random")] for each in own]
        ratios = [advised / max(random, 1e-9) for advised, random in pairs]
        yield rate(f"4 advised separate an ambiguous pair as well as 12 random{words}", [x >= 1.0 for x in ratios])
        median, (low, high) = float(np.median(ratios)), np.percentile(ratios, [2.5, 97.5])
        bar = (">= 1", median >= 1.0 if len(own) >= _ENOUGH else None) if most == math.inf else ("", None)
        yield Figure(f"separation, 4 advised / 12 random, median{words}", median, low, high, len(own), *bar)
    times = [each.extra["dwells"] / 12.0 for each in own if "dwells" in each.extra]
    if times:
        low, high = np.percentile(times, [2.5, 97.5])
        yield Figure(
            "time the 4 advised take, in that of 12 random, median", float(np.median(times)), low, high, len(times)
        )


def _ideal(_: str, own: list[Outcome]) -> Iterator[Figure]:
    for size, words in itertools.product(map(str, _SIZES), ("", _SCATTERING)):
        shares = [each.extra[size + words] for each in own if size + words in each.extra]
        if not shares:
            continue
        said = f"n = {size}{words}"
        runs = [float(np.mean(list(each.values()))) for each in shares]
        yield Figure(f"right name first, {said}: the most there can be", *_mean_and_range(runs), len(runs))
        lowest, hits = _worst((name, share) for each in shares for name, share in each.items())
        yield Figure(f"worst effect, {said}, the most there can be: {lowest}", *_mean_and_range(hits), len(hits))
        walks = [each[_WALK] for each in shares]
        yield Figure(f"{_WALK}, {said}: the most there can be", *_mean_and_range(walks), len(walks))
    hits = [(pair, right) for each in own for pair, right in each.extra.get("pairs", [])]
    for walks, words in ((False, ""), (True, ", a walk of the biases being one")):
        shown = [right for pair, right in hits if _WALK in pair or not walks]
        if shown:
            yield rate(f"two at once{words}, both found and nothing else: the most there can be", shown)


def _mean_and_range(values: Sequence[float]) -> tuple[float, float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(np.mean(values)), float(low), float(high)


_FIGURES: dict[str, Callable[[str, list[Outcome]], Iterator[Figure]]] = {
    "noise": _noise, "name": _name, "unstated": _name, "power": _power, "invisible": _invisible, "outside": _outside,
    "pair": _pair, "plans": _plans, "improve": _improve, "advice": _advice, "ideal": _ideal,
    "benches": _plans, "understated": _understated,
}  # fmt: skip


def failed(each: Outcome) -> bool:
    """Not what was hoped for: to be looked at."""
    family, close = each.task.family, overlap_of(each) >= _APART
    if each.error:
        return each.refused
    if family in ("noise", "plans", "benches") and not each.truth:
        return alarmed(each)
    if family == "outside":
        return not close and not (each.first == "unknown" and driver_right(each))
    return {
        "name": not each.right, "unstated": not each.right, "plans": each.wrong, "benches": each.wrong,
        "power": False, "understated": _undoubted(each),
        "invisible": bool(each.extra.get("differ")),
        "pair": not close and not (each.found and each.nothing_else), "improve": not each.right,
        "advice": each.extra.get("advised", 1.0) < each.extra.get("random", 0.0),
    }.get(family, False)  # fmt: skip


# --- report ----------------------------------------------------------------------------------------------------------


def confusion(outcomes: Sequence[Outcome], figure: str | None = None) -> dict[str, Counter[str]]:
    """What was named first for each hidden effect.

    Names that mean the same count as the hidden one's, and so does ``unknown`` for what is in no catalogue.
    """
    out = dict[str, Counter[str]]()
    for each in outcomes:
        judged = each.refused or not each.error
        if not judged or len(each.truth) > 1 or each.task.family not in ("noise", "name", "unstated", "outside"):
            continue
        if figure in (None, each.task.figure):
            true = each.truth[0] if each.truth else "(nothing)"
            right = each.right or (each.task.family == "outside" and each.first == "unknown")
            said = true if right else "(refused)" if each.refused else each.first or "(nothing)"
            out.setdefault(true, Counter())[said] += 1
    return out


def effect_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Of each effect that was hidden, in words: trials, what was right of them, and what was named instead."""
    judged = [each for each in outcomes if (each.refused or not each.error) and len(each.truth) == 1]
    heads = {
        "name@8": "8",
        "name@10": "10",
        "name@15": "15",
        "unstated@10": "nothing stated, 10",
        f"unstated@{_FAR}": f"nothing stated, {_FAR}",
        "outside@15": "unknown",
    }
    rows = [["hidden", *(f"right, {head}" for head in heads.values()), "set holds it", "power", "named instead"]]
    said = confusion([each for each in judged if each.task.family != "outside" or overlap_of(each) < _APART])
    for true in dict.fromkeys(each.truth[0] for each in judged):
        own = [each for each in judged if each.truth[0] == true]
        named = {figure: [each for each in own if each.task.figure == figure] for figure in heads}
        right = [
            [e.first == "unknown" if e.task.family == "outside" else e.right for e in each] for each in named.values()
        ]
        given = [each.held for each in own if each.task.family in ("name", "unstated") and each.ambiguity]
        noticed = [each.consistent is False for each in own if each.task.family == "power"]
        others = [f"{name} {count}" for name, count in said.get(true, Counter()).most_common() if name != true]
        rows.append([true, *map(_share, [*right, given, noticed]), ", ".join(others)])
    rows[1:] = [row for row in rows[1:] if any(row[1:])]
    used = [k for k in range(len(rows[0])) if k == 0 or any(row[k] for row in rows[1:])]
    return [[row[k] for k in used] for row in rows]


def _share(hits: Sequence[bool]) -> str:
    return f"{sum(hits)}/{len(hits)}" if hits else ""


def figure_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Figures in words."""
    rows = [["figure", "value", "95 % limits", "trials", "refused", "asked for", ""]]
    for each in figures(outcomes):
        mark = {True: "met", False: "missed", None: ""}[each.meets]
        limits, refused = f"{each.low:.3f} to {each.high:.3f}", str(each.refused) if each.refused else ""
        rows.append([each.name, f"{each.value:.3f}", limits, str(each.count), refused, each.bar, mark])
    return rows


def notes(outcomes: Sequence[Outcome]) -> list[str]:
    """What gave no answer or could not be made, and what a trial takes."""
    errors = Counter((each.refused, f"{each.task.figure}: {each.error}") for each in outcomes if each.error)
    words = {True: "Refused", False: "Not judged"}
    return [*(f"{words[kind]}, {count} times: {text}" for (kind, text), count in errors.most_common()), _cost(outcomes)]


def report(outcomes: Sequence[Outcome]) -> Any:
    """Figures, then what was named for each effect, row by row: a matrix of forty columns fits no terminal."""
    from rich.console import Group
    from rich.table import Table

    tables = list[Table]()
    for title, rows in (("Figures", figure_rows(outcomes)), ("Hidden, and what was named", effect_rows(outcomes))):
        if len(rows) == 1:
            continue
        tables.append(Table(*rows[0], title=title, title_justify="left"))
        for row in rows[1:]:
            tables[-1].add_row(*(f"[bold red]{cell}" if cell == "missed" else cell for cell in row))
    return Group(*tables, *notes(outcomes))


def markdown(outcomes: Sequence[Outcome]) -> str:
    """The same for docs/blind_trial.md."""
    tables = [
        "\n".join("| " + " | ".join(row) + " |" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:]))
        for rows in (figure_rows(outcomes), effect_rows(outcomes))
        if len(rows) > 1
    ]
    return "\n\n".join([*tables, *notes(outcomes)]) + "\n"


def _cost(outcomes: Sequence[Outcome]) -> str:
    """What a trial takes, by family."""
    spent = dict[str, list[float]]()
    for each in outcomes:
        spent.setdefault(each.task.family, []).append(sum(each.seconds.values()))
    words = [f"{family} {np.mean(own):.2f}" for family, own in spent.items() if any(own)]
    return f"Processor seconds a trial: {', '.join(words)}; in all {sum(map(sum, spent.values())):.0f}."


def save_picture(outcomes: Sequence[Outcome], path: Path) -> None:
    """The confusion matrix, shares of each row."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure as Sheet

    found = confusion(outcomes)
    rows = list(found)
    said = {name for counter in found.values() for name in counter}
    columns = [*(name for name in rows if name in said), *sorted(said - set(rows))]
    shares = np.array([[found[row][column] / found[row].total() for column in columns] for row in rows])
    sheet = Sheet(figsize=(2.5 + 0.22 * len(columns), 2.5 + 0.2 * len(rows)), layout="constrained")
    axes = sheet.add_subplot()
    image = axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden")
    sheet.colorbar(image, shrink=0.5, label="share of trials")
    sheet.savefig(path, dpi=100)
    if path.suffix == ".png":  # a palette: small enough for the repository
        from PIL import Image

        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


def save_failures(outcomes: Sequence[Outcome], path: Path) -> None:
    """A paragraph for each trial that went wrong, with the command that shows it; beside it their plans."""
    lines = list[str]()
    for each in filter(failed, outcomes):
        told = {key: value for key, value in each.extra.items() if key not in ("verdict", "true_drivers") and value}
        lines += [
            f"[{each.task.figure}] hidden {' + '.join(each.truth) or 'nothing'}; first {each.first}; "
            f"all {list(each.names)}; set {list(each.ambiguity)}; p {each.p_value}; wrong {each.wrong}; {told}",
            f"    {each.error or each.extra.get('verdict', '')}",
            f"    {each.task.command}",
        ]
        if each.task.plan:
            kind, _, number = each.task.plan.removesuffix(".csv").partition("-")
            np.savetxt(path.parent / each.task.plan, _orientations(kind, int(number)), delimiter=",")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def keep(task: Task, folder: Path) -> None:
    """Make a trial's recording again, and its plan, for a look at it."""
    name = f"{task.figure}-{task.seed}".replace(" ", "_").replace("/", "")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        simulated(task, Path("trial.mcap"))
        for made in Path().glob("trial.*"):
            shutil.move(made, folder / made.name.replace("trial", name, 1))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--runs", type=click.IntRange(min=1), default=4, show_default=True, help="Trials an effect and size.")
@click.option("--seed", type=click.IntRange(min=1), default=1, show_default=True, help="Of all trials.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Processes.")
@click.option("--only", multiple=True, type=click.Choice(FIGURES), help="Only this family of figures; repeatable.")
@click.option("--effect", "effects", multiple=True, help="Hide only this one of the catalogue; repeatable.")
@click.option(
    "--setting",
    type=click.FloatRange(min=0),
    default=float(Task.setting),
    show_default=True,
    help="Error of setting an orientation, deg.",
)
@click.option("--limit", type=click.IntRange(min=1), help="At most so many trials of each figure, spread evenly.")
@click.option("--resume", type=click.Path(path_type=Path), help="Outcomes as they come, JSON lines; gone on with.")
@click.option(
    "--pool",
    "pooled",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Outcomes of another run, for the same table; repeatable.",
)
@click.option("--no-trials", is_flag=True, help="Only the table of what --resume and --pool hold.")
@click.option("--markdown", "page", type=click.Path(path_type=Path), help="The tables, Markdown.")
@click.option("--out", type=click.Path(path_type=Path), help="All outcomes and figures, JSON.")
@click.option("--picture", type=click.Path(path_type=Path), help="The confusion matrix, PNG or SVG.")
@click.option("--failures", type=click.Path(path_type=Path), help="What went wrong, with commands to see it again.")
@click.option("--keep", "kept", type=click.Path(path_type=Path), help="Folder for recordings of what went wrong.")
def main(
    runs: int,
    seed: int,
    jobs: int,
    only: tuple[str, ...],
    effects: tuple[str, ...],
    setting: float,
    limit: int | None,
    resume: Path | None,
    pooled: tuple[Path, ...],
    no_trials: bool,
    page: Path | None,
    out: Path | None,
    picture: Path | None,
    failures: Path | None,
    kept: Path | None,
) -> None:
    """Blind trial of the diagnosis."""
    from rich.console import Console

    earlier = [each for path in [*pooled, *([resume] if resume and resume.exists() else [])] for each in read(path)]
    todo = [] if no_trials else thinned(tasks(only or FIGURES, runs, seed, effects, f"{setting:g}"), limit)
    outcomes = {each.task: each for each in earlier}
    left = [task for task in todo if task not in outcomes]
    np.random.default_rng(seed).shuffle(left)  # so that a part of them is already a trial of everything
    outcomes |= {each.task: each for each in _all(left, jobs, resume)}
    outcomes = sorted(outcomes.values(), key=lambda each: each.task.seed)
    Console(width=None if sys.stdout.isatty() else 140).print(report(outcomes))
    if out:
        content = {
            "seed": seed, "runs": runs, "figures": [dataclasses.asdict(each) for each in figures(outcomes)],
            "confusion": confusion(outcomes), "outcomes": [dataclasses.asdict(each) for each in outcomes],
        }  # fmt: skip
        out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if page:
        page.write_text(markdown(outcomes), encoding="utf-8")
    if picture:
        save_picture(outcomes, picture)
    if failures:
        save_failures(outcomes, failures)
    if kept:
        for each in filter(failed, outcomes):
            keep(each.task, kept.absolute())


def thinned(every: list[Task], limit: int | None) -> list[Task]:
    """At most ``limit`` tasks of each figure."""
    if limit is None:
        return every
    groups = dict[str, list[Task]]()
    for task in every:
        groups.setdefault(task.figure, []).append(task)
    return [own[k] for own in groups.values() for k in np.unique(np.linspace(0, len(own) - 1, limit).astype(int))]


def read(path: Path) -> list[Outcome]:
    """Outcomes of a file of JSON lines; a last line that was cut short is passed over."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [Outcome.read(json.loads(line)) for line in lines if line.endswith("\n")]


def _all(todo: Sequence[Task], jobs: int, path: Path | None = None) -> Iterator[Outcome]:
    """Outcomes as they come, each written to ``path``, with a bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    quiet = not sys.stderr.isatty()
    with _outcomes(todo, jobs) as made, _appending(path) as write:
        for outcome in track(made, "trials", len(todo), console=Console(stderr=True), disable=quiet):
            write(json.dumps(dataclasses.asdict(outcome)) + "\n")
            yield outcome


@contextlib.contextmanager
def _outcomes(todo: Sequence[Task], jobs: int) -> Iterator[Iterable[Outcome]]:
    if jobs == 1:
        yield map(played, todo)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield (done.result() for done in as_completed([pool.submit(played, task) for task in todo]))


@contextlib.contextmanager
def _appending(path: Path | None) -> Iterator[Callable[[str], object]]:
    """Writes lines at the end of a file, each at once; after a line that was cut short, over it."""
    if path is None:
        yield lambda line: None
        return
    with path.open("a+b") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)

        def write(line: str) -> None:
            file.write(line.encode())
            file.flush()

        yield write


if __name__ == "__main__":
    main()
