"""One trial: what is hidden in which run, and the commands that make it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

FAMILIES = (
    "noise", "name", "unstated", "power", "invisible", "outside", "pair", "plans", "improve", "advice", "ideal",
    "benches", "understated", "unstated-outside",
)  # fmt: skip
OUTSIDE = ("outside", "unstated-outside")
"""Families of trials of effects that are in no catalogue."""
# Few readings, but half an hour of them, so that drifts and time constants show; computed in about a second.
BENCH = (
    "--dwell-s", "60", "--sample-hz", "6", "--angle-hz", "4", "--slew-degps", "20", "--gravity", "9.81",
    "--latitude", "50", "--temperature-swing", "5", "--temperature-period-s", "700", "--warm-up-c", "4",
    "--warm-up-s", "500",
)  # fmt: skip
DWELL_S = float(BENCH[BENCH.index("--dwell-s") + 1])
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
"""Options and setting error, deg, of runs whose dwells scatter by more than the recording states."""
PLANS: dict[str, tuple[str, ...]] = {
    "spread": (),
    "six faces": ("--plan", "faces"),
    "monotone": ("--plan", "monotone"),
    "six dwells": ("--orientations", "6"),
}
SIZES_SIGMA = (8, 10, 15)
FAR_SIGMA = 40  # sigma: a misfit of many times the noise
PAIR_SIGMA = 10  # of each of two effects
BENCH_SIZES_SIGMA = (10, 15, 30)
LARGE = 100  # sigma, or factor: so large that noise does not matter
FEW_ORIENTATIONS = 12
SECOND_RUN = 5_000_000  # added to the seed of a run for its second run
SPREAD_PLANS = 50  # for each seed of the trial: spreading orientations takes as long as simulating a run


@dataclass(frozen=True)
class Task:
    """One trial.

    figure: the figure that it counts for, a family and a variant, such as ``name@10``. play: how it is played, a key
    of ``PLAYS``. seed: of the simulation. hidden: effects to hide, as ``--hide`` takes them. options: further options
    of ``simulate``. setting: setting error of an orientation, deg, which the recording states unless the options say
    otherwise.
    """

    figure: str
    play: str
    seed: int
    hidden: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    setting: str = "0.0002"

    @property
    def family(self) -> str:
        """The family of figures."""
        return self.figure.split("@")[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the hidden effects."""
        return tuple(text.partition("=")[0] for text in self.hidden)

    @property
    def stated(self) -> Task:
        """The same with all noise stated in the recording."""
        return replace(self, options=tuple(each for each in self.options if each != "--unstated"))

    @property
    def plan(self) -> str:
        """Name of the file of orientations; empty where ``simulate`` chooses them."""
        if "--plan" in self.options:
            return f"monotone-{self.seed}.csv" if "monotone" in self.options else ""
        number = self.seed // 10_000_000 * SPREAD_PLANS + self.seed % SPREAD_PLANS
        return "" if "--orientations" in self.options else f"spread-{number}.csv"

    def simulate(self, path: Path | str, *more: str) -> list[str]:
        """Return the arguments of the command that makes the recording."""
        hidden = [word for text in self.hidden for word in ("--hide", text)]
        plan = ["--plan", self.plan] if self.plan else []
        return [
            "simulate", str(path), *BENCH, "--setting", self.setting, *self.options, *plan, "--seed", str(self.seed),
            *hidden, *more, "--json",
        ]  # fmt: skip

    @property
    def command(self) -> str:
        """The commands that repeat the trial."""
        judge = "improve" if self.play == "improve" else "diagnose"
        return f"kf-calib {shlex.join(self.simulate('t.mcap', '--overwrite')[:-1])} && kf-calib {judge} t.mcap"
