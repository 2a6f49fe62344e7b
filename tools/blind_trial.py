"""Blind trial: recordings with a hidden effect through the command line, and how often the program is right.

usage: .venv/bin/python tools/blind_trial.py [--runs N] [--seed S] [--only FIGURE ...] [--out FILE] [--picture FILE]

Each trial is made by ``simulate`` (the nonlinear truth), told by ``diagnose --json`` or ``improve --json``, and judged
by the truth in the side file. A name is right where it is the hidden effect's, or one that spans the same space of
readings in this run, worked out from the recording. ``--runs``: trials for each effect and size; noise alone takes 40
times as many. Development runs use small seeds; a release is reported with a seed of its own, of six digits.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: a process a core is enough

import contextlib
import dataclasses
import io
import itertools
import json
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import click
import numpy as np

from kf_calib.errors import KfCalibError
from kf_calib.scan import Candidate
from kf_calib.sources.hidden import Kind, NoSizeError, catalogue

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
PLANS = {
    "six faces": ("--plan", "faces"),
    "monotone": ("--plan", "monotone"),
    "six dwells": ("--orientations", "6"),
}
FIGURES = ("noise", "name", "unstated", "power", "invisible", "outside", "pair", "plans", "improve", "advice")
_SAME = 1.0 - 1e-6
_APART = 0.7
_ENOUGH = 20  # trials; fewer are shown and not judged


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

    def simulate(self, path: Path | str, *more: str) -> list[str]:
        """Words of the command line that makes the recording."""
        hidden = [word for text in self.hidden for word in ("--hide", text)]
        return [
            "simulate",
            str(path),
            *BENCH,
            "--setting",
            self.setting,
            *self.options,
            "--seed",
            str(self.seed),
            *hidden,
            *more,
            "--json",
        ]

    @property
    def command(self) -> str:
        """To see it again."""
        told = "improve" if self.play == "improve" else "diagnose"
        return f"kf-calib {shlex.join(self.simulate('t.mcap', '--overwrite')[:-1])} && kf-calib {told} t.mcap"


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was said of it.

    truth: names hidden; same: pairs of a hidden name and a name said that mean the same in this run; extra: what the
    figure needs beside. error: why there is nothing to judge.
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
    with tempfile.TemporaryDirectory() as folder:
        try:
            with contextlib.chdir(folder):
                _make_plan(task)
                return PLAYS[task.play](task)
        except NoSizeError as error:
            return Outcome(task, error=str(error))
        except KfCalibError as error:  # a recording that the program refuses to judge is a failure of it
            return Outcome(task, error=str(error), extra={"refused": True})


def _make_plan(task: Task) -> None:
    """The plan ``monotone``, beside the recording: the spread one, in the order of its middle angle."""
    from kf_calib.sources.plans import spread_plan

    if "monotone" in task.options:
        angles = sorted((visit.gimbal_deg for visit in spread_plan(24, seed=task.seed)), key=lambda row: row[1])
        np.savetxt("monotone", angles, delimiter=",")


def diagnosed(task: Task) -> Outcome:
    """Simulate, diagnose, compare with the side file."""
    path, times = Path("trial.mcap"), dict[str, float]()
    with _timed(times, "simulate"):
        run(*task.simulate(path))
    with _timed(times, "diagnose"):
        said = run("diagnose", str(path), "--json")
    effects = json.loads(path.with_suffix(".truth.json").read_text())["effects"]
    missing = said["missing"]
    names = tuple(said.get("all_missing") or ([missing] if missing and missing != "unknown" else []))
    known = tuple(effect["name"] for effect in effects)
    with _timed(times, "judge"):
        same = _meaning_the_same(path, known, {*names, *said["ambiguity_set"]})
    return Outcome(
        task, known, missing, names, tuple(said["ambiguity_set"]), same, said["consistent"], said["p_value"],
        tuple(said["invisible"]),
        {
            "verdict": said["verdict"],
            "driver": (said["unknown"] or {}).get("driver"),
            "true_drivers": [effect["driver"] for effect in effects],
            "sizes": [effect["size_sigma"] for effect in effects],
        },
        times,
    )  # fmt: skip


@contextlib.contextmanager
def _timed(times: dict[str, float], part: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    times[part] = time.perf_counter() - start


def _meaning_the_same(path: Path, truth: Sequence[str], said: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Pairs of a hidden name and a name said that span the same readings beside the twelve parameters."""
    others = sorted(set(said) - set(truth))
    pairs = {(name, name) for name in truth}
    if truth and others:
        spaces = candidates(path, [*truth, *others])
        pairs |= {
            (true, other)
            for true, other in itertools.product(truth, others)
            if any(_one_space(a, b) for a, b in itertools.product(spaces.get(true, []), spaces.get(other, [])))
        }
    return tuple(sorted(pairs))


