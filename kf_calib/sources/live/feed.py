"""Where a live source gets its samples from: what every kind of feed has, and how the source stands at one moment."""

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


@dataclass(frozen=True, slots=True)
class Status:
    """A live source at one moment.

    link: connecting, live, lost (being tried again) or ended; trouble: why it is down. rate_hz: readings a second, of
    the last two seconds. samples: readings; poses: angle messages. refused: lines or frames that could not be used,
    with the reason of the first. gaps: places where the stamps leap or the link broke; missing: readings lost on the
    way, exact where the bench numbers its frames, else what the gaps have room for. clock_restarts: how often the
    bench's clock was set during the run; left_out: readings whose stamps are damaged or not later than those before
    them, which the evaluation leaves out; clock_trouble: what is wrong with the clock, or was. dropped: readings that
    the consumer was too slow for and that are in no recording; waiting: readings on their way to it. recorded: readings
    in whole chunks of the recording; sync_age_s: age of the newest that the disk is known to hold, None without an open
    recording; recording_trouble: why it ended early.
    """

    link: str = "connecting"
    trouble: str = ""
    rate_hz: float = 0.0
    samples: int = 0
    poses: int = 0
    temperatures: int = 0
    refused: int = 0
    first_refusal: str = ""
    gaps: int = 0
    missing: int = 0
    clock_restarts: int = 0
    left_out: int = 0
    clock_trouble: str = ""
    dropped: int = 0
    waiting: int = 0
    reconnects: int = 0
    bytes: int = 0
    recorded: int = 0
    sync_age_s: float | None = None
    recording_trouble: str = ""

    def sentences(self) -> list[str]:
        """What a user must know once the run has ended."""
        said = [
            (self.reconnects, f"the link was lost and regained {self.reconnects} times"),
            (self.missing, f"{self.missing} readings were lost on the way, in {self.gaps} gaps"),
            (self.clock_trouble, self.clock_trouble),
            (
                self.left_out,
                f"{self.left_out} readings have stamps that are damaged or not later than those before them, and are "
                "left out: check the bench's clock",
            ),
            (self.dropped, f"{self.dropped} readings came faster than they could be evaluated and were left out"),
            (self.recording_trouble, self.recording_trouble.removesuffix(".")),
            (self.trouble, self.trouble.removesuffix(".")),
        ]
        return [f"{text}." for condition, text in said if condition]
