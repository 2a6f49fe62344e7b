"""The link to a controller that takes lines of text: whole exchanges with a deadline, over whatever PyVISA opens.

A controller may answer late, without end, with what was asked before, or not at all. So the input is emptied before a
line is said, an answer has a deadline and a longest length as a whole, and after one that came too late nothing is
believed until the link was quiet.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kf_calib.errors import InputError, need
from kf_calib.positioning.positioner import PositionerError

LONGEST_ANSWER = 4096
"""Bytes of an answer, at most."""

_SLICE_S = 0.05  # of waiting, after which is looked whether the run is broken off
_QUIET_S = 0.002  # without a byte, the input is empty
_DRAINED = 1 << 16  # bytes that are thrown away at most before a line is said
_ADDRESS = re.compile(
    r"(?:ASRL(?:\d{1,3}|COM\d{1,3}|/dev/[\w.+-]+(?:/[\w.+-]+)*)::INSTR"
    r"|TCPIP\d{0,2}::[\w.:%-]+::(?:\d{1,5}::SOCKET|(?:[\w,]+::)?INSTR)"
    r"|GPIB\d{0,2}::\d{1,2}(?:::\d{1,2})?::INSTR"
    r"|USB\d{0,2}(?:::[\w.-]+){3,4}::(?:INSTR|RAW))",
    re.IGNORECASE,
)


def refuse_address(place: str, address: str) -> None:
    """Raise InputError for what is no address of a device. PyVISA gives serial ports on to a library that takes
    addresses of its own, which write files or open other links."""
    if not _ADDRESS.fullmatch(address) or ".." in address:
        raise InputError(
            f"{place}: {address!r} is no address of a controller: write TCPIP::192.168.53.1::9878::SOCKET, "
            "ASRL/dev/ttyUSB0::INSTR, ASRLCOM3::INSTR or GPIB::12::INSTR."
        )


def device_of(address: str) -> str:
    """One name for each device: however an address is written, it is the same for the same device on this computer."""
    name = address.strip().upper()
    name = re.sub(r"^(TCPIP|GPIB|USB)(?=::)", r"\g<1>0", name)
    name = re.sub(r"::(LOCALHOST|127(?:\.\d+){3}|::1|\[::1\])(?=::)", "::127.0.0.1", name)
    if port := re.fullmatch(r"ASRL(/.+)::INSTR", address.strip(), re.IGNORECASE):
        name = f"ASRL{Path(port[1]).resolve()}::INSTR"
    return name


class LineLink:
    """A link that is open.

    name, address: of the positioner. ending: of its lines. timeout_s: of a whole exchange. broken_off: whether the run
    is broken off, so that nothing is waited for any more. Raises PositionerError.
    """

    def __init__(self, name: str, address: str, ending: str, baud: int, timeout_s: float) -> None:
        need("pyvisa", "positioner", f"the positioner {name}")
        need("pyvisa_py", "positioner", f"the positioner {name}")
        self.broken_off: Callable[[], bool] = lambda: False
        self._name, self._address, self._timeout_s = name, address, timeout_s
        self._ending, self._is_late = ending.encode(), False
        with self._told("opened"):
            import pyvisa

            self._link: Any = pyvisa.ResourceManager("@py").open_resource(address)
            self._link.read_termination = None
            self._link.timeout = 1000.0 * _SLICE_S
            if address.upper().startswith("ASRL"):
                self._link.baud_rate = baud

    def say(self, line: str) -> None:
        """Say a line that is not answered."""
        with self._told(f"told {line!r}"):
            self._link.write_raw(line.encode() + self._ending)

    def ask(self, line: str) -> str:
        """The answer to a line, without its end."""
        with self._told(f"asked {line!r}"):
            self._empty_input()
            self._link.write_raw(line.encode() + self._ending)
            return self._answer(time.monotonic() + self._timeout_s).decode("ascii", errors="backslashreplace").strip()

    def close(self) -> None:
        """Let go of the link."""
        self._link.close()

    def _answer(self, until_s: float) -> bytes:
        """Return what comes up to an end of line; raise PositionerError where none comes in time."""
        answer = bytearray()
        while not answer.endswith(self._ending):
            if self.broken_off():
                self._is_late = True
                raise PositionerError("the answer is not waited for, since the run is broken off")
            if time.monotonic() > until_s:
                self._is_late = True
                said = f"{len(answer)} bytes without an end of line" if answer else "nothing"
                raise PositionerError(f"{said} came within {self._timeout_s:g} s")
            if len(answer) >= LONGEST_ANSWER:
                self._is_late = True
                raise PositionerError(f"the answer is longer than {LONGEST_ANSWER} bytes, and has no end of line")
            answer += self._byte()
        return bytes(answer[: -len(self._ending)])

    def _empty_input(self) -> None:
        """Throw away what has come unasked; after an answer that came too late, until the link is quiet."""
        quiet_s = min(self._timeout_s, 0.5) if self._is_late else _QUIET_S
        until_s, quiet_since_s, count = time.monotonic() + 2.0 * self._timeout_s, time.monotonic(), 0
        self._link.timeout = 1000.0 * min(quiet_s, _SLICE_S)
        try:
            while True:
                if self._byte():
                    count, quiet_since_s = count + 1, time.monotonic()
                elif time.monotonic() - quiet_since_s >= quiet_s:  # seen empty: a busy computer alone is no silence
                    break
                if count > _DRAINED or time.monotonic() > until_s:
                    raise PositionerError("bytes come without end, and nobody asked for them: check the baud rate")
        finally:
            self._link.timeout = 1000.0 * _SLICE_S
        self._is_late = False

    def _byte(self) -> bytes:
        """Return the next byte; none where none comes in a moment."""
        from pyvisa.constants import StatusCode
        from pyvisa.errors import VisaIOError

        try:
            return bytes(self._link.read_bytes(1))
        except VisaIOError as error:
            if error.error_code == StatusCode.error_timeout:
                return b""
            raise

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Turn whatever a link raises into an error of the positioner."""
        try:
            yield
        except Exception as error:  # of PyVISA, of the system, of a library below
            said = " ".join(str(error).split()) or type(error).__name__
            raise PositionerError(f"the positioner {self._name} at {self._address}, {what}: {said}") from error