def _one_space(one: Candidate, other: Candidate) -> bool:
    if one.dof != other.dof or not one.dof:
        return False
    return float(np.linalg.svd(one.basis.T @ other.basis, compute_uv=False).min()) > _SAME


def candidates(path: Path, wanted: Sequence[str] | None = None) -> dict[str, list[Candidate]]:
    """Columns of effects in a recording beside what the twelve absorb; one with an unknown at the values of a grid."""
    return _scanned(path, wanted)[0]


def _scanned(path: Path, wanted: Sequence[str] | None) -> tuple[dict[str, list[Candidate]], Any, float]:
    """Candidates by name, the residual in their frame, and chi-squared of the whole misfit."""
    from kf_calib.calibration import calibrate
    from kf_calib.effects import effect_named, names
    from kf_calib.scan import scan
    from kf_calib.sources.recording import Recording

    result = calibrate(Recording(path))
    fitted, bench = result.fit, result.model.bench
    effects = list[Any]()
    for name in names(bench):
        effect = effect_named(name, bench)
        if (wanted is None or name in wanted) and not effect.dynamic and not effect.walks:
            effects += [effect] if effect.unknown is None else [effect.at(value) for value in effect.unknown.grid(2.0)]
    found = scan(fitted.carried, fitted.noise.judging, effects)
    spaces = dict[str, list[Candidate]]()
    for candidate in found.candidates:
        spaces.setdefault(str(candidate.effect), []).append(candidate)
    return spaces, found.residual, result.consistency.statistic


def outside(task: Task) -> Outcome:
    """An effect of no catalogue; overlap: the largest share of it that one known effect can mimic, at 100 sigma."""
    large = dataclasses.replace(task, hidden=tuple(f"{text.partition('=')[0]}=100sigma" for text in task.hidden))
    path = Path("large.mcap")
    run(*large.simulate(path))
    spaces, residual, misfit = _scanned(path, None)
    shares = {
        name: max(float(np.sum((each.basis.T @ residual) ** 2)) for each in own) / misfit
        for name, own in spaces.items()
    }
    nearest = max(shares, key=lambda name: shares[name])
    outcome = diagnosed(task)
    outcome.extra.update(overlap=float(np.sqrt(shares[nearest])), nearest=nearest)
    return outcome


def pair(task: Task) -> Outcome:
    """Two effects at once; overlap: cosine of the smallest angle between what each can do."""
    outcome = diagnosed(task)
    spaces = candidates(Path("trial.mcap"), outcome.truth)
    one, other = (spaces.get(name, []) for name in outcome.truth)  # none of what has no columns, as a random walk
    outcome.extra["overlap"] = max((a.overlap(b) for a, b in itertools.product(one, other)), default=0.0)
    return outcome


@lru_cache(maxsize=4)
def stated_sizes(task: Task) -> dict[str, dict[str, float]]:
    """Of a run with nothing hidden: the smallest size stated for each effect, and which coefficient it is of."""
    path = Path("clean.mcap")
    run(*task.simulate(path))
    said = run("diagnose", str(path), "--json")["detectable"]
    spaces, out = candidates(path), dict[str, dict[str, float]]()
    for each in said:
        own = spaces[each["effect"]]
        if len(own) == 1:  # the value of an unknown that the size holds for is not stated
            lengths = np.linalg.norm(own[0].columns, axis=0)
            lengths[own[0].hidden | (lengths == 0.0)] = np.inf
            worst = int(np.argmin(lengths))
            out[each["effect"]] = {"size": each["minimum"], "worst": worst, "count": len(lengths)}
    return out


