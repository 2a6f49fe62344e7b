"""Simulated runs of a board that is turned by hand: nobody records angles."""

from functools import partial

from helpers.synthetic import plan_of
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation, without_angles


def by_hand(*hidden: str, seed: int = 1, poses: int = 24, stated: bool = True, white_mps2: float = 2e-3) -> Simulation:
    """A MEMS block in spread poses of 4 s, with hidden effects; their sizes in sigma are as |f| shows them."""
    bench = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0 if stated else None)
    base = Simulation(
        bench, GRADES["mems"].sensors(seed), TrueNoise(white_mps2=white_mps2), plan_of(poses, dwell_s=4.0, seed=seed),
        sample_hz=50.0, slew_rate_degps=180.0, seed=seed, ambient=Ambient(swing_c=5.0, period_s=120.0, sigma_c=0.0),
    )  # fmt: skip
    own = parse(hidden, bench.axes, seed=seed, grade="mems", sized=partial(sized, without_angles(base)))
    return base.hiding(own).by_hand()
