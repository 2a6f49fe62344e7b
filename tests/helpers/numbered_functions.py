"""Functions whose numbers are stored, over grids that pass each of their thresholds."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from helpers.drawn_fleets import Plan, drawn_fleet
from helpers.result_numbers import ResultNumbers
from helpers.synthetic import Run
from kf_calib.bench import bench, paper_parameters
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.design import gimbal_limits, optimality_criteria
from kf_calib.design.gimbal_limits import GimbalLimits
from kf_calib.dwells import coherent_tone, encoder_noise, line_spectrum
from kf_calib.dwells.rest_in_readings import RestSegmenter
from kf_calib.dwells.segmenter import Segmenter
from kf_calib.estimation import signal_quality
from kf_calib.estimation.calibration import calibrate
from kf_calib.fleet.pooled_diagnosis import pooled_diagnosis
from kf_calib.fleet.text import pooled_objects
from kf_calib.noise import allan, banded, noise_of_readings, random_walk
from kf_calib.online.suggestion import Suggestion
from kf_calib.positioning import loop
from kf_calib.support.json_values import json_value

Numbers = Mapping[str, Any]
SIZES = np.geomspace(1e-3, 1e3, 40)
LIMITED = Bench(axes_of("yzx"), 9.81, limits_deg="z=-90:90", forbidden_deg="y=30:60,x=-20:20")


def figures(**things: Any) -> Numbers:
    """The figures of what stands under names."""
    numbers = ResultNumbers()
    for name, thing in things.items():
        numbers.add(thing, name)
    return {"figures": numbers.figures}


def benches() -> Numbers:
    """Gravity, rotations, poses between poses, and the paper's parameters."""
    rng = np.random.default_rng(1)
    vectors, angles = rng.normal(size=(20, 3)), rng.uniform(-4.0, 4.0, (20, 3))
    units = rng.normal(size=(20, 4)) / 3.0
    units /= np.linalg.norm(units, axis=1)[:, None]
    times, at = np.arange(20) * 10**8, np.sort(rng.integers(0, 19 * 10**8, 30))
    state = paper_parameters.state_of(paper_parameters.nominal() + 0.01 * rng.normal(size=12))
    parameters = paper_parameters.parameters_of(state)
    return figures(
        gravity=[bench.normal_gravity(latitude, 100.0 * latitude) for latitude in (0.0, 30.0, 60.0, 90.0)],
        turned=[bench.turned(vectors, size * angles) for size in (1e-9, 1e-4, 1.0)],
        turned_by=[bench.turn_by(vector, angle) for vector, angle in zip(vectors, angles, strict=True)],
        slerp=bench.slerp(units[:10], units[10:], rng.random((10, 1))),
        between=[bench.interpolate_pose(at, times, angles, False), bench.interpolate_pose(at, times, units, True)],
        distance=[bench.pose_distance(angles[0], angles, False), bench.pose_distance(units[0], units, True)],
        parameters=[state, parameters, paper_parameters.jacobian(state)],
        paper=[paper_parameters.h_rows(parameters), paper_parameters.optimal_directions(parameters)],
    )