def power(task: Task) -> Outcome:
    """The worst coefficient at the smallest size stated, the others zero."""
    (name,) = task.hidden
    stated = stated_sizes(dataclasses.replace(task, hidden=()))
    if name not in stated:
        return Outcome(task, error=f"{name}: no smallest size of one coefficient is stated")
    sizes = ["0"] * int(stated[name]["count"])
    sizes[int(stated[name]["worst"])] = repr(stated[name]["size"])
    return diagnosed(dataclasses.replace(task, hidden=(f"{name}={','.join(sizes)}",)))


def invisible(task: Task) -> Outcome:
    """What a clean run calls invisible, against what the truth adds beside the twelve (the rank of its Jacobian)."""
    path = Path("clean.mcap")
    run(*task.simulate(path))
    said = run("diagnose", str(path), "--json")
    kinds = [kind for kind in known_kinds() if not kind.accompanied]
    texts = tuple(f"{kind.name}={kind.typical('navigation')[1]!r}" for kind in kinds)
    run(*dataclasses.replace(task, hidden=texts).simulate(Path("all.mcap")))
    truth = json.loads(Path("all.truth.json").read_text())["effects"]
    unseen = {effect["name"] for effect in truth if effect["size_sigma"] is None}
    known = {each["effect"] for each in run("effects", "--json")["effects"]} & {effect["name"] for effect in truth}
    differ = sorted((unseen & known) ^ (set(said["invisible"]) & known))
    return Outcome(task, invisible=tuple(said["invisible"]), extra={"differ": differ, "unseen": sorted(unseen)})


def known_kinds() -> list[Kind]:
    """Kinds of the catalogue that have a size in sigma."""
    return [kind for kind in catalogue().values() if kind.known and kind.stage != "record"]


def improve(task: Task) -> Outcome:
    """``improve``, and the model it arrives at: held-out error over its floor, the twelve against the truth."""
    from kf_calib.calibration import Settings, calibrate
    from kf_calib.cli import cli
    from kf_calib.sources.recording import Recording

    if "improve" not in cli.commands:
        return Outcome(task, error="this version has no command improve")
    path, times = Path("trial.mcap"), dict[str, float]()
    with _timed(times, "simulate"):
        run(*task.simulate(path))
    with _timed(times, "improve"):
        said = run("improve", str(path), "--json")
    side = json.loads(path.with_suffix(".truth.json").read_text())
    known = tuple(effect["name"] for effect in side["effects"])
    result = calibrate(Recording(path), Settings(effects=tuple(said["model"])))
    estimate, symbols = result.estimate, list(result.parameters)[:12]
    error = estimate.parameters - np.array([side["parameters"][symbol] for symbol in symbols])
    nees = float(error @ np.linalg.solve(estimate.parameter_covariance, error))
    inside = int(np.sum(np.abs(error) < 1.96 * estimate.sigma))
    held_out, floor = result.held_out_rms_mps2, result.held_out_floor_mps2
    same = _meaning_the_same(path, known, said["model"])
    first = said["model"][0] if said["model"] else "unknown" if said["stopped_because"] == "unknown" else None
    extra = {
        "stopped": said["stopped_because"], "model": said["model"], "nees": nees, "inside": inside,
        "held_out": held_out / floor if held_out and floor else None,
    }  # fmt: skip
    return Outcome(task, known, first, tuple(said["model"]), (), same, extra=extra, seconds=times)


def advice(task: Task, advised: int = 4, random: int = 12) -> Outcome:
    """Twelve orientations, an ambiguous pair: how far apart, in sigma, after the advised and after random ones."""
    from kf_calib.sources.plans import spread_plan

    rows = [visit.gimbal_deg for visit in spread_plan(12, seed=task.seed)]
    start, truth, said = _on_plan(task, rows)
    rivals = [name for name in said["ambiguity_set"] if name != truth["name"]]
    if said["missing"] in (None, "unknown") or not rivals or truth["name"] not in said["ambiguity_set"]:
        return Outcome(task, (truth["name"],), error="not ambiguous to begin with")
    fixed = dataclasses.replace(task, hidden=(f"{truth['name']}={','.join(map(repr, truth['sizes'].values()))}",))
    here, more = said, list(rows)
    for _ in range(advised):
        if here["next_orientation"] is None:
            return Outcome(task, (truth["name"],), error="no orientation was advised")
        more.append(tuple(here["next_orientation"]["gimbal_deg"]))
        _, _, here = _on_plan(fixed, more)
    others = [visit.gimbal_deg for visit in spread_plan(random, seed=task.seed + 50_000)]
    paths = {"before": start, "advised": _on_plan(fixed, more)[0], "random": _on_plan(fixed, [*rows, *others])[0]}
    apart = {which: _separation(path, truth, rivals[0]) for which, path in paths.items()}
    return Outcome(task, (truth["name"],), here["missing"], extra={**apart, "rival": rivals[0]})


