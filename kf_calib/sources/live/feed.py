"""Where a live source gets its samples from: what every kind of feed has."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.files.line_parts import Account

IDLE_S = 0.02
"""How long is waited for more where nothing has come."""


@dataclass(frozen=True)
class Lost:
    """The link broke, and why: what follows, if anything does, comes after a gap."""

    reason: str


@dataclass(frozen=True)
class Regained:
    """The link is up again, after so many seconds."""

    after_s: float


def nothing(pose_width: int) -> Batch:
    """What a feed gives while nothing comes, so that there is time to see to the recording."""
    return Batch(Stream.empty(3), Stream.empty(pose_width))


class Feed(ABC):
    """Iterated once, by one thread; ``stop`` may be called from any other, and from a signal handler.

    account: what could not be used. link: connecting, live, lost or ended. patient: nothing is lost where samples are
    asked for later, as of a file. lost: readings known to be lost on the way, where the bench numbers them.
    """

    patient = False

    def __init__(self, name: str) -> None:
        self.name = name
        self.account = Account()
        self.link = "connecting"
        self.trouble = ""
        self.reconnects = 0
        self.bytes = 0
        self.lost: int | None = None
        self.fraction = math.nan
        self.stopping = False

    @property
    def warnings(self) -> list[str]:
        """What was lost, and what was not understood, a sentence each."""
        return [f"{self.name}: {said}" for said in self.account.sentences()]

    @abstractmethod
    def begin(self) -> Bench:
        """Reads on until the bench is known. Raises InputError where it will not be."""

    @abstractmethod
    def __iter__(self) -> Iterator[Batch | Lost | Regained]:
        """All samples, with an empty batch every now and then where none come."""

    def stop(self) -> None:
        """Ends the iteration after what has come. Only sets a flag: a signal handler must not wait for a lock."""
        self.stopping = True

    def close(self) -> None:  # noqa: B027 - most hold nothing open
        """Lets go of what is open; called by the thread that iterates."""
