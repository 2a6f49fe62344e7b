"""From the name of a positioner to one that is open: ``sim://…``, ``hand``, the name or the file of a profile."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from kf_calib.bench.bench import Bench
from kf_calib.errors import InputError
from kf_calib.positioning.drive import Time, WallTime
from kf_calib.positioning.positioner import HandPositioner, Positioner, Watchfulness
from kf_calib.positioning.profile import read_profile
from kf_calib.positioning.profiled import CommandPositioner, LinePositioner
from kf_calib.positioning.simulated import DrivenFeed, SimulatedPositioner, SimulatedTime, open_simulated
from kf_calib.support import file_lock

HAND = "hand"


@dataclass(frozen=True)
class Opened:
    """A positioner that is open. feed: of the readings that come with it; None where they come from elsewhere."""

    positioner: Positioner
    watch: Watchfulness
    clock: Time
    feed: DrivenFeed | None = None


def open_simulation(name: str, keys: Mapping[str, str]) -> Opened:
    """The emulated bench of a URL, positioner and source in one; raises InputError."""
    bench, speed = open_simulated(name, keys)
    feed = DrivenFeed(bench.run.bench)
    return Opened(SimulatedPositioner(bench), Watchfulness(), SimulatedTime(bench, feed, speed), feed)


@contextmanager
def open_positioner(name: str, bench: Bench, say: Callable[[str], None]) -> Iterator[Opened]:
    """The positioner of this name for a bench, locked against other programs until the end of the block.

    say: tells a person what to do. Raises InputError where it is not known or another program has it, PositionerError
    where it does not answer.
    """
    width = len(bench.axes)
    if not width:
        raise InputError("the bench has no gimbals that could be driven: state its axes, for example --axes 'y z x'.")
    if name == HAND:
        yield Opened(HandPositioner([0.0] * width, say), Watchfulness().by_hand(), WallTime())
        return
    profile = read_profile(Path(name), width)
    with _locked(profile.address or str(Path(name).resolve())):
        kind = {"lines": LinePositioner, "command": CommandPositioner}[profile.kind]
        positioner = kind(profile)
        try:
            yield Opened(positioner, profile.watch, WallTime())
        finally:
            with suppress(Exception):
                positioner.close()


@contextmanager
def _locked(address: str) -> Iterator[None]:
    """Keep other programs of this package from the same positioner."""
    number = hashlib.sha256(address.strip().upper().encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"kf_calib-positioner-{number}.lock"
    with path.open("ab") as file:
        if not file_lock.lock(file):
            holder = file_lock.writer(path) or "another run"
            raise InputError(f"{holder} drives the positioner at {address}: end it first.")
        yield
