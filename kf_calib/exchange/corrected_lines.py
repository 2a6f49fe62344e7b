"""Lines of JSON or CSV with the readings in them corrected, as they come: the same lines otherwise (docs/format.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.sources.files.line_parts import Account, LineReader
from kf_calib.sources.files.lines import Cutter, reader_for


class CorrectedLines:
    """Corrects lines that come in blocks of bytes; memory is that of one block and one line.

    A header, the description of a bench, angles and temperatures pass as they are. Lines that cannot be used are left
    out and counted, as are readings that come before the first temperature where one is needed. columns: our name for
    each foreign column or key. readings: how many have been corrected.
    """

    def __init__(self, correction: Correction, columns: Mapping[str, str] = MappingProxyType({})) -> None:
        self._correct, self._columns = correction, columns
        self._needs_temperature = bool(correction.needs_temperature)
        self._account, self._reader, self._temperature_c = Account(), None, np.nan
        self._cutter = Cutter(self._account)
        self._reader: LineReader | None = None
        self.readings = 0

    def push(self, block: bytes) -> bytes:
        """The lines that end in ``block``, corrected."""
        return self._corrected(self._cutter.push(block))

    def rest(self) -> bytes:
        """The line without an end, if there is one. Raises InputError where no readings have come at all."""
        last = self._corrected(self._cutter.rest())
        if not self.readings:
            advice = f": {self._reader.advice}" if self._reader else ": check that the logger wrote any"
            found = "".join(f"; {sentence.rstrip('.')}" for sentence in self.warnings)
            raise InputError(f"standard input: no readings to correct in {self._account.lines} lines{found}{advice}.")
        return last

    @property
    def warnings(self) -> list[str]:
        """What was left out; unknown names are none of it: they pass."""
        self._account.unknown.clear()
        return self._account.sentences()

    def _corrected(self, lines: list[str]) -> bytes:
        """Return lines, corrected; the readings of all of them at once."""
        raw = list[tuple[int, str, list[float], float]]()  # number, line, readings, temperature
        out = dict[int, str]()
        for number, line in enumerate(lines, self._account.lines + 1):
            for readings in self._read(line, number):
                if readings is None:
                    out[number] = line
                else:
                    raw.append((number, line, readings, self._temperature_c))
        self._account.lines += len(lines)
        if raw:
            values = np.array([readings for _, _, readings, _ in raw])
            forces = self._correct(values, np.array([temperature for *_, temperature in raw]))
            for (number, line, *_), force in zip(raw, forces, strict=True):
                self._put(out, number, line, force.tolist())
        return "".join(f"{out[number]}\n" for number in sorted(out)).encode()

    def _put(self, out: dict[int, str], number: int, line: str, force: list[float]) -> None:
        """Add a corrected line."""
        assert self._reader is not None
        if not np.isfinite(force).all():
            self._account.refuse(number, "no specific force gives these readings")
            return
        out[number] = self._reader.with_readings(line, force)
        self.readings += 1

    def _read(self, line: str, number: int) -> Iterator[list[float] | None]:
        """Yield the readings of a line; None: it has none, and passes; nothing where it is left out."""
        if self._reader is None:
            text = line.lstrip("\ufeff").strip()
            if not text:
                return
            try:
                self._reader, _ = reader_for([text], self._columns, self._account, angles=False)
            except InputError as error:
                raise InputError(f"standard input: {error}") from None
            if text[0] not in "{[":  # the header
                yield None
                return
        before = self._account.malformed
        batch = self._reader.read([line], number)
        if len(batch.temperature):
            self._temperature_c = float(batch.temperature.values[-1, 0])
        if not len(batch.accel):
            if self._account.malformed == before:
                yield None
        elif self._needs_temperature and np.isnan(self._temperature_c):
            self._account.refuse(number, "it came before the first temperature, which the calibration needs")
        else:
            yield batch.accel.values[0].tolist()
