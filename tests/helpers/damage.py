"""Bytes of a file as a bad disk or cable leaves them."""

import random
from collections.abc import Callable, Sequence


def damaged(
    content: bytes, rng: random.Random, scraps: Sequence[bytes], place: Callable[[int], int] | None = None
) -> bytes:
    """Some flipped, cut out, doubled, put from elsewhere, or replaced by scraps; place: chosen of so many."""
    made, place = bytearray(content), place or rng.randrange
    for _ in range(rng.choice([1, 1, 2, 5])):
        at, other, size, kind = place(len(made)), rng.randrange(len(made)), rng.choice([1, 4, 40]), rng.randrange(5)
        if kind == 0:
            made[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del made[at : at + size]
        elif kind == 2:
            made[at:at] = made[at : at + size]
        elif kind == 3:
            made[at : at + size] = made[other : other + size]
        else:
            made[at : at + 1] = rng.choice(scraps)
    return bytes(made)
