"""A simulated bench that sends its samples over TCP or a pseudo-terminal, with faults on request.

    tools/bench_emulator.py --tcp 0 --format frames --sim "sample_hz=1000&dwell_s=5" --faults drop,garbage --every 500

It prints where it listens, waits for the first client, sends the run in real time (``--speed``), and in the end prints
what became of every reading as one JSON object. Faults are drawn from ``--seed``: drop (a reading is not sent), garbage
(random bytes between two samples), damage (a byte of a sample is changed), stall (nothing for a while, the samples
follow at once), burst (half a second of samples at once), disconnect (the connection ends amid a sample; what comes
before the next client is lost), vanish (as a loss of power: nothing comes over the connection any more, which does not
end), step (the clock jumps by up to 5 s either way), restart (the clock starts at zero again), freeze (the clock stands
still for a while). Listens on 127.0.0.1 only.

With ``--positioner PORT`` the platform goes where a controller on that port is told (``positioner_emulator``), for
``kf-calib run --positioner``; ``--servo`` says how it moves, and what fails.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

import numpy as np
from positioner_emulator import DrivenRun, Server

from kf_calib.bench.streams import Batch
from kf_calib.sources.live import frames
from kf_calib.sources.simulation.driven import DrivenBench, Servo
from kf_calib.sources.simulation.options import options_from_query, simulation
from kf_calib.sources.simulation.simulator import START_NS, Simulation

FAULTS = ("drop", "garbage", "damage", "stall", "burst", "disconnect", "vanish", "step", "restart", "freeze")
_STEP_S = 0.001
_KINDS = (frames.ACCEL, frames.ANGLES, frames.TEMPERATURE)


class Tcp:
    """One client at a time on 127.0.0.1; what is sent while there is none is lost."""

    def __init__(self, port: int = 0) -> None:
        self._server = socket.create_server(("127.0.0.1", port))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._client: socket.socket | None = None
        self._vanished = list[socket.socket]()

    def wait(self, seconds: float) -> bool:
        """Whether a client is there, which is waited for."""
        if self._client is None:
            self._server.settimeout(max(seconds, 1e-3))
            try:
                self._client = self._server.accept()[0]
            except TimeoutError:
                return False
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client.settimeout(10.0)
        return True

    def send(self, data: bytes) -> bool:
        if self._client is None:
            return False
        try:
            self._client.sendall(data)
        except OSError:
            self.disconnect()
            return False
        return True

    def disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def vanish(self) -> None:
        """Leaves the client with a connection over which nothing comes any more."""
        if self._client is not None:
            self._vanished.append(self._client)
            self._client = None

    def close(self) -> None:
        self.disconnect()
        for client in self._vanished:
            client.close()
        self._server.close()


class Pty:
    """A pseudo-terminal, which looks like a serial port; what nobody reads in time is lost, as there."""

    def __init__(self) -> None:
        import tty

        self._ours, theirs = os.openpty()
        tty.setraw(theirs)
        os.set_blocking(self._ours, False)
        self.url = os.ttyname(theirs)
        os.close(theirs)  # as long as nobody else opens it, it is hung up

    def wait(self, seconds: float) -> bool:
        """Whether somebody has opened it, which is waited for."""
        until_s = time.monotonic() + seconds
        while self._is_hung_up():
            if time.monotonic() >= until_s:
                return False
            time.sleep(0.02)
        time.sleep(0.2)  # opening a port empties its buffers
        return True

    def send(self, data: bytes) -> bool:
        until_s = time.monotonic() + 2.0
        while data:
            if self._is_hung_up() or time.monotonic() > until_s:
                return False
            if select.select([], [self._ours], [], 0.1)[1]:
                data = data[os.write(self._ours, data) :]
        return True

    def disconnect(self) -> None:
        """A terminal has no connection to end."""

    def vanish(self) -> None:
        """A terminal has no connection to lose."""

    def close(self) -> None:
        time.sleep(0.2)  # what is not read when a terminal hangs up is lost
        os.close(self._ours)

    def _is_hung_up(self) -> bool:
        poll = select.poll()
        poll.register(self._ours, select.POLLOUT)
        return any(event & select.POLLHUP for _, event in poll.poll(0))


def as_frame(kind: int, number: int, time_ns: int, values: Sequence[float]) -> bytes:
    return frames.sample(kind, number, time_ns, values)


_JSON_KEYS = {frames.ACCEL: "accel_mps2", frames.ANGLES: "angles_rad"}


def as_json(kind: int, number: int, time_ns: int, values: Sequence[float]) -> bytes:
    entry = {_JSON_KEYS[kind]: values} if kind in _JSON_KEYS else {"temperature_c": values[0]}
    return (json.dumps({"time_ns": time_ns, **entry}) + "\n").encode()


_BEFORE = {frames.ACCEL: 0, frames.ANGLES: 3, frames.TEMPERATURE: 6}
_CSV_HEADER = b"time_ns,ax_mps2,ay_mps2,az_mps2,outer_rad,middle_rad,inner_rad,temperature_c\n"


def as_csv(kind: int, number: int, time_ns: int, values: Sequence[float]) -> bytes:
    cells = ["", "", "", "", "", "", ""]
    cells[_BEFORE[kind] : _BEFORE[kind] + len(values)] = map(repr, values)
    return f"{time_ns},{','.join(cells)}\n".encode()


FORMATS: dict[str, Callable[[int, int, int, Sequence[float]], bytes]] = {
    "frames": as_frame,
    "json": as_json,
    "csv": as_csv,
}


@dataclass
class Ledger:
    """What became of the readings, and the stamps (ns) of those that were sent whole."""

    readings: int = 0
    sent: int = 0
    faults: Counter[str] = field(default_factory=Counter[str])
    dropped: int = 0
    damaged: int = 0
    unsent: int = 0
    stamps_ns: list[int] = field(default_factory=list[int])

    def summary(self) -> dict[str, object]:
        return {key: value for key, value in vars(self).items() if key != "stamps_ns"}


class Emulator:
    """Sends ``run`` through ``outlet``.

    every: samples between two faults on average. wall: stamps are the time of sending. keep: stamps are remembered.
    """

    def __init__(
        self, run: Simulation | DrivenRun, outlet: Tcp | Pty, form: str = "json", *, speed: float = 1.0,
        faults: Sequence[str] = (), every: float = 500.0, seed: int = 0, wall: bool = False, keep: bool = False,
        most_faults: int = 1 << 60, outage_s: float = 0.2,
    ) -> None:  # fmt: skip
        self.ledger = Ledger()
        self.url = outlet.url
        self._run, self._outlet, self._form, self._speed = run, outlet, form, speed
        self._faults, self._every, self._wall, self._keep = tuple(faults), every, wall, keep
        self._left, self._outage_s = most_faults, outage_s
        self._rng = np.random.default_rng(seed)
        self._numbers = dict.fromkeys(_KINDS, 0)
        self._shift_ns = 0
        self._frozen: tuple[int, int] | None = None  # the stamp that stays, and until which time of the run
        self._hold_until_s = 0.0
        self._away_until_s = 0.0
        self.stopping = False

    def opening(self) -> bytes:
        """What the bench says first."""
        metadata = self._run.bench.to_metadata()
        if self._form == "frames":
            return b"\0" + frames.bench(metadata)
        if self._form == "json":
            return (json.dumps({"bench": metadata}) + "\n").encode()
        return _CSV_HEADER

    def serve(self, wait_s: float = 30.0) -> Ledger:
        """Waits for the first client, then sends the whole run."""
        try:
            if self._outlet.wait(wait_s):
                self._outlet.send(self.opening())
                self._send_all()
        finally:
            self._outlet.close()
        return self.ledger

    def in_background(self) -> threading.Thread:
        thread = threading.Thread(target=self.serve, daemon=True)
        thread.start()
        return thread

    def _send_all(self) -> None:
        started_s, is_here = time.monotonic(), True
        for batch in self._run:
            for due_ns, samples in _in_steps(batch, round(_STEP_S * 1e9 * self._speed)):
                if self.stopping:
                    return
                due_s = started_s + (due_ns - START_NS) * 1e-9 / self._speed
                if (ahead_s := due_s - time.monotonic()) > 0.0:
                    time.sleep(ahead_s)
                while time.monotonic() < self._hold_until_s:
                    time.sleep(_STEP_S)
                if not is_here and time.monotonic() >= self._away_until_s and self._outlet.wait(0.0):
                    is_here = self._outlet.send(self.opening())
                pieces = [piece for sample in samples for piece in self._with_fault(*sample, is_here)]
                is_here = self._send(pieces, is_here)

    def _send(self, pieces: Sequence[tuple[bytes, int | None, bool]], is_here: bool) -> bool:
        """Whether the client is still there after these pieces (bytes, stamp of a reading, is the last)."""
        waiting, stamps = bytearray(), list[int]()
        for data, stamp, is_last in pieces:
            waiting += data
            stamps += [] if stamp is None else [stamp]
            if is_last and is_here:
                if self._outlet.send(bytes(waiting)):
                    self._sent(stamps)
                else:
                    self.ledger.unsent += len(stamps)
                self._outlet.disconnect()
                waiting, stamps, is_here = bytearray(), [], False
        if is_here and waiting:
            is_here = self._outlet.send(bytes(waiting))
            if is_here:
                self._sent(stamps)
                return True
        self.ledger.unsent += len(stamps)
        return is_here

    def _sent(self, stamps: list[int]) -> None:
        self.ledger.sent += len(stamps)
        if self._keep:
            self.ledger.stamps_ns += stamps

    def _stamp(self, time_ns: int) -> int:
        if self._frozen and time_ns < self._frozen[1]:
            return self._frozen[0]
        return time.time_ns() if self._wall else time_ns + self._shift_ns

    def _with_fault(
        self, kind: int, time_ns: int, values: list[float], is_here: bool
    ) -> Iterator[tuple[bytes, int | None, bool]]:
        """The bytes of one sample, and what happens to it."""
        is_reading = kind == frames.ACCEL
        self.ledger.readings += is_reading
        number, self._numbers[kind] = self._numbers[kind], self._numbers[kind] + 1
        stamp = self._stamp(time_ns)
        data = FORMATS[self._form](kind, number, stamp, values)
        whole = (data, stamp if is_reading else None, False)
        if not (self._faults and is_here and self._left > 0 and self._rng.random() < 1.0 / self._every):
            yield whole
            return
        fault = self._faults[int(self._rng.integers(len(self._faults)))]
        self._left -= 1
        self.ledger.faults[fault] += 1
        match fault:
            case "drop":
                self.ledger.dropped += is_reading
            case "garbage":
                yield whole
                yield (
                    self._rng.bytes(int(self._rng.integers(1, 400))) + (b"\0" if self._form == "frames" else b"\n"),
                    None,
                    False,
                )
            case "damage":
                self.ledger.damaged += is_reading
                damaged = bytearray(data)
                at = int(self._rng.integers(len(data) - 1))
                damaged[at] = ord("?") if damaged[at] != ord("?") else ord("!")
                yield bytes(damaged), None, False
            case "stall":
                self._hold_until_s = time.monotonic() + float(self._rng.uniform(0.05, 0.2))
                yield whole
            case "burst":
                self._hold_until_s = time.monotonic() + 0.5 / self._speed
                yield whole
            case "disconnect":
                self.ledger.unsent += is_reading
                self._away_until_s = time.monotonic() + self._outage_s * float(self._rng.random())
                yield data[: len(data) // 2], None, True
            case "vanish":
                self._away_until_s = time.monotonic() + self._outage_s * float(self._rng.random())
                yield whole
                self._outlet.vanish()
            case "restart":
                self._shift_ns = -time_ns
                yield whole
            case "freeze":
                self._frozen = (stamp, time_ns + int(self._rng.uniform(0.05e9, 0.5e9)))
                yield whole
            case _:
                self._shift_ns += int(self._rng.uniform(-5e9, 5e9))
                yield whole


def _in_steps(batch: Batch, step_ns: int) -> Iterator[tuple[int, list[tuple[int, int, list[float]]]]]:
    """The samples of a batch in order of time, those of one step together: (when due, [(kind, stamp, values)])."""
    merged: list[tuple[int, int, list[float]]] = []
    for kind, stream in zip(_KINDS, (batch.accel, batch.pose, batch.temperature), strict=True):
        merged += [(kind, t, v) for t, v in zip(stream.time_ns.tolist(), stream.values.tolist(), strict=True)]
    merged.sort(key=lambda sample: sample[1])
    start = 0
    while start < len(merged):
        end, until = start, merged[start][1] + step_ns
        while end < len(merged) and merged[end][1] < until:
            end += 1
        yield merged[end - 1][1], merged[start:end]
        start = end


def driven_run(run: Simulation, servo: str, port: int, lasts_s: float) -> DrivenRun:
    """The same bench with its platform at zero, moved by a controller, whose address is printed."""
    numbers = {key: text if key == "fault" else float(text) for key, text in parse_qsl(servo)}
    lock, bench = threading.Lock(), DrivenBench(run, Servo(**numbers), [0.0] * len(run.bench.axes))
    print(Server(bench, lock, port).url, flush=True)
    return DrivenRun(bench, lock, 0.02, lasts_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--tcp", type=int, default=0, metavar="PORT", help="0: any that is free")
    where.add_argument("--pty", action="store_true", help="a pseudo-terminal in place of TCP")
    parser.add_argument("--format", choices=sorted(FORMATS), default="json")
    parser.add_argument("--sim", default="", metavar="QUERY", help="as in sim://?QUERY, e.g. sample_hz=1000&dwell_s=5")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--faults", default="", help=f"some of {','.join(FAULTS)}, or all")
    parser.add_argument("--every", type=float, default=500.0, help="samples between faults, on average")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wall", action="store_true", help="stamps are the time of sending")
    parser.add_argument("--wait-s", type=float, default=600.0, help="how long the first client is waited for")
    parser.add_argument("--positioner", type=int, metavar="PORT", help="a controller moves the platform; 0: any port")
    parser.add_argument("--servo", default="", metavar="QUERY", help="e.g. rate_degps=60&fault=stall")
    parser.add_argument("--lasts-s", type=float, default=86400.0, help="how long a platform that is driven measures")
    chosen = parser.parse_args()
    faults = FAULTS if chosen.faults == "all" else tuple(filter(None, chosen.faults.split(",")))
    if unknown := set(faults) - set(FAULTS):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}")
    run = simulation(options_from_query(chosen.sim), {}, 2048)
    if chosen.positioner is not None:
        run = driven_run(run, chosen.servo, chosen.positioner, chosen.lasts_s)
    emulator = Emulator(
        run, Pty() if chosen.pty else Tcp(chosen.tcp), chosen.format, speed=chosen.speed, faults=faults,
        every=chosen.every, seed=chosen.seed, wall=chosen.wall,
    )  # fmt: skip
    print(emulator.url, flush=True)
    print(json.dumps(emulator.serve(chosen.wait_s).summary()), flush=True)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
