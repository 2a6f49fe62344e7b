"""How the numbers of a converter are to be read: as they are, wrapped round, or about a code that is not zero.

A converter of N bits has 2^N codes. Read without their sign, negative numbers are too large by 2^N; in offset binary,
no force is a code in the middle of the range. Either shows where the sensor rests in several directions: the size of
the readings is about the same only once the numbers are read rightly.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats, Mask, lengths
from kf_calib.errors import BenchError, CountsError
from kf_calib.support.text import cut, number_from

SIGNED = "signed"
_LIKE, _MOST = 0.2, 0.8  # of their median, sizes of readings at rest; share of rows that rest
_FEWEST, _LEAST_BITS = 6, 8
_FAR, _FIT, _WIDE = 1.5, 0.06, 0.3  # of a size: how far codes are offset, what a sphere may leave, how wide all are


class ConverterCodes(NamedTuple):
    """period: what too large numbers are too large by, 0 where none are; offset (3): the codes of no force."""

    period: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def signed(self, numbers: Floats) -> Floats:
        """Numbers (n, 3) about zero."""
        if self.period:
            return np.where(numbers >= 0.5 * self.period, numbers - self.period, numbers)
        return numbers - np.array(self.offset)

    def unsigned(self, numbers: Floats) -> Floats:
        """What ``signed`` inverts."""
        return np.mod(numbers, self.period) if self.period else numbers + np.array(self.offset)


def parse_counts(text: str) -> ConverterCodes:
    """``signed``, ``unsigned16`` (or so many bits), ``wrap=4.096`` or ``offset=512`` (or one for each channel); raises
    BenchError."""
    word, _, value = text.strip().partition("=")
    try:
        if match := re.fullmatch(r"unsigned(\d{1,2})", word) if not value else None:
            return ConverterCodes(2.0 ** int(match[1]))
        numbers = [number_from(part) for part in value.split(",")] if value else []
        if word == SIGNED and not value:
            return ConverterCodes()
        if word == "wrap" and len(numbers) == 1 and 0.0 < numbers[0] < math.inf:
            return ConverterCodes(numbers[0])
        if word == "offset" and len(numbers) in (1, 3) and all(map(math.isfinite, numbers)):
            x, y, z = numbers if len(numbers) == 3 else numbers * 3
            return ConverterCodes(offset=(x, y, z))
    except ValueError:
        pass
    raise BenchError(
        f"counts are {cut(text, 60)!r}: give signed, unsigned16 (or as many bits as the converter has), wrap=4.096 "
        "(what negative numbers are too large by), or offset=512 (the number at no force), for example --counts "
        "unsigned16."
    )


def counts_in(numbers: Floats) -> str:
    """How numbers (n, 3) of a sensor that mostly rests are to be read, as ``parse_counts`` takes it; empty where they
    are right as they are, or nothing tells."""
    numbers = numbers[np.isfinite(numbers).all(axis=1)]
    if len(numbers) < _FEWEST or numbers.min() < 0.0 or not numbers.any():
        return ""
    return _offset_in(numbers) if _rests(numbers).mean() > _MOST else _wrapped_in(numbers) or _offset_in(numbers)


def refuse_unread(numbers: Floats, stated: str, name: str = "the run") -> None:
    """Raise CountsError where the numbers (n, 3) of readings show that they are to be read otherwise than is stated."""
    if stated == SIGNED and (told := counts_in(numbers)):
        exact = ": state exactly what the converter has, such as 2^20 counts of 3.9e-6" if "wrap" in told else ""
        raise CountsError(
            f"{name}: the readings are about as large in every direction only where their numbers are read as {told} "
            f"(of a converter without a sign, or about another code than 0): add --counts {told}{exact}.",
            {"counts": told},
        )


def _wrapped_in(numbers: Floats) -> str:
    """Return what too large numbers are too large by: as many codes as the converter has, or what makes sizes alike."""
    most = float(numbers.max())
    told = f"unsigned{max(math.ceil(math.log2(most + 1.0)), _LEAST_BITS)}"
    if most > 100.0 and _is_better(told, numbers):
        return told
    periods = most * np.linspace(1.001, 1.5, 500)
    sizes = [lengths(ConverterCodes(period).signed(numbers)) for period in periods]
    spread = [float(np.std(own) / np.mean(own)) for own in sizes]
    told = f"wrap={periods[int(np.argmin(spread))]:.3g}"
    return told if _is_better(told, numbers) else ""


def _rests(numbers: Floats) -> Mask:
    """Return of which rows the size is about the usual one."""
    sizes = lengths(numbers)
    return np.abs(sizes - np.median(sizes)) < _LIKE * np.median(sizes)


def _is_better(told: str, numbers: Floats) -> bool:
    counts = parse_counts(told)
    signed = counts.signed(numbers)
    is_small = float(np.median(lengths(signed))) < counts.period / 3.0
    return bool(is_small and (signed < 0.0).any() and _rests(signed).mean() > _MOST)


def _offset_in(numbers: Floats) -> str:
    """Return the codes of no force as the middle of the sphere on which the readings lie; empty where they do not."""
    rows = np.column_stack([2.0 * numbers, np.ones(len(numbers))])
    squares = lengths(numbers) ** 2
    (*middle, constant), *_ = np.linalg.lstsq(rows, squares, rcond=None)
    size = math.sqrt(max(constant + float(np.dot(middle, middle)), 0.0))
    left = np.abs(lengths(numbers - np.array(middle)) - size)
    is_round = size > 0.0 and float(np.quantile(left, _MOST)) < _FIT * size
    widths = np.linalg.svd(numbers - numbers.mean(axis=0), compute_uv=False) / math.sqrt(len(numbers))
    is_round &= float(widths.min()) > _WIDE * size  # directions are all about, not in a plane
    if not is_round or min(middle) < _FAR * size:
        return ""
    return "offset=" + ",".join(f"{code:.0f}" if size > 20.0 else f"{code:.3g}" for code in middle)
