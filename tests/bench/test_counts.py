"""Numbers of converters without a sign, or about another code than 0: told by the data, and read with one option."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kf_calib.bench.counts import counts_in, parse_counts, refuse_unread
from kf_calib.bench.raw_input import RawInput
from kf_calib.errors import BenchError, CountsError

FACES = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
NAMES = ("+z", "-z", "+x", "-x", "+y", "-y")
EDGES = np.array([(a, b, 0) for a in (0.6, -0.6) for b in (0.8, -0.8)] + [(0, a, b) for a in (0.6, -0.6) for b in
                 (0.8, -0.8)] + [(a, 0, b) for a in (0.6, -0.6) for b in (0.8, -0.8)])  # fmt: skip
G = 9.80665
K, BIAS = np.array([1.01, 1.02, 0.99]), np.array([0.05, -0.02, 0.03])


def in_g(directions: np.ndarray) -> np.ndarray:
    return directions * K + BIAS


@pytest.mark.parametrize(("text", "numbers", "signed"), [
    ("signed", [1, -2, 3], [1, -2, 3]), ("unsigned16", [1, 65529, 32768], [1, -7, -32768]),
    ("unsigned20", [524287, 524288, 0], [524287, -524288, 0]), ("wrap=4.096", [0.5, 3.596, 2.0], [0.5, -0.5, 2.0]),
    ("offset=512", [512, 600, 400], [0, 88, -112]), ("offset=1,2,3", [1, 2, 4], [0, 0, 1]),
])  # fmt: skip
def test_numbers_are_read_and_written_back(text: str, numbers: list[float], signed: list[float]) -> None:
    device = RawInput(sizes=(0.5, 0.5, 0.5), unit="g", counts=text)
    readings = device.readings(np.array([numbers], float))
    np.testing.assert_allclose(readings, 0.5 * G * np.array([signed]), atol=1e-9)
    np.testing.assert_allclose(device.raw(readings), [numbers], atol=1e-9)
    assert RawInput.from_metadata(device.to_metadata()) == device


@pytest.mark.parametrize("text", ["unsigned", "unsigned0x", "wrap=-1", "wrap=inf", "offset=a", "offset=1,2", "", "two"])
def test_what_is_not_known_is_one_sentence(text: str) -> None:
    with pytest.raises(BenchError, match=r"^counts are .*: give signed, unsigned16 "):
        parse_counts(text)


@pytest.mark.parametrize("bits", [10, 12, 16, 20, 24])
def test_a_missing_sign_is_told(bits: int) -> None:
    counts = np.rint(in_g(FACES) * 2.0 ** (bits - 3))
    assert counts_in(np.mod(counts, 2.0**bits)) == f"unsigned{bits}"
    assert counts_in(counts) == ""


def test_a_missing_sign_is_told_of_readings_in_a_unit() -> None:
    told = counts_in(np.mod(in_g(FACES), 4.0894))
    assert parse_counts(told).period == pytest.approx(4.0894, rel=0.02)


def test_another_code_than_zero_is_told() -> None:
    told = counts_in(np.rint(67.0 * in_g(np.concatenate([FACES, EDGES])) + [338, 334, 341]))
    assert parse_counts(told).offset == pytest.approx((338 + 67 * 0.05, 334 - 67 * 0.02, 341 + 67 * 0.03), abs=3)


@pytest.mark.parametrize("directions", [EDGES, FACES[::2], np.tile(FACES[0], (50, 1)), 0.6 + 0.2 * np.abs(EDGES)])
def test_good_readings_are_left_alone(directions: np.ndarray) -> None:
    noise = np.random.default_rng(3).normal(0.0, 1e-3, directions.shape)
    for size in (1.0, G, 256.0, 16384.0):
        assert counts_in(size * (directions * K + 0.002 + noise)) == ""


def log(path: Path, counts: np.ndarray) -> None:
    """Three seconds in each of some poses at 50 Hz, in numbers of 1/256 g."""
    noise = np.random.default_rng(5).normal(0.0, 1.0, (len(counts), 150, 3))
    numbers = np.rint(np.repeat(counts[:, None], 150, axis=1) + noise).reshape(-1, 3)
    rows = (f"{0.02 * k:.2f},{x:.0f},{y:.0f},{z:.0f}" for k, (x, y, z) in enumerate(np.mod(numbers, 65536)))
    path.write_text("time_s,x,y,z\n" + "\n".join(rows) + "\n")


def table(path: Path, numbers: np.ndarray, names: str) -> None:
    rows = (",".join([face, *map(repr, own)]) for face, own in zip(NAMES, numbers.tolist(), strict=True))
    path.write_text(f"face,{names}\n" + "\n".join(rows) + "\n")


def test_what_info_proposes_for_a_log_without_a_sign_works(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    directions = np.concatenate([FACES, EDGES])
    log(path, 256.0 * in_g(directions))
    _, command = run.proposed(path, "--gravity", G)
    assert "unsigned16" in command and "0.00390625" in command
    found = run.parameters(*command)
    assert [found[f"K{k}"]["value"] for k in (1, 2, 3)] == pytest.approx(K.tolist(), abs=3e-3)
    err = run.refused("replay", path, "--gravity", G, "--no-angles", "--accel-unit", "g", "--accel-scale", 1 / 256)
    assert "add --counts unsigned16" in err


def test_a_recording_without_a_sign_is_told_by_its_dwells() -> None:
    counts = np.mod(np.rint(256.0 * in_g(FACES)), 65536.0)
    with pytest.raises(CountsError, match=r"^the run: .* add --counts unsigned16\.$") as caught:
        refuse_unread(counts, "signed")
    assert caught.value.keys == {"counts": "unsigned16"}
    refuse_unread(counts, "unsigned16")


@pytest.mark.parametrize(("names", "numbers", "option"), [
    ("x,y,z", np.mod(np.rint(256.0 * in_g(FACES)), 65536.0), "unsigned16"),
    ("ax [g],ay [g],az [g]", np.mod(in_g(FACES), 4.0894), "wrap="),
])  # fmt: skip
def test_what_info_proposes_for_a_table_without_a_sign_works(
    names: str, numbers: np.ndarray, option: str, run: Any, tmp_path: Path
) -> None:
    path = tmp_path / "table.csv"
    table(path, numbers, names)
    _, command = run.proposed(path, "--gravity", G)
    assert option in " ".join(command)
    found = run.parameters(*command)
    assert [found[f"K{k}"]["value"] for k in (1, 2, 3)] == pytest.approx(K.tolist(), abs=0.03)
    assert f"add --counts {option}" in run.refused("replay", path, "--gravity", G, "--accel-unit", "g")