def noises() -> Numbers:
    """Autoregressions, Allan deviations, random walks, bands, and weights."""
    rng = np.random.default_rng(2)
    gammas = [np.power(phi, np.arange(12.0)) * (1.0 + 0.1 * rng.random(12)) for phi in (0.0, 0.3, 0.7, 0.95)]
    series = [np.cumsum(rng.normal(size=(count, 3)), axis=0) for count in (300, 500)]
    sizes = allan.cluster_sizes(300)
    ends = np.cumsum(rng.uniform(1.0, 9.0, 24)).reshape(12, 2)
    steps, rows = np.repeat(rng.uniform(0.0, 1.0, (12, 2, 1)), 3, axis=2), [rng.normal(size=(6, 16)) for _ in range(12)]
    links = [random_walk.mean_links(ends)]
    whitened, factor = random_walk.whiten_walk(rows, steps), np.triu(rng.normal(size=(12, 13)))
    advanced = [random_walk.advance(factor, steps[0], rows[0])[0], random_walk.recede(factor, steps[0], rows[0])]
    advanced += [random_walk.predict(factor, np.full(3, variance)) for variance in (0.0, 0.4)]
    freedom = np.full((3, 30), 40.0)
    variances = [rng.chisquare(40.0, (3, 30)) / 40.0 * np.exp(size * rng.normal(size=30)) for size in (0.0, 0.1, 1.0)]
    columns = 0.1 * rng.normal(size=(10, 6, 3))
    columns[-1, 3:] = 0.0
    columns[:, :3] = np.swapaxes(columns[:, :3], 1, 2) + columns[:, :3] + 3.0 * np.eye(3)
    lower = banded.root(columns)
    return figures(
        autoregression=[noise_of_readings.Autoregression.of(gamma, 100) for gamma in gammas],
        unbiased=[noise_of_readings.unbiased(gamma, 200, 100) for gamma in gammas],
        products=[noise_of_readings.expected_products(gamma, 6) for gamma in gammas],
        allan=allan.deviations(series, sizes), sizes=[allan.cluster_sizes(count) for count in (1, 7, 64, 1000)],
        links=links, walked=random_walk.variances(*ends.T, np.full(3, 0.3)), to_mean=random_walk.to_mean(steps),
        whitened=np.abs(whitened.T @ whitened), advanced=[np.abs(each.T @ each) for each in advanced],
        weights=[noise_of_readings.weights_of(each, freedom) for each in variances],
        bands=[lower, banded.diagonal(lower), banded.solve(lower, rng.normal(size=(30, 2)))],
        inverse=[banded.inverse(columns, lower), banded.inverse(columns[:, :3], banded.root(columns[:, :3]))],
    )  # fmt: skip


