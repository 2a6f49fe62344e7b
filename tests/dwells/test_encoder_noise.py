"""Noise of angle messages, against the noise that they were made with; attitudes with rotations of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Stream
from kf_calib.dwells.encoder_noise import EncoderNoise, distance_sigma, encoder_sigma

S = 1_000_000_000
SIGMA_RAD = 3e-4


def stream(values: Floats, period_s: float = 0.05) -> Stream:
    return Stream(np.round(np.arange(len(values)) * period_s * S).astype(np.int64), values)


def attitudes(count: int, seed: int) -> Floats:
    """An attitude that is read with a noise of ``SIGMA_RAD`` about each axis."""
    rng = np.random.default_rng(seed)
    return (Rotation.random(rng=rng) * Rotation.from_rotvec(SIGMA_RAD * rng.normal(size=(count, 3)))).as_quat()


def slewing(count: int, seed: int) -> Floats:
    """Angles (count, 2) that turn by 90 deg in 4 s after each 6 s, 20 messages a second, with noise of the first."""
    seconds = 0.05 * np.arange(count)
    phase = np.clip((seconds % 10.0 - 6.0) / 4.0, 0.0, 1.0)
    degrees = 90.0 * (seconds // 10.0 + 0.5 - 0.5 * np.cos(np.pi * phase))
    noise = np.random.default_rng(seed).normal(size=(count, 2)) * [SIGMA_RAD, 0.1 * SIGMA_RAD]
    return np.radians(degrees)[:, None] * [1.0, 0.3] + noise


def test_an_encoder_is_as_noisy_as_its_messages_scatter_about_a_line() -> None:
    noise = np.random.default_rng(1).normal(size=(20_000, 2)) * [3e-5, 1e-4]
    line = np.linspace(0.0, 5.0, 20_000)[:, None]
    assert encoder_sigma(noise + line) == pytest.approx([3e-5, 1e-4], rel=0.03)
    assert not encoder_sigma(noise[:2]).any()


@pytest.mark.parametrize("seed", range(4))
def test_an_attitude_is_as_noisy_as_its_angle_of_rotation(seed: int) -> None:
    poses = attitudes(20_000, seed)
    turned = (Rotation.from_quat(poses).mean().inv() * Rotation.from_quat(poses)).magnitude()
    sigma = distance_sigma(encoder_sigma(poses), True)
    assert sigma == pytest.approx(np.sqrt(np.mean(turned**2)), rel=0.02)
    assert sigma == pytest.approx(np.sqrt(3.0) * SIGMA_RAD, rel=0.02)


def test_slews_and_outliers_are_no_noise() -> None:
    """Within a factor of two, as the medians of 29 third differences are; by second ones a slew would be five sigma."""
    values = slewing(4000, seed=3)
    values[::97] += 0.02
    noise = EncoderNoise(False).of_next(stream(values))
    assert (noise > 0.5 * SIGMA_RAD).all() and (noise < 2.0 * SIGMA_RAD).all()
    assert np.median(noise) == pytest.approx(SIGMA_RAD, rel=0.2)


def test_of_attitudes_it_is_that_of_their_rotation() -> None:
    noise = EncoderNoise(True).of_next(stream(attitudes(4000, 5)))
    assert (noise > 0.9 * SIGMA_RAD).all() and (noise < 2.0 * np.sqrt(3.0) * SIGMA_RAD).all()


def test_it_is_not_told_by_messages_that_are_far_apart() -> None:
    """A motion that begins within half a second is as large as the changes of its rate, in fewer than five messages."""
    values = slewing(400, seed=6)
    assert EncoderNoise(False).of_next(stream(values, 0.1)).all()
    assert not EncoderNoise(False).of_next(stream(values, 0.11)).any()


def test_parts_of_the_messages_give_the_same_as_all_at_once() -> None:
    pose, rng = stream(slewing(1000, seed=7)), np.random.default_rng(8)
    whole = EncoderNoise(False).of_next(pose)
    assert EncoderNoise(False).waits_for_more(pose[:31]) and not EncoderNoise(False).waits_for_more(pose[:32])
    for _ in range(5):
        noise, ends = EncoderNoise(False), np.sort(rng.integers(32, 1000, 60))
        parts = [pose[a:b] for a, b in zip([0, *ends], [*ends, 1000], strict=True)]
        assert np.concatenate([noise.of_next(part) for part in parts]).tobytes() == whole.tobytes()


@pytest.mark.parametrize("first_s", [0.05, 0.3])
def test_a_run_that_begins_slowly_does_not_wait(first_s: float) -> None:
    """The noise of its first 32 messages is not known, however the others come."""
    seconds = first_s + 0.05 * np.arange(-1.0, 199.0)
    seconds[0] = 0.0
    pose = Stream(np.round(seconds * S).astype(np.int64), slewing(200, seed=9))
    assert EncoderNoise(False).waits_for_more(pose[:2]) == (first_s == 0.05)
    whole, parted = EncoderNoise(False), EncoderNoise(False)
    noise = whole.of_next(pose)
    assert bool(noise[:32].all()) == (first_s == 0.05) and noise[128:].all()
    first = 2 if first_s == 0.3 else 32
    parts = [parted.of_next(pose[:first]), parted.of_next(pose[first:])]
    assert np.concatenate(parts).tobytes() == noise.tobytes()


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 100.0])
def test_a_slew_without_noise_has_none(rate_hz: float) -> None:
    """Slews of 90 deg in 1, 2, 4 and 10 s, between dwells of 5 s: twelve sigma are less than 0.05 deg."""
    for slew_s in (1.0, 2.0, 4.0, 10.0):
        seconds = np.arange(0.0, 100.0, 1.0 / rate_hz)
        phase = np.clip((seconds % (5.0 + slew_s) - 5.0) / slew_s, 0.0, 1.0)
        degrees = 90.0 * (seconds // (5.0 + slew_s) + 0.5 - 0.5 * np.cos(np.pi * phase))
        noise = EncoderNoise(False).of_next(stream(np.radians(degrees)[:, None], 1.0 / rate_hz))
        assert np.degrees(12.0 * noise.max()) < 0.05
