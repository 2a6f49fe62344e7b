"""What the bytes of a bench mean: JSON lines, CSV lines or binary frames, whichever they begin with."""

from __future__ import annotations

import json
from collections.abc import Mapping

from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError
from kf_calib.sources.live.feed import nothing
from kf_calib.sources.live.frames import FrameReader
from kf_calib.sources.text.csv_lines import CsvLines
from kf_calib.sources.text.encoding import Cutter
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.json_lines import JsonLines
from kf_calib.sources.text.lines import reader_for
from kf_calib.sources.text.reader import LineCounts, LineReader
from kf_calib.sources.text.units import Units

_FEWEST_CELLS = 5  # time, readings and an angle
_MOST_LINES = 2000  # without a beginning among them
_MOST_BYTES = 1 << 23
_HELD_BYTES = 1 << 16


class LineProtocol:
    """JSON or CSV lines as bytes come, from wherever in a line they begin.

    header: of CSV rows that come without one. angles: whether poses must come. A header that does not say what is
    needed waits for the next line, which may be a row of units; InputError is raised where that does not say it either.
    lost: readings are not numbered.
    """

    lost = None

    def __init__(
        self, name: str, columns: Mapping[str, str], header: str, counts: LineCounts, angles: bool, units: Units
    ) -> None:  # fmt: skip
        self._name, self._columns, self._counts, self._angles = name, columns, counts, angles
        self._units = units
        self._cutter = Cutter(counts.refuse)
        self._heading = [header.strip()] if header.strip() else []
        self._waiting = list[str]()
        self.reader: LineReader | None = None
        if self._heading:
            self.reader = self._reader(self._heading, counts, angles)
        self._is_first = False

    def push(self, block: bytes) -> Batch:
        """The samples on the lines that end in ``block``."""
        lines = self._cutter.push(block)
        if self.reader is None:
            lines = self._begin(lines)
        if self.reader is None:
            return nothing(0)
        if self._is_first and lines:
            self._is_first = False
            lines = self._without_half_a_row(lines)
        if any(line in lines for line in self._heading):  # a logger that begins again sends its header again
            lines = ["" if line in self._heading else line for line in lines]
        elif isinstance(self.reader, JsonLines):
            is_known = bool(self.reader.pose_width or self.reader.metadata)
            lines = ["" if line.startswith('{"bench"') and is_known else line for line in lines]
        batch = self.reader.read(lines, self._counts.lines + 1)
        self._counts.lines += len(lines)
        return batch

    def joined_amid(self) -> None:
        """What comes next may begin within a line: half a row of CSV could pass for a whole one."""
        self._is_first = True

    def cut_off(self) -> None:
        """The link broke: a line that has begun will not end."""
        if self._cutter.is_amid:
            self._counts.lines += len(self._cutter.rest())
            self._counts.refuse(self._counts.lines, "the link broke in it")

    def rest(self) -> Batch:
        """The sample on a last line without an end."""
        if self._cutter.is_amid or self._waiting:
            return self.push(b"\n")
        return nothing(self.reader.pose_width if self.reader else 0)

    def _without_half_a_row(self, lines: list[str]) -> list[str]:
        if isinstance(self.reader, CsvLines) and lines[0] and lines[0] not in self._heading:
            self._counts.refuse(self._counts.lines + 1, "it may not be whole: the link was joined in it")
            return ["", *lines[1:]]
        return lines

    def _begin(self, lines: list[str]) -> list[str]:
        """The lines from the first on that says what they are; those before it are refused."""
        lines, self._waiting = [*self._waiting, *lines], []
        for i, line in enumerate(lines):
            text = line.lstrip("\ufeff").strip()
            if text and self._begins(text, lines[i + 1] if i + 1 < len(lines) else None):
                return lines[i + len(self._heading) :]
            if self._waiting:
                break
            self._counts.lines += 1
            if text:
                self._counts.refuse(self._counts.lines, "it is neither a JSON object nor a header of CSV")
        return []

    def _reader(self, first: list[str], counts: LineCounts, angles: bool) -> LineReader:
        return reader_for(first, self._columns, counts, angles=angles, units=self._units)[0]

    def _has_readings(self, heading: list[str]) -> bool:
        """Whether a header lacks nothing but angles."""
        try:
            self._reader(heading, LineCounts(), angles=False)
        except InputError:
            return False
        return True

    def _begins(self, text: str, following: str | None) -> bool:
        """Whether what is to be read begins with this line; the one that follows it is None where it has not come."""
        if text[0] == "{":
            try:
                json.loads(text)
            except (ValueError, RecursionError):
                return False
            self.reader = self._reader([text], self._counts, self._angles)
            return True
        cells = text.split(max(",;\t", key=text.count))
        if (
            len(cells) < _FEWEST_CELLS - 1
            or not text.isprintable()
            or not all(cell.strip(' "')[:1].isalpha() for cell in cells)
        ):
            return False
        both, lacks = [text, following or ""], None
        for heading in ([text], both[: TextHeading.of(both).lines]):  # what says all by itself is not asked for more
            if self._angles and len(cells) < _FEWEST_CELLS and not self._has_readings(heading):
                continue
            try:
                self.reader, self._heading = self._reader(heading, self._counts, self._angles), heading
            except InputError as error:
                lacks = error
                continue
            self._counts.lines += len(heading)
            self._is_first = False
            return True
        if following is None:
            self._waiting = [text]
        elif lacks is not None:
            raise InputError(f"{self._name}: {lacks}")
        return False


class Protocol:
    """Finds out what the bytes are, then has them read: by ``form``, which is for lines until frames are found."""

    def __init__(
        self, name: str, columns: Mapping[str, str], header: str, angles: bool = True, units: Units | None = None
    ) -> None:
        self.counts = LineCounts()
        self._name = name
        self.form: LineProtocol | FrameReader = LineProtocol(
            name, columns, header, self.counts, angles, units or Units()
        )
        self._held, self._seen = b"", 0

    @property
    def reader(self) -> LineReader | FrameReader | None:
        """What has been learnt of the bench; None while it is not known what it speaks."""
        return self.form if isinstance(self.form, FrameReader) else self.form.reader

    def push(self, block: bytes) -> Batch:
        """The samples that are whole with this block. Raises InputError where it makes no sense at all."""
        if self.reader is None:
            self._held, self._seen = (self._held + block)[-_HELD_BYTES - len(block) :], self._seen + len(block)
            if b"\0" in self._held and (batch := self._frames_in(self._held)) is not None:
                return batch
        batch = self.form.push(block)
        if self.reader is None and (self.counts.lines > _MOST_LINES or self._seen > _MOST_BYTES):
            raise self.unusable("no header of CSV, no JSON object and no binary frame")
        return batch

    def _frames_in(self, held: bytes) -> Batch | None:
        counts = LineCounts()
        frames = FrameReader(counts)
        batch = frames.push(held)
        if counts.malformed == counts.lines:
            return None
        self.counts, self.form = counts, frames
        return batch

    def unusable(self, what: str) -> InputError:
        """That the bytes cannot be used, with what was seen of them."""
        advice = self.reader.advice if self.reader else "have it send its header again, or state it (--header)"
        return self.counts.refusal(f"{self._name}: {what}", advice)
