"""A dwell that grows block by block is the dwell folded at once, in time linear in its readings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields

import numpy as np
import pytest

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.folding import Folder
from kf_calib.dwells.rows import Rows
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.settings import Settings

BLOCKS = 24


class OneDwell:
    """Blocks of 8192 readings in one orientation."""

    warnings: Sequence[str] = ()
    fraction = 0.0

    def __init__(self, blocks: int) -> None:
        self.blocks, self.bench = blocks, Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0)

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng(3)
        for k in range(self.blocks):
            stamps = np.arange(8192 * k, 8192 * (k + 1), dtype=np.int64) * 1_000_000
            readings = rng.normal([0.0, 9.81, 0.0], 5e-5, (8192, 3))
            yield Batch(Stream(stamps, readings), Stream(stamps[::64], np.zeros((128, 3))))


@pytest.fixture(scope="module")
def rows() -> list[Rows]:
    return list(Pass(OneDwell(BLOCKS), Settings()).rows())


def numbers(value: object) -> list[np.ndarray]:
    """All arrays in a dwell factor, in order."""
    if isinstance(value, np.ndarray | int | float):
        return [np.asarray(value)]
    if isinstance(value, dict):
        return [each for key in sorted(value) for each in numbers(value[key])]
    if isinstance(value, tuple):
        return [each for part in value for each in numbers(part)]
    if value is None:
        return []
    return [each for own in fields(value) for each in numbers(getattr(value, own.name))]


def test_a_dwell_asked_for_at_every_block_is_the_same_to_the_last_bit(rows: list[Rows]) -> None:
    once, often = Folder(), Folder()
    for block in rows:
        once.add(block)
        often.add(block)
        assert len(often.dwells) == 1
    (whole,), (parts,) = once.dwells, often.dwells
    assert whole.count == BLOCKS * 8192 and whole.autocovariance.count >= 8192
    for one, other in zip(numbers(whole), numbers(parts), strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_piece_of_a_long_dwell_is_taken_up_at_every_block(rows: list[Rows], monkeypatch: pytest.MonkeyPatch) -> None:
    handled, merged = [0], Dwell.merge

    def counted(self: Dwell, others: Sequence[Dwell]) -> Dwell:
        out = merged(self, others)
        handled[0] += len(out.pieces)
        return out

    monkeypatch.setattr(Dwell, "merge", counted)
    folder = Folder()
    for block in rows:
        folder.add(block)
    pieces = len(folder.dwells[0].pieces)
    assert pieces > BLOCKS
    assert handled[0] < 2 * pieces  # 13 times as many where each block was merged as it came
