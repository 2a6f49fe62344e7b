"""Allan deviation of the readings in the longest dwells, and what each part of the noise model gives of it.

The overlapping estimate of D. B. Sullivan et al. (NIST Technical Note 1337, 1990) and IEEE Std 952-2020, annex C: with
the sums x_k of the first k readings, each less what the model predicts of it, and clusters of m readings,

  sigma^2(m) = sum_k (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 m^2 (n - 2m + 1))
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import MOST_KEPT
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.noise.block_differences import FEWEST_CLUSTERS
from kf_calib.noise.noise_model import Noise

_DWELLS = 5  # as many of the longest are enough
_PER_OCTAVE = 3


@dataclass(frozen=True)
class AllanDeviation:
    """Allan deviation of readings, pooled over dwells, and the noise model's lines.

    - dwells: numbers of the dwells that were used.
    - tau_s (m,): lengths of the clusters. deviation_mps2 (m, 3): the deviation at each.
    - spread (m,): its relative sigma, 1/sqrt(2 (clusters - 1)).
    - white_mps2 (m, 3): of white noise as the filter has it, sigma_w sqrt(kappa / m).
    - flicker_mps2 (3,): of 1/f noise that would give the scatter between dwells, sqrt(2 h ln 2); 0 without scatter.
    - walk_mps2 (m, 3): of the random walk of each bias, q sqrt(tau / 3); 0 without a walk.
    """

    dwells: tuple[int, ...]
    tau_s: Floats
    deviation_mps2: Floats
    spread: Floats
    white_mps2: Floats
    flicker_mps2: Floats
    walk_mps2: Floats


def deviations(series: Sequence[Floats], sizes: Sequence[int]) -> tuple[Floats, Floats]:
    """Overlapping Allan deviation (m, 3) of several series (n, 3) at once for clusters of these sizes, and the number
    of separate clusters (m,)."""
    squares, counts, clusters = np.zeros((len(sizes), 3)), np.zeros(len(sizes)), np.zeros(len(sizes))
    for values in series:
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
        for place, size in enumerate(sizes):
            if len(values) < 2 * size:
                continue
            second = sums[2 * size :] - 2.0 * sums[size:-size] + sums[: -2 * size]
            squares[place] += (second**2).sum(axis=0) / (2.0 * size**2)
            counts[place] += len(second)
            clusters[place] += len(values) // size
    return np.sqrt(squares / np.maximum(counts, 1.0)[:, None]), clusters


def cluster_sizes(longest: int) -> list[int]:
    """Sizes of clusters from one reading up to a third of the longest dwell, three an octave."""
    most = max(longest // FEWEST_CLUSTERS, 1)
    octaves = np.arange(0, _PER_OCTAVE * np.log2(most) + 1e-9) / _PER_OCTAVE
    return sorted({round(2.0**octave) for octave in octaves})


class Residuals(Protocol):
    """What is needed of the samples of one piece: its dwell, whether it moves, times (n,) and residuals (n, 3)."""

    @property
    def dwell(self) -> int: ...
    @property
    def moving(self) -> bool: ...
    @property
    def elapsed_s(self) -> Floats: ...
    @property
    def residual_mps2(self) -> Floats: ...


_S = TypeVar("_S", bound=Residuals)


@dataclass
class LongestDwells:
    """Collects the residuals of the longest dwells of a run, as many as memory holds but one at least, from its samples
    as these pass by."""

    run: Sequence[Dwell]
    noise: Noise
    kept: dict[int, list[Residuals]] = field(default_factory=dict[int, list[Residuals]])

    def __post_init__(self) -> None:
        dwells = sorted(self.run, key=lambda dwell: -dwell.count)[:_DWELLS]
        total = np.cumsum([dwell.count for dwell in dwells])
        self.kept |= {
            dwell.number: []
            for dwell, sum_so_far in zip(dwells, total, strict=True)
            if dwell is dwells[0] or sum_so_far <= MOST_KEPT
        }

    def passed_by(self, samples: Iterable[_S]) -> Iterator[_S]:
        """Yield the samples, and keep those of the longest dwells."""
        for piece in samples:
            if piece.dwell in self.kept and not piece.moving:
                self.kept[piece.dwell].append(piece)
            yield piece

    def allan_deviation(self) -> AllanDeviation:
        """The Allan deviation of what was collected."""
        series = [np.concatenate([piece.residual_mps2 for piece in pieces]) for pieces in self.kept.values()]
        times = [np.concatenate([piece.elapsed_s for piece in pieces]) for pieces in self.kept.values()]
        period_s = float(np.median(np.concatenate([np.diff(time_s) for time_s in times])))
        sizes = cluster_sizes(max(map(len, series)))
        deviation_mps2, clusters = deviations(series, sizes)
        tau_s, spread = period_s * np.array(sizes), 1.0 / np.sqrt(2.0 * np.maximum(clusters - 1.0, 1.0))
        return AllanDeviation(
            tuple(sorted(self.kept)), tau_s, deviation_mps2, spread,
            *model_lines(self.noise, np.array(sizes), tau_s, len(self.run)),
        )  # fmt: skip


def model_lines(noise: Noise, sizes: Floats, tau_s: Floats, dwells: int) -> tuple[Floats, Floats, Floats]:
    """What white noise (m, 3), 1/f noise (3,) and the walk (m, 3) of a noise model give of the Allan deviation."""
    return (
        noise.effective_sigma_mps2 / np.sqrt(sizes)[:, None],
        np.sqrt(2.0 * np.log(2.0)) * noise.scatter.flicker_mps2(dwells),
        noise.walk_mps2_per_sqrt_s * np.sqrt(tau_s / 3.0)[:, None],
    )
