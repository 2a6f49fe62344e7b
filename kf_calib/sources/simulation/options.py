"""A simulated run from options: those of ``kf-calib simulate``, or of a URL ``sim://?sample_hz=1000&seed=3``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from kf_calib.bench.bench import Bench, Vector, parse_axes
from kf_calib.bench.keys import BenchKeys
from kf_calib.errors import InputError
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES
from kf_calib.sources.simulation.settings import Ambient, NoiseOptions, SimulationOptions
from kf_calib.sources.simulation.simulator import Simulation, without_angles
from kf_calib.sources.simulation.visit_plans import PlannedVisit, angles_from_csv, explicit_plan, six_faces, spread_plan

_NUMBERS = {"count": int, "seed": int}  # all others that are no words are float
_WORDS = frozenset(("grade", "plan"))
_SHORT = {"orientations": "count", "hide": "hidden"}


def options_from_query(query: str) -> SimulationOptions:
    """Options from ``dwell_s=5&hide=second-order=10sigma``; ``hide`` may be repeated. Raises InputError."""
    known = {each.name for kind in (SimulationOptions, NoiseOptions, Ambient) for each in fields(kind)}
    known -= {"noise", "ambient"}
    options: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        name = _SHORT.get(key, key).replace("-", "_")
        if name not in known:
            raise InputError(f"sim:// has no setting {key!r}: use speed, hide or one of {', '.join(sorted(known))}.")
        try:
            if name == "hidden":
                options[name] = (*options.get(name, ()), text)
            elif name == "unstated":
                options[name] = text not in ("0", "no", "false")
            else:
                options[name] = text if name in _WORDS else _NUMBERS.get(name, float)(text)
        except ValueError:
            raise InputError(f"sim://: {key}={text} is not a number.") from None
    if (grade := options.get("grade", "paper")) not in GRADES:
        raise InputError(f"sim://: there is no grade {grade!r}: use {', '.join(GRADES)}.")
    return SimulationOptions.of(**options)


def simulation(
    options: SimulationOptions,
    bench_keys: BenchKeys,
    batch_samples: int = 65536,
    angles: bool = True,
    begin: Callable[[Simulation], None] = lambda run: None,
) -> Simulation:
    """The run that these options describe. Raises InputError.

    angles: whether they are recorded (for sizes in sigmas). begin: is given the run before anything is hidden in it,
    which takes as long as the run is large.
    """
    if options.seed < 0:
        raise InputError(f"seed is {options.seed}: give zero or a positive number.")
    keys: BenchKeys = {"axes": "y z x", **bench_keys}
    if "latitude_deg" not in keys:
        keys.setdefault("gravity_mps2", 9.81)
    grade = GRADES[options.grade]
    noise = options.noise.over(grade.noise)
    axes = parse_axes(keys.get("axes", ""))
    visits = _visits(options, axes, keys.get("up", "y"))
    if not options.unstated:
        keys.setdefault("angle_sigma_deg", noise.setting_sigma_deg)
        keys.setdefault("scatter_sigma_mps2", noise.dwell_sigma_mps2(len(visits)))
    run = Simulation(
        Bench.from_metadata(keys), grade.sensors(options.seed), noise, visits,
        sample_hz=options.sample_hz, angle_hz=options.angle_hz, slew_rate_degps=options.slew_degps,
        ambient=options.ambient, seed=options.seed, grade=options.grade, batch_samples=batch_samples,
    )  # fmt: skip
    begin(run)
    judged = run if angles else without_angles(run)
    return run.hiding(parse(options.hidden, axes, seed=options.seed, grade=options.grade, sized=partial(sized, judged)))


def _visits(options: SimulationOptions, axes: tuple[Vector, ...], up: str) -> list[PlannedVisit]:
    if options.plan == "spread":
        return spread_plan(options.count, axes, options.dwell_s, options.seed, up)
    if options.plan == "faces":
        return six_faces(axes, options.dwell_s, up)
    return explicit_plan(angles_from_csv(Path(options.plan), len(axes)), options.dwell_s)