def signals() -> Numbers:
    """Steps, flat tops, crowds of outliers, oscillations and lines in readings."""
    rng = np.random.default_rng(3)
    grids = [0.37 * np.sort(rng.choice(900, count, replace=False)) for count in (4, 12, 40)]
    noisy = [grid + error * rng.uniform(-1.0, 1.0, len(grid)) for grid in grids for error in SIZES[:30] * 1e-3]
    hits = [rng.poisson(size, 40).astype(float) for size in SIZES[10:30]]
    crowded = [each + 5.0 * (np.arange(40) // 4 == 3) for each in hits]
    counts = np.full(40, 300.0)
    at_s = np.arange(4096) / 100.0
    tones = [size * 0.1 * np.sin(2.0 * np.pi * 7.3 * at_s) + rng.normal(size=(3, 4096)) for size in SIZES[8:28]]
    spectra = [line_spectrum.Spectrum.of(each, at_s) for each in tones]
    return figures(
        step=[signal_quality.common_step(each, tolerance) or 0.0 for each in noisy for tolerance in (1e-6, 1e-3)],
        missing=[signal_quality.missing_above(np.arange(1.0, 90.0), np.full(89, 100.0), size) for size in SIZES[::4]],
        crowds=[signal_quality.clustering(each, counts)[0] for each in (*hits, *crowded)],
        lines=[line_spectrum.lines([each]) for each in spectra], together=line_spectrum.lines(spectra),
        lowest=line_spectrum.lowest_hz(spectra), tones=[coherent_tone.tone(traces) for traces in _traces(rng)],
        encoders=[encoder_noise.encoder_sigma(size * rng.normal(size=(90, 3))) for size in (1e-6, 1e-3)],
    )  # fmt: skip


def _traces(rng: np.random.Generator) -> list[list[coherent_tone.Trace]]:
    """Dwells of runs with an oscillation, from hardly visible to large."""
    runs = list[list[coherent_tone.Trace]]()
    for size in np.geomspace(0.003, 1.0, 12):
        starts = np.arange(16) * 40.0
        times = [start + np.arange(0.0, 30.0, 0.1) for start in starts]
        cells = coherent_tone.Cells.of(times[0])
        waves = [size * np.sin(2.0 * np.pi * 0.37 * each)[:, None] + rng.normal(size=(300, 3)) * 0.1 for each in times]
        runs.append([coherent_tone.Trace.of(wave, each, cells) for wave, each in zip(waves, times, strict=True)])
    return runs


def defects() -> Numbers:
    """What is told of readings that are rounded, cut off, or disturbed in a few dwells."""
    told = dict[str, Any]()
    for name, change in {
        **{f"step {step:g}": lambda values, step=step: np.round(values / step) * step for step in SIZES[4:20:2] * 1e-3},
        **{f"cut {cut:g}": lambda values, cut=cut: np.clip(values, -cut, cut) for cut in (8.0, 9.0, 9.4)},
        "spikes": lambda values: values + 0.1 * (np.arange(len(values))[:, None] % 97 == 0) * (values[:, :1] > 0.0),
    }.items():
        run = Run(seed=3, dwells=9, count=80, white_mps2=1e-3)
        run.accel = Stream(run.accel.time_ns, change(run.accel.values))
        told[name] = figures(readings=calibrate(run).readings)
    return told


def segments() -> Numbers:
    """Dwells in streams of motion and rest of many lengths, by the angles and by the readings alone."""
    told = dict[str, Any]()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        angle = np.radians(_path_deg(rng))
        times = np.arange(len(angle)) * 10_000_000
        force = 9.81 * np.column_stack([np.sin(angle), np.cos(angle), 0.0 * angle])
        accel = Stream(times, force + rng.normal(size=force.shape) * 1e-2)
        pose = Stream(times[::10], np.column_stack([angle, 0.0 * angle])[::10])
        by_angles, by_readings = Segmenter(Bench(axes_of("zx"), 9.81)), RestSegmenter(Bench((), 9.81, angles=False))
        told[f"angles {seed}"] = _spans(by_angles, Batch(accel, pose))
        told[f"readings {seed}"] = _spans(by_readings, Batch(accel, Stream.empty(4)))
    return told


def _path_deg(rng: np.random.Generator) -> Any:
    """An angle at 100 Hz: rests of 0.05 to 8 s, moves and creeps between them, and noise of an encoder."""
    parts, here = list[Any](), 0.0
    for _ in range(14):
        there = here + float(rng.normal()) * float(rng.choice([0.01, 0.3, 40.0]))
        parts += [np.full(round(100 * float(np.exp(rng.uniform(-3.0, 2.1)))) + 1, here)]
        parts += [np.linspace(here, there, int(rng.integers(5, 200)))]
        here = there
    path = np.concatenate(parts)
    return path + 1e-4 * rng.normal(size=len(path))


def _spans(segmenter: Segmenter, batch: Batch) -> Numbers:
    """Number, first second, last second and count of each block, and the counts."""
    blocks = [*segmenter.push(batch), *segmenter.finish()]
    spans = [[each.dwell, each.elapsed_s[0], each.elapsed_s[-1], len(each.elapsed_s)] for each in blocks]
    return {"counts": [each for each in vars(segmenter.counts).values() if isinstance(each, int)], "spans": spans}


def orientations() -> Numbers:
    """Limits and ways of gimbals, criteria, orders and their times."""
    rng, limits = np.random.default_rng(5), GimbalLimits.of(LIMITED)
    poses = rng.uniform(-np.pi, np.pi, (60, 3))
    allowed = poses[limits.allowed(poses)]
    factors = np.array([np.triu(rng.normal(size=(12, 12))) + 3.0 * np.eye(12) for _ in range(8)])
    timing = gimbal_limits.Timing(30.0, 20.0)
    aims = (optimality_criteria.D, optimality_criteria.A, optimality_criteria.E)
    ways = [gimbal_limits.route(limits, allowed[0], each) for each in allowed[:12]]
    return figures(
        allowed=limits.allowed(poses), rooms=limits.rooms(allowed), candidates=limits.candidates,
        crosses=limits.crosses(allowed[:-1], allowed[1:]), free=gimbal_limits.is_free(limits, allowed[0], allowed[1:]),
        reached=gimbal_limits.can_be_reached(limits, allowed[0], allowed), wrapped=gimbal_limits.wrap(9.0 * poses),
        ways=[way if way is not None else [] for way in ways], scores=[aim(factors) for aim in aims],
        soft=[aim(factors, 8.0) for aim in aims], sigmas=optimality_criteria.sigmas(factors),
        slopes=[optimality_criteria.slope(aim, factors[0], 8.0) for aim in aims],
        slews=gimbal_limits.slews_s(poses[:-1], poses[1:], 20.0), middles=gimbal_limits.middles_s(poses, timing),
        correlation=gimbal_limits.time_correlation(gimbal_limits.middles_s(poses, timing), rng.normal(size=(60, 4))),
    )  # fmt: skip


def fleets() -> Numbers:
    """Fleets with errors of benches, of some units and of all, from hardly visible to large."""
    numbers, told = ResultNumbers(), dict[str, Any]()
    plans = (Plan(12, 2, 2, 4), Plan(9, 3, 2, 9, 0.0, 5.0, 0.5, 0.0, 0.0), Plan(8, 1, 3, 0, 2.0, mean=0.0))
    for number, plan in enumerate(plans):
        found = pooled_diagnosis(drawn_fleet(plan, np.random.default_rng(number)).runs)
        told[f"fleet {number}"] = json_value(pooled_objects(found))
        numbers.add(found, f"fleet {number}")
    return told | {"figures": numbers.figures}


def driving() -> Numbers:
    """Commands of the loop that drives a bench which is late, off its way, silent, or just what it should be."""
    told = dict[str, Any]()
    for seed in range(30):
        told[str(seed)] = _driven(np.random.default_rng(seed))
    return told


def _driven(rng: np.random.Generator) -> list[Any]:
    """The times and the kinds of the commands of one run whose platform is wrong by sizes drawn over decades."""
    rules, state, now_s, told = loop.Rules(GimbalLimits.of(LIMITED)), loop.State(), 0.0, list[Any]()
    here, goal = np.zeros(3), np.zeros(3)
    off, late, drift, speed = np.exp(rng.uniform(np.log(1e-3), np.log(30.0), 4)) * (rng.random(4) < 0.5)
    heard, going = 0, None
    for k in range(400):
        here = here + np.clip(goal - here, -2.0 - 0.2 * speed, 2.0 + 0.2 * speed) * (now_s > late * 0.1)
        wrong = off * (k > 90) * 0.1 + drift * 1e-3 * k
        seen_deg = tuple(float(each) for each in here + np.array([0.0, 0.0, wrong]))
        heard += k % 150 < 110
        stay_s = 0.2 * (k % 47)
        seen = loop.Seen(now_s, seen_deg, samples=heard, stay_s=stay_s, stream_deg=seen_deg, suggestion=going)
        state, command = loop.step(state, seen, rules)
        going, now_s = None, now_s + 0.2
        if command is not None:
            told.append([k, type(command).__name__])
        if isinstance(command, loop.Ask):
            goal_deg = tuple(float(each) for each in rng.choice([-90.0, 0.0, 90.0], 3))
            going = Suggestion("opening", "why", goal_deg, float(rng.uniform(1.0, 9.0)))
        if isinstance(command, loop.Move):
            goal = np.array(command.gimbal_deg)
        if isinstance(command, loop.Halt):
            break
    return told


FUNCTIONS: Mapping[str, Callable[[], Numbers]] = {
    "benches": benches, "noises": noises, "signals": signals, "defects": defects, "segments": segments,
    "orientations": orientations, "fleets": fleets, "driving": driving,
}  # fmt: skip
"""Called by the fast tests."""
