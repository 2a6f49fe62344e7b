"""Words and numbers in figures."""

from __future__ import annotations

from textwrap import fill


def wrapped(text: str, width: int) -> str:
    """A text in lines of at most so many letters, broken between words only: names of effects stay whole."""
    return fill(text, width, break_on_hyphens=False, break_long_words=False)


def rounded_number(value: float, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent unless it is very small."""
    return f"{float(f'{value:.{digits}g}'):.12g}"
