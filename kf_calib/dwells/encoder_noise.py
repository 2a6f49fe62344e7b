"""Noise of angle messages, from differences of them, to which slow motion does not contribute: sigma^2 = <d^2> / 6 of
second ones, to which a constant rate adds nothing, <d^2> / 20 of third ones, to which a constant acceleration does not.

Angles of an encoder are independent of each other. An attitude turns by twice as much as the components of its
quaternion change, and its noise is that of the angle of rotation.
"""

from __future__ import annotations

import math

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Stream
from kf_calib.dwells.limits import CURVE, SAMPLE
from kf_calib.support.tail_probabilities import normal_quantile

_BLOCKS = 5  # the median of whose noises is taken
_WHITE = 0.6  # least ratio of white noise by third differences to that by second ones
_LONGEST_PERIOD_NS = 100_100_000  # messages farther apart than this do not tell noise from the beginning of a motion


def encoder_sigma(poses: Floats) -> Floats:
    """Noise of the components of a message, one standard deviation (k,), from poses (n, k); 0 for fewer than three."""
    if len(poses) < CURVE:
        return np.zeros(poses.shape[1])
    return np.asarray(np.sqrt(np.mean(np.diff(poses, 2, axis=0) ** 2, axis=0) / 6.0), float)


def distance_sigma(sigma: Floats, is_quaternion: bool) -> Floats:
    """Noise of the distance of a message from its pose, rad, from that of its components (..., k): the largest of
    angles, the angle of a rotation."""
    return 2.0 * np.sqrt(np.sum(sigma**2, axis=-1)) if is_quaternion else np.max(sigma, axis=-1)


class EncoderNoise:
    """The noise of the messages, as those before each of them tell it.

    Messages are taken 32 by 32, and the medians of their differences tell their noise: the third differences, unless
    the second ones are larger than noise would have them, as in a slew. The median of the last five that are known is
    the noise of the next 32 messages; the first 32 have their own. It is 0 where messages are farther apart than 0.1 s.
    It does not depend on how the messages were divided into batches.
    """

    def __init__(self, is_quaternion: bool) -> None:
        self._is_quaternion = is_quaternion
        self._waiting = Stream.empty(0)  # messages of the block that is not complete
        self._noises = np.empty(0)  # of the blocks before, rad; empty before the first message

    def waits_for_more(self, pose: Stream) -> bool:
        """Tell whether these messages, all that came so far, are too few for the noise of the first ones."""
        return not self._noises.size and len(pose) < SAMPLE and not _begins_slowly(pose)

    def of_next(self, pose: Stream) -> Floats:
        """The noise (m,) of distances of these messages, which are the next ones, from their poses, rad."""
        stream = self._waiting + pose
        complete = len(stream) // SAMPLE * SAMPLE
        noises = self._of_blocks(stream[:complete])
        if not self._noises.size:
            known = len(noises) and np.isfinite(noises[0]) and not _begins_slowly(pose)
            self._noises = np.full(_BLOCKS, noises[0] if known else 0.0)
        noises = np.concatenate([self._noises, noises])
        noises = noises[np.maximum.accumulate(np.where(np.isfinite(noises), np.arange(len(noises)), 0))]
        usual = np.median(np.lib.stride_tricks.sliding_window_view(noises, _BLOCKS), axis=1)
        self._noises, self._waiting = noises[-_BLOCKS:], stream[complete:]
        return np.repeat(usual, SAMPLE)[len(stream) - len(pose) : len(stream)]

    def _of_blocks(self, stream: Stream) -> Floats:
        """Return the noise (b,) of complete blocks, rad; NaN of those in which the platform moves."""
        values = stream.values.reshape(-1, SAMPLE, stream.values.shape[1])
        usual = normal_quantile(0.75)  # size of a normal number of unit variance
        by_second, by_third = (
            distance_sigma(
                np.median(np.abs(np.diff(values, order, axis=1)), axis=1) / (usual * math.sqrt(variance)),
                self._is_quaternion,
            )
            for order, variance in ((2, 6.0), (3, 20.0))
        )
        stamps = stream.time_ns.reshape(-1, SAMPLE)
        slow = stamps[:, -1] - stamps[:, 0] > (SAMPLE - 1) * _LONGEST_PERIOD_NS
        return np.where(by_third < _WHITE * by_second, np.nan, np.where(slow, 0.0, by_third))


def _begins_slowly(pose: Stream) -> bool:
    """Tell whether the first two messages are too far apart to tell noise."""
    return len(pose) > 1 and int(pose.time_ns[1] - pose.time_ns[0]) > _LONGEST_PERIOD_NS
