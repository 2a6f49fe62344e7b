"""Where a decision changes, as one number of what it is made from grows."""

from collections.abc import Callable


def begins_at(holds: Callable[[float], object], low: float, high: float) -> float:
    """The value between low and high from which on a condition holds, by bisection of the ratio, to one in 1e9.

    The condition must not hold at low, and hold at high.
    """
    assert not holds(low) and holds(high)
    while high > (1.0 + 1e-9) * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
