"""Whatever lines and frames hold, they are refused and counted, and the run goes on: inputs close to sound ones."""

import json
import struct
from collections import Counter
from collections.abc import Callable

import pytest
from helpers import sent_frames
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from kf_calib.bench.streams import Batch
from kf_calib.sources.live import frames
from kf_calib.sources.live.clock import Clock, Continuity
from kf_calib.sources.live.protocols import Protocol

START_NS = 1_750_000_000_000_000_000
CELLS = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"

SIZES = st.sampled_from([
    "0", "-0", "1", "9.8", "-1e-9", "1e999", "-1e999", "1e-999", "NaN", "Infinity", "-Infinity", "sNaN", "nan123",
    "1.234e-01700001234567", "1e-1999999999999999998", "1e1999999999999999998", "9.9e-9999999999999999999999",
    "1" * 19, "9" * 30, "9" * 400, "9" * 5000, "0." + "1" * 3000, "1e20", "1e21", "9223372036854775807", "2147483648.5",
    "-9223372036854775809", "0x10", "1_0", "٣", "1.2.3", "1e", "--1", "+1", "", " ", "null", "true", '"1"', "[1]", "{}",
])  # fmt: skip
NUMBERS = st.one_of(
    st.sampled_from(["0.1", "9.8", "-0.25"]), SIZES, st.floats().map(repr), st.integers(-(10**20), 10**20).map(str)
)
STAMPS = st.one_of(st.integers(-(2**66), 2**66).map(str), st.integers(START_NS, START_NS + 10**15).map(str), SIZES)
LISTS = st.one_of(st.lists(NUMBERS, max_size=5).map(lambda texts: f"[{', '.join(texts)}]"), SIZES)
KEYS = st.sampled_from([
    "time_ns", "time_us", "time_ms", "time_s", "accel_mps2", "accel_g", "accel_mg", "angles_rad", "angles_deg",
    "attitude_xyzw", "temperature_c", "bench", "", "\\ud800", "note",
])  # fmt: skip


def _object(stamp: str, pairs: list[tuple[str, str]]) -> str:
    inside = [f'"time_ns": {stamp}', *(f'"{key}": {value}' for key, value in pairs)]
    return "{" + ", ".join(inside) + "}"


JSON_LINES = st.builds(_object, STAMPS, st.lists(st.tuples(KEYS, st.one_of(LISTS, NUMBERS, STAMPS)), max_size=4))
CSV_LINES = st.lists(st.one_of(NUMBERS, STAMPS), min_size=7, max_size=9).map(",".join)
KINDS = st.sampled_from([*b"BAGQT", 0, 255])
CONTENTS = st.one_of(
    st.lists(st.floats(), max_size=9).map(lambda values: struct.pack(f"<{len(values)}d", *values)),
    st.binary(max_size=70),
    JSON_LINES.map(str.encode),
    st.integers(200, 400).map(bytes),
)


@st.composite
def bent(draw: Callable, whole: st.SearchStrategy[bytes]) -> bytes:
    """Sound in its structure, or with a piece cut out, doubled or changed."""
    data = draw(whole)
    fault = draw(st.integers(0, 5))
    if fault < 3 or len(data) < 2:
        return data
    start, end = sorted(draw(st.tuples(*[st.integers(0, len(data))] * 2)))
    put = {3: b"", 4: data[start:end] * 2, 5: draw(st.binary(max_size=6))}[fault]
    return data[:start] + put + data[end:]


def _frame(kind: int, number: int, time_ns: int, content: bytes) -> bytes:
    return sent_frames.encode(kind, number, time_ns, content).removesuffix(b"\0")


FRAMES = st.builds(_frame, KINDS, st.integers(0, 2**32 - 1), st.integers(-(2**63), 2**63 - 1), CONTENTS)
INPUTS = {
    "json": bent(JSON_LINES.map(lambda line: line.encode(errors="replace"))),
    "csv": bent(CSV_LINES.map(lambda line: line.encode(errors="replace"))),
    "frames": st.one_of(bent(FRAMES), bent(FRAMES), st.binary(max_size=3)),
}


def _sound(form: str, i: int) -> bytes:
    """A reading with its pose."""
    if form == "frames":
        stamp = START_NS + i * 10**6
        return sent_frames.sample(frames.ACCEL, i, stamp, (1.0, 9.8, 0.0)) + sent_frames.sample(
            frames.ANGLES, i, stamp, (0.1, 0.2, 0.3)
        )
    if form == "csv":
        return f"1750000000.{i:09d},1,9.8,0,10,20,30,21.5\n".encode()
    entry = {"time_ns": START_NS + i, "accel_mps2": [1, 9.8, 0], "angles_rad": [0.1, 0.2, 0.3]}
    return (json.dumps(entry) + "\n").encode()


