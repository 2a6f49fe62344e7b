"""How a live source stands at one moment: its link, what came, what was lost, what is recorded."""

from __future__ import annotations

from dataclasses import dataclass


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
