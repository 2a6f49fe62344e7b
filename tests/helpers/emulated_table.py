"""A driven bench with its controller on a socket, whose time passes in a thread."""

import threading
import time
from pathlib import Path
from typing import Self

from positioner_emulator import Server

from kf_calib.positioning.profile import SHIPPED
from kf_calib.sources.simulation.driven import DrivenBench, Servo
from kf_calib.sources.simulation.options import simulation
from kf_calib.sources.simulation.settings import SimulationOptions


class Table:
    """tick_s: by how much the bench goes on at a time; pause_s: between two of these."""

    def __init__(self, servo: Servo, tick_s: float = 0.02, pause_s: float = 0.02, sample_hz: float = 20.0) -> None:
        run, self.lock = simulation(SimulationOptions(sample_hz=sample_hz), {}), threading.Lock()
        self.bench, self._tick_s, self._pause_s = DrivenBench(run, servo, [0.0, 0.0, 0.0]), tick_s, pause_s
        self.server, self._is_over = Server(self.bench, self.lock), False
        self._thread = threading.Thread(target=self._pass, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()
        self.server.close()

    def _pass(self) -> None:
        while not self._is_over:
            with self.lock:
                self.bench.advance(self._tick_s)
            time.sleep(self._pause_s)

    def profile(self, folder: Path, name: str = "lines", more: str = "") -> str:
        """The path of a shipped profile with the address of the controller, and further keys."""
        lines = (SHIPPED / f"{name}.toml").read_text().splitlines()
        addressed = [f'address = "{self.server.url}"' if line.startswith("address") else line for line in lines]
        path = folder / f"{name}.toml"
        path.write_text("\n".join([*addressed, more]))
        return str(path)


def said(text: str) -> None:
    """What a person is told; nobody is there."""