class _Chain:
    """What bytes go through in a live run up to its recording."""

    def __init__(self, form: str, *, is_begun: bool) -> None:
        self.protocol, self.form = Protocol("fuzz", {}, CELLS if form == "csv" else ""), form
        self._clock, self._continuity = Clock(), Continuity()
        opening = {"json": b'{"bench": {}}\n', "csv": b"", "frames": b"\0" + sent_frames.bench({})}[form]
        self.push(opening + (_sound(form, 0) if is_begun else b""))
        assert self.protocol.reader is not None

    def push(self, data: bytes) -> int:
        """How many readings came of it."""
        batch = self.protocol.push(data)
        fits = (batch.accel.time_ns >= 0) & (batch.accel.time_ns < 1 << 61)
        timed = self._clock.push(Batch(batch.accel[fits], batch.pose[:0], batch.temperature[:0]), 0.0)
        self._continuity.add(timed.accel.time_ns)
        return len(batch.accel)


TRIED = Counter[str]()


def try_all(form: str, inputs: list[bytes], *, is_begun: bool) -> None:
    """The inputs one by one, then a sound one, of which all must come; and all at once, of which the same must come."""
    chain, end = _Chain(form, is_begun=is_begun), b"\0" if form == "frames" else b"\n"
    counts = chain.protocol.counts
    came = sum([chain.push(data + end) for data in [*inputs, b""]])
    before = counts.malformed
    got, refused = chain.push(_sound(form, 1)), counts.malformed - before
    assert (got, refused) == (1, 0) or (not is_begun and refused == 1)  # poses may have been settled otherwise
    at_once = _Chain(form, is_begun=is_begun)
    assert at_once.push(b"".join(data + end for data in [*inputs, b""]) + _sound(form, 1)) == came + got
    assert at_once.protocol.counts.malformed == counts.malformed
    assert counts.malformed <= counts.lines and all(map(str.isprintable, counts.sentences()))
    TRIED[form] += len(inputs)


def _fuzzed(form: str, examples: int, size: int, round_number: int = 0) -> None:
    @seed(round_number)
    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(inputs=st.lists(INPUTS[form], min_size=1, max_size=size), is_begun=st.booleans())
    def run(inputs: list[bytes], is_begun: bool) -> None:
        try_all(form, inputs, is_begun=is_begun)

    run()


@pytest.mark.parametrize("form", INPUTS)
def test_no_line_and_no_frame_ends_a_run(form: str) -> None:
    _fuzzed(form, 50, 4)


@pytest.mark.slow
@pytest.mark.parametrize("form", INPUTS)
def test_none_of_a_hundred_thousand_inputs_ends_a_run(form: str) -> None:
    before, round_number = TRIED[form], 0
    while TRIED[form] - before < 35_000:
        _fuzzed(form, 4000, 8, round_number := round_number + 1)
    print(f"{form}: {TRIED[form] - before} inputs, 0 exceptions")


@pytest.mark.parametrize("is_begun", [True, False])
@pytest.mark.parametrize(
    ("form", "data"),
    [
        ("json", b'{"time_s": 1.234e-01700001234567, "accel_mps2": [1, 2, 3]}'),
        ("json", b'{"time_s": 1.5, "accel_mps2": [1, 2, 1.234e-011700001234567890123]}'),
        ("json", b'{"time_ns": 1, "accel_mps2": [1, 2, 1.234e-01700001234567]}'),
        ("json", b'{"time_ns": 1e99999999999999999999, "accel_mps2": [1, 2, 3]}'),
        ("csv", b"1.234e-01700001234567,1,2,3,4,5,6,7"),
        ("csv", b"1.5,1,2,1.234e-01700001234567,4,5,6,7"),
        ("frames", _frame(frames.ANGLES, 0, START_NS, b"")),
        ("frames", _frame(frames.ATTITUDE, 0, START_NS, b"")),
        ("frames", _frame(frames.ACCEL, 0, START_NS, b"")),
    ],
)
def test_inputs_that_ended_runs(form: str, data: bytes, is_begun: bool) -> None:
    try_all(form, [data], is_begun=is_begun)
    chain = _Chain(form, is_begun=is_begun)
    assert chain.push(data + (b"\0" if form == "frames" else b"\n")) == 0
    assert chain.protocol.counts.malformed == 1


def test_numbers_that_are_finite_one_by_one_need_no_finite_sum() -> None:
    chain = _Chain("csv", is_begun=False)
    assert chain.push(b"1.5,9e307,9e307,9e307,8.988465674311579e+307,8.98846567431158e+307,7,20\n") == 1
    assert chain.protocol.counts.malformed == 0