def _on_plan(task: Task, rows: Sequence[Sequence[float]]) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """Recording, its one hidden effect, and the diagnosis, of a run through these orientations."""
    path = Path(f"{len(rows)}.mcap")
    np.savetxt("plan.csv", rows, delimiter=",")
    run(*task.simulate(path, "--plan", "plan.csv", "--overwrite"))
    truth = json.loads(path.with_suffix(".truth.json").read_text())["effects"][0]
    return path, truth, run("diagnose", str(path), "--json")


def _separation(path: Path, truth: dict[str, Any], rival: str) -> float:
    """What of the hidden effect neither the twelve nor the rival explain, in sigma."""
    spaces = candidates(path, [truth["name"], rival])
    signal = spaces[truth["name"]][0].columns @ np.array(list(truth["sizes"].values()))
    return min(float(np.linalg.norm(signal - other.basis @ (other.basis.T @ signal))) for other in spaces[rival])


PLAYS: dict[str, Callable[[Task], Outcome]] = {
    "diagnose": diagnosed, "outside": outside, "pair": pair, "power": power, "invisible": invisible,
    "improve": improve, "advice": advice,
}  # fmt: skip


# --- which trials ----------------------------------------------------------------------------------------------------


def visible_effects(options: Sequence[str] = ()) -> list[str]:
    """Names that this kind of run shows and that can be hidden: the stated ones that are not called invisible."""
    clean = Task("", "", 1, (), tuple(options))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        run(*clean.simulate("clean.mcap"))
        unseen = set(run("diagnose", "clean.mcap", "--json")["invisible"])
    hideable = {kind.name: kind for kind in known_kinds()}
    names = [each["effect"] for each in run("effects", "--json")["effects"]]
    kinds = {name: hideable[name.split(":")[0]] for name in names if name.split(":")[0] in hideable}
    return [n for n, kind in kinds.items() if n not in unseen or (kind.accompanied and _has_size(clean, n))]


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
    """All trials, each with a seed of its own; ``effects``: only these are hidden."""
    visible = list(effects) or visible_effects()
    drawn, start = np.random.default_rng(seed), 10_000_000 * seed
    made, stepping = list[Task](), itertools.count(start)

    def add(figure: str, play: str, hidden: Sequence[str] = (), options: Sequence[str] = ()) -> None:
        made.append(Task(figure, play, next(stepping), tuple(hidden), tuple(options), setting))

    for family in families:
        stepping = itertools.count(start + 100_000 * FIGURES.index(family))  # the same seeds whatever else is asked for
        if family == "noise":
            for name, _ in itertools.product(NOISES, range(40 * runs)):
                add(f"noise@{name}", "diagnose", options=NOISES[name])
        elif family in ("name", "unstated"):
            sizes, options = ((8, 10, 15), ()) if family == "name" else ((10,), NOISES["unstated"])
            for size, name, _ in itertools.product(sizes, visible, range(runs)):
                add(f"{family}@{size}", "diagnose", [f"{name}={size}sigma"], options)
        elif family == "power":
            for round_, name in itertools.product(range(8 * runs), visible):
                first = start + 100_000 * FIGURES.index(family)
                made.append(Task("power@stated", "power", first + round_, (name,), (), setting))
        elif family == "invisible":
            for _, options in itertools.product(range(max(1, runs // 5)), [(), *PLANS.values()]):
                add(f"invisible@{options[-1] if options else 'spread'}", "invisible", options=options)
        elif family == "outside":
            for name, _ in itertools.product(outside_effects(), range(2 * runs)):
                add("outside@15", "outside", [f"{name}=15sigma"])
        elif family == "pair":
            for _ in range(40 * runs):
                add("pair@10", "pair", [f"{name}=10sigma" for name in drawn.choice(visible, 2, replace=False)])
        elif family == "plans":
            for name, plan in PLANS.items():
                for _ in range(8 * runs):
                    add(f"plans@{name}, nothing hidden", "diagnose", options=plan)
                shown = list(effects) or visible_effects(() if "monotone" in plan else plan)
                for effect, _ in itertools.product(shown, range(runs)):
                    add(f"plans@{name}, one hidden", "diagnose", [f"{effect}=10sigma"], plan)
        elif family == "improve":
            for name, _ in itertools.product(visible, range(runs)):
                add("improve@15", "improve", [f"{name}=15sigma"])
        elif family == "advice":
            for name, _ in itertools.product(visible, range(max(1, runs // 5))):
                add("advice@8", "advice", [f"{name}=8sigma"])
    return made


# --- figures ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figure:
    """One line of the report. low, high: 95 % limits; bar: what is asked for; meets: None where not judged."""

    name: str
    value: float
    low: float
    high: float
    count: int
    bar: str = ""
    meets: bool | None = None


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
    done = [each for each in outcomes if not each.error]
    groups = dict[str, list[Outcome]]()
    for each in done:
        groups.setdefault(each.task.figure, []).append(each)
    out = list[Figure]()
    for figure, own in groups.items():
        out += _FIGURES[own[0].task.family](figure.partition("@")[2], own)
    blind = [each.named not in each.invisible for each in done if each.named]
    return (
        [*out, rate("a name that is given is not of an effect it calls invisible", blind, least=1.0)] if blind else out
    )


def _noise(which: str, own: list[Outcome]) -> Iterator[Figure]:
    alarms = rate(f"false alarm, {which}", [bool(each.consistent is False) for each in own], most=0.03)
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
    by_effect = {name: [each.right for each in own if each.truth[0] == name] for name in {e.truth[0] for e in own}}
    lowest = min(by_effect, key=lambda name: (np.mean(by_effect[name]), name))
    yield rate(f"worst effect, n = {which}{stated}: {lowest}", by_effect[lowest], worst)
    given = [each for each in own if each.ambiguity]
    yield rate(f"ambiguity set holds the truth, n = {which}{stated}", [each.held for each in given], 0.99)
    if given:
        size = float(np.median([len(each.ambiguity) for each in given]))
        low, high = np.percentile([len(each.ambiguity) for each in given], [2.5, 97.5])
        yield Figure(f"median size of the set, n = {which}{stated}", size, low, high, len(given), "1", size == 1.0)
    yield rate(f"wrong name, n = {which}{stated}", [each.wrong for each in own])


def _power(_: str, own: list[Outcome]) -> Iterator[Figure]:
    found = [(each.truth[0], each.consistent is False) for each in own]
    yield rate("power at the stated size, all effects", [hit for _, hit in found], 0.86, 0.94)
    for name in sorted({name for name, _ in found}):
        hits = [hit for each, hit in found if each == name]
        yield rate(f"power at the stated size, {name}", hits, 0.86, 0.94)


def _invisible(which: str, own: list[Outcome]) -> Iterator[Figure]:
    differ = sorted({name for each in own for name in each.extra["differ"]})
    yield rate(f"invisible list exact, {which}" + f": not {', '.join(differ)}" * bool(differ),
               [not each.extra["differ"] for each in own], 1.0)  # fmt: skip


def _outside(which: str, every: list[Outcome]) -> Iterator[Figure]:
    own = [each for each in every if each.extra["overlap"] < _APART]
    yield rate(f"outside the catalogue, n = {which}: unknown", [each.first == "unknown" for each in own], 0.90)
    yield rate("outside the catalogue: a wrong name", [each.named is not None for each in own], most=0.05)
    told = [(each.extra["driver"], each.extra["true_drivers"][0]) for each in own if each.first == "unknown"]
    yield rate("outside the catalogue: driver right, of unknown", [_family(said) == true for said, true in told], 0.80)
    near = [each.first == "unknown" for each in every if each.extra["overlap"] >= _APART]
    yield rate(f"outside, but overlap >= {_APART}: unknown", near)


def _family(driver: str | None) -> str:
    """What drives, without which of it: "angle of gimbal 2, 3 a turn" is "angle"."""
    for end in (",", "(", " of gimbal"):
        driver = (driver or "").split(end)[0]
    return (driver or "").strip()


def _pair(which: str, every: list[Outcome]) -> Iterator[Figure]:
    own = [each for each in every if each.extra["overlap"] < _APART]
    yield rate(f"two at once, n = {which} each: both found", [each.found for each in own], 0.85)
    yield rate("two at once: nothing else", [each.nothing_else for each in own], 0.95)
    yield rate("two at once: one of them found", [any(map(each.means_truth, each.names)) for each in own])


def _plans(which: str, own: list[Outcome]) -> Iterator[Figure]:
    if own[0].truth:
        yield rate(f"{which}: a wrong name", [each.wrong for each in own], most=0.0)
        yield rate(f"{which}: noticed", [each.consistent is False for each in own])
        yield rate(f"{which}: right name first", [each.right for each in own])
    else:
        yield rate(f"{which}: false alarm", [each.consistent is False for each in own], most=0.03)
        yield rate(f"{which}: a name", [each.named is not None for each in own], most=0.01)


def _improve(which: str, own: list[Outcome]) -> Iterator[Figure]:
    from scipy.stats import chi2

    settled = [each for each in own if each.extra["stopped"] == "consistent"]
    yield rate(f"improve, n = {which}: ends consistent", [each in settled for each in own])
    ratios = [each.extra["held_out"] for each in settled if each.extra["held_out"]]
    if ratios:
        mean = float(np.mean(ratios))
        low, high = np.percentile(ratios, [2.5, 97.5])
        yield Figure("after improve: held-out rms / floor, mean", mean, low, high, len(ratios), "<= 1.05", mean <= 1.05)
    if settled:
        nees, count = float(np.mean([each.extra["nees"] for each in settled])), len(settled)
        low, high = chi2.ppf([0.005, 0.995], 12 * count) / count
        yield Figure(
            "after improve: NEES of the twelve, mean", nees, low, high, count, "in its 99 % band", low <= nees <= high
        )
        hits = [k < each.extra["inside"] for each in settled for k in range(12)]
        yield rate("after improve: 95 % intervals cover", hits, 0.92, 0.98)


def _advice(which: str, own: list[Outcome]) -> Iterator[Figure]:
    yield rate("4 advised separate an ambiguous pair as well as 12 random",
               [each.extra["advised"] >= each.extra["random"] for each in own], 0.5)  # fmt: skip
    ratios = [each.extra["advised"] / max(each.extra["random"], 1e-9) for each in own]
    low, high = np.percentile(ratios, [2.5, 97.5])
    median = float(np.median(ratios))
    yield Figure("separation, 4 advised / 12 random, median", median, low, high, len(own), ">= 1", median >= 1.0)


_FIGURES: dict[str, Callable[[str, list[Outcome]], Iterator[Figure]]] = {
    "noise": _noise, "name": _name, "unstated": _name, "power": _power, "invisible": _invisible, "outside": _outside,
    "pair": _pair, "plans": _plans, "improve": _improve, "advice": _advice,
}  # fmt: skip


def failed(each: Outcome) -> bool:
    """Not what was hoped for: to be looked at."""
    family, close = each.task.family, each.extra.get("overlap", 0.0) >= _APART
    if each.error:
        return "refused" in each.extra
    if family in ("noise", "plans") and not each.truth:
        return each.consistent is False
    return {
        "name": not each.right, "unstated": not each.right, "plans": each.wrong, "power": False,
        "invisible": bool(each.extra.get("differ")), "outside": each.first != "unknown" and not close,
        "pair": not (each.found and each.nothing_else) and not close, "improve": not each.right,
        "advice": each.extra.get("advised", 1.0) < each.extra.get("random", 0.0),
    }.get(family, False)  # fmt: skip


# --- report ----------------------------------------------------------------------------------------------------------


def confusion(outcomes: Sequence[Outcome], figure: str | None = None) -> dict[str, Counter[str]]:
    """What was named first for each hidden effect.

    Names that mean the same count as the hidden one's, and so does ``unknown`` for what is in no catalogue.
    """
    out = dict[str, Counter[str]]()
    for each in outcomes:
        if each.error or len(each.truth) > 1 or each.task.family not in ("noise", "name", "unstated", "outside"):
            continue
        if figure in (None, each.task.figure):
            true = each.truth[0] if each.truth else "(nothing)"
            right = each.right or (each.task.family == "outside" and each.first == "unknown")
            said = true if right else each.first or "(nothing)"
            out.setdefault(true, Counter())[said] += 1
    return out


def report(outcomes: Sequence[Outcome]) -> Any:
    """Figures, then the confusion matrix row by row: a matrix of forty columns fits no terminal."""
    from rich.console import Group
    from rich.table import Table

    lines = Table(title="Figures", title_justify="left")
    for heading in ("figure", "value", "95 % limits", "trials", "asked for", ""):
        lines.add_column(heading, justify="right" if heading in ("value", "trials") else "left")
    for each in figures(outcomes):
        mark = {True: "met", False: "[bold red]missed", None: ""}[each.meets]
        lines.add_row(
            each.name, f"{each.value:.3f}", f"{each.low:.3f} to {each.high:.3f}", str(each.count), each.bar, mark
        )
    rows = Table(title="Hidden, and what was named first", title_justify="left")
    for heading in ("hidden", "trials", "right", "named instead"):
        rows.add_column(heading, justify="right" if heading in ("trials", "right") else "left")
    for true, said in confusion(outcomes).items():
        others = ", ".join(f"{name} {count}" for name, count in said.most_common() if name != true)
        rows.add_row(true, str(said.total()), f"{said[true] / said.total():.0%}", others)
    errors = Counter(f"{each.task.figure}: {each.error}" for each in outcomes if each.error)
    return Group(
        lines, rows, *(f"Not judged, {count} times: {text}" for text, count in errors.most_common()), _cost(outcomes)
    )


def _cost(outcomes: Sequence[Outcome]) -> str:
    parts = {part for each in outcomes for part in each.seconds}
    means = {p: np.mean([each.seconds[p] for each in outcomes if p in each.seconds]) for p in sorted(parts)}
    return "Seconds a trial: " + ", ".join(f"{part} {mean:.2f}" for part, mean in means.items())


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
    sheet.savefig(path, dpi=110)


def save_failures(outcomes: Sequence[Outcome], path: Path) -> None:
    """A paragraph for each trial that went wrong, with the command that shows it."""
    lines = list[str]()
    for each in filter(failed, outcomes):
        told = {key: value for key, value in each.extra.items() if key not in ("verdict", "true_drivers") and value}
        lines += [
            f"[{each.task.figure}] hidden {' + '.join(each.truth) or 'nothing'}; first {each.first}; "
            f"all {list(each.names)}; set {list(each.ambiguity)}; p {each.p_value}; wrong {each.wrong}; {told}",
            f"    {each.error or each.extra.get('verdict', '')}",
            f"    {each.task.command}",
        ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def keep(task: Task, folder: Path) -> None:
    """Make a trial's recording again, and its plan, for a look at it."""
    name = f"{task.figure}-{task.seed}".replace(" ", "_").replace("/", "")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        _make_plan(task)
        run(*task.simulate("trial.mcap"))
        for made in Path().glob("trial.*"):
            shutil.move(made, folder / made.name.replace("trial", name, 1))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--runs", type=click.IntRange(min=1), default=5, show_default=True, help="Trials an effect and size.")
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
    out: Path | None,
    picture: Path | None,
    failures: Path | None,
    kept: Path | None,
) -> None:
    """Blind trial of the diagnosis."""
    from rich.console import Console

    todo = thinned(tasks(only or FIGURES, runs, seed, effects, f"{setting:g}"), limit)
    outcomes = list(_all(todo, jobs))
    Console(width=None if sys.stdout.isatty() else 140).print(report(outcomes))
    if out:
        content = {
            "seed": seed, "runs": runs, "figures": [dataclasses.asdict(each) for each in figures(outcomes)],
            "confusion": confusion(outcomes), "outcomes": [dataclasses.asdict(each) for each in outcomes],
        }  # fmt: skip
        out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
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


def _all(todo: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """Outcomes in the order of the tasks, with a bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    def shown(outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
        quiet = not sys.stderr.isatty()
        yield from track(outcomes, "trials", len(todo), console=Console(stderr=True), disable=quiet)

    if jobs == 1:
        yield from shown(map(played, todo))
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from shown(pool.map(played, todo))


if __name__ == "__main__":
    main()
