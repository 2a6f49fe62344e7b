"""The controller of an emulated positioner: lines over TCP on 127.0.0.1, as ACL has them or as plain words.

It moves a ``DrivenBench``, whose readings are those of the same platform. ACL: the part that the profile
``acutrol3000`` uses. Plain words: those of the profile ``lines``. On request it misbehaves (``MISBEHAVIOURS``).
"""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Iterator

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch
from kf_calib.sources.simulation.driven import DrivenBench

_PLACES = ("outer", "middle", "inner")
_COMMAND = re.compile(r"^\s*(?P<words>[:*A-Za-z]+\??)\s*(?P<rest>.*)$")


MISBEHAVIOURS = {
    "": "answers as it should",
    "ignores-stop": "does not know the word that stops it",
    "endless": "answers with bytes that have no end of line",
    "trickle": "sends a byte of its answer every tenth of a second",
    "slow": "answers after 1.8 s",
    "late": "answers the first question after its deadline, and later ones at once",
    "one-late": "answers each question with the answer to the one before",
    "error-text": "answers about its position with ERR 0",
    "escape": "answers with commands to a terminal around the angle",
    "two-numbers": "answers with two numbers about one gimbal",
    "immense": "answers 1e999",
    "far": "answers 100000 after it was told to stop",
    "chatter": "sends lines that nobody asked for",
    "silent": "answers nothing",
}
"""Ways in which it may misbehave, and what each is."""


class DrivenRun:
    """The readings of a driven bench as a run that is iterated; its time passes by ``step_s`` each time."""

    def __init__(self, bench: DrivenBench, lock: threading.Lock, step_s: float, lasts_s: float) -> None:
        self._driven, self._lock, self._step_s, self._lasts_s = bench, lock, step_s, lasts_s

    @property
    def bench(self) -> Bench:
        return self._driven.run.bench

    def __iter__(self) -> Iterator[Batch]:
        while self._driven.now_s < self._lasts_s:
            with self._lock:
                batch = self._driven.advance(self._step_s)
            if len(batch.accel):
                yield batch


class Controller:
    """What answers a line; empty where nothing is to be answered. Raises OSError where the link is to be lost."""

    def __init__(self, bench: DrivenBench, lock: threading.Lock) -> None:
        self._bench, self._lock = bench, lock
        self._targets = list(bench.read_deg())
        self._mode = ["Off"] * len(self._targets)

    def answer(self, line: str) -> str:
        with self._lock:
            answers = [self._one(command) for command in line.split(";")]
        return ";".join(answer for answer in answers if answer)

    def _one(self, command: str) -> str:
        match = _COMMAND.match(command)
        if match is None:
            return ""
        words, rest = match["words"].lower(), [part for part in re.split(r"[,\s]+", match["rest"].strip()) if part]
        match words:
            case "*idn?":
                return "kf_calib,emulated positioner,0,1"
            case ":read:position?" | "position?":
                return f"{self._bench.read_deg()[self._gimbal(rest[0])]:.5f}"
            case ":interlock?" | "fault?":
                fault = self._bench.fault
                return f"Fault: {fault}" if fault else ("Closed" if words.startswith(":") else "none")
            case ":mode:position" | ":mode:rate":
                self._mode[self._gimbal(rest[0])] = words.rpartition(":")[2].capitalize()
            case ":demand:position" | "move":
                self._targets[self._gimbal(rest[0])] = float(rest[1])
                self._bench.move_to(self._targets)
            case ":demand:rate" if float(rest[1]) == 0.0:
                self._halt()
            case "stop":
                self._halt()
            case _:
                pass
        return ""

    def _halt(self) -> None:
        self._bench.stop()
        self._targets = list(self._bench.read_deg())

    def _gimbal(self, name: str) -> int:
        return _PLACES.index(name) if name in _PLACES else int(name) - 1


class Server:
    """Serves a controller on 127.0.0.1 to one client after another; ``url`` is the address as PyVISA names it.

    misbehaviour: one of ``MISBEHAVIOURS``, from the first line or, set later, from the next one on.
    """

    def __init__(self, bench: DrivenBench, lock: threading.Lock, port: int = 0, misbehaviour: str = "") -> None:
        self._controller = Controller(bench, lock)
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = self._server.getsockname()[1]
        self.url = f"TCPIP::127.0.0.1::{self.port}::SOCKET"
        self.lines, self.misbehaviour = list[str](), misbehaviour
        self._before, self._is_stopped = "", False
        threading.Thread(target=self._serve, name="positioner", daemon=True).start()

    def close(self) -> None:
        self._server.close()

    def _serve(self) -> None:
        while True:
            try:
                client = self._server.accept()[0]
            except OSError:
                return
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._converse(client)

    def _converse(self, client: socket.socket) -> None:
        waiting = b""
        try:
            while data := client.recv(4096):
                *lines, waiting = (waiting + data).split(b"\n")
                for line in lines:
                    self.lines.append(line.decode(errors="replace").strip())
                    ending = b"\r\n" if line.endswith(b"\r") else b"\n"
                    self._answer(client, self.lines[-1], ending)
        except (OSError, ValueError, IndexError):  # a lost link, or a line that makes no sense: it hangs up
            return

    def _answer(self, client: socket.socket, line: str, ending: bytes) -> None:
        """Send the answer to a line, as it should be or not."""
        stops = "stop" in line.lower() or line.endswith(",0")
        self._is_stopped = self._is_stopped or stops
        if stops and self.misbehaviour == "ignores-stop":
            return
        answer = self._controller.answer(line)
        if not answer:
            return
        is_position = "position?" in line.lower()
        match self.misbehaviour:
            case "endless":
                for _ in range(2000):
                    client.sendall(b"\xfe" * 16)
                    time.sleep(0.005)
            case "trickle":
                for letter in answer:
                    client.sendall(letter.encode())
                    time.sleep(0.1)
                client.sendall(ending)
            case "slow":
                time.sleep(1.8)
                client.sendall(answer.encode() + ending)
            case "late":
                self.misbehaviour = ""
                time.sleep(0.6)
                client.sendall(answer.encode() + ending)
            case "one-late":
                client.sendall((self._before or "0.0").encode() + ending)
            case "silent":
                pass
            case _:
                client.sendall(self._spoilt(answer, is_position).encode() + ending)
        self._before = answer

    def _spoilt(self, answer: str, is_position: bool) -> str:
        """Return an answer with what is wrong with it."""
        if not is_position:
            return answer
        match self.misbehaviour:
            case "error-text":
                return "ERR 0"
            case "escape":
                return f"\x1b[2m{answer}\x1b[0m"
            case "two-numbers":
                return f"{answer} 0.0"
            case "immense":
                return "1e999"
            case "far":
                return "100000" if self._is_stopped else answer
            case "chatter":
                return f"{answer}\nSTATUS 3\n17.5"
            case _:
                return answer
