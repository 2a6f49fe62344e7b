"""Gimbals are found by the names of a joint state, whatever the order and whatever else is in it."""

from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import ACCEL, BATCH, BENCH, made_batch, read, record, write_officially

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Stream
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files import cdr
from kf_calib.sources.files.fields import Joints, MessageError
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.text.lines import Lines

POSE = BATCH.pose
USUAL = ["outer", "middle", "inner"]


def given(names: list[str], start: int = 0, stop: int | None = None) -> tuple[str, cdr.MessageType, bytes, Stream]:
    """A topic of joints with these names: those that have a word of ``USUAL`` at our angles, others at 77 rad."""
    part = POSE[start:stop]
    columns = [next((k for k, word in enumerate(USUAL) if word in name.lower()), None) for name in names]
    values = [np.full(len(part), 77.0) if k is None else part.values[:, k] for k in columns]
    message = cdr.joint_state_message("", names)
    return "/joint_states", cdr.JOINT_STATE, message, Stream(part.time_ns, np.stack(values, axis=1))


def bag(tmp_path: Path, *topics: tuple[str, cdr.MessageType, bytes, Stream]) -> Path:
    return write_officially(tmp_path / "bag.mcap", (ACCEL, *topics), metadata={})


def recording(path: Path, **keys: str) -> Recording:
    return Recording(path, {"axes": "y z x", "gravity_mps2": "9.81", **keys})


@pytest.mark.parametrize(
    "names",
    [
        ["inner", "middle", "outer"],
        ["Middle", "OUTER", "Inner"],
        ["gimbal_inner_joint", "gimbal_outer_joint", "gimbal_middle_joint"],
        ["innerAxis", "outerAxis", "middleAxis"],
        ["shoulder", "inner", "wheel_left", "outer", "elbow", "middle"],
    ],
)
def test_gimbals_are_put_right_by_name_and_it_is_said(tmp_path: Path, names: list[str]) -> None:
    found = recording(bag(tmp_path, given(names)))
    assert read(found).pose.values.tobytes() == POSE.values.tobytes()
    (said,) = found.warnings
    in_order = sorted((name for name in names if any(w in name.lower() for w in USUAL)), key=lambda n: "omi".index(
        next(w for w in USUAL if w in n.lower())[0]))  # fmt: skip
    assert f"of the joints {', '.join(names)} the gimbals are" in said and ", ".join(in_order) in said


def test_the_usual_order_is_not_worth_a_word(tmp_path: Path) -> None:
    found = recording(bag(tmp_path, given(["gimbal_outer", "gimbal_middle", "gimbal_inner"])))
    assert read(found).pose.values.tobytes() == POSE.values.tobytes() and not found.warnings


def test_letters_of_the_axes_are_names_too() -> None:
    told = list[str]()
    joints = Joints(3, letters=("y", "z", "x"), warn=told.append)
    assert joints(("axis_x", "axis_y", "axis_z"), 3) == (1, 2, 0) and len(told) == 1
    assert BENCH.axis_letters == ("y", "z", "x")
    assert Bench(axes_of("zxz"), 9.81).axis_letters == ()
    with pytest.raises(MessageError, match="do not tell"):  # of an arm, perhaps: among others letters say too little
        Joints(3, letters=("y", "z", "x"))(("arm_x", "arm_y", "arm_z", "wheel"), 4)


def test_joints_of_unknown_names_are_taken_as_they_come(tmp_path: Path) -> None:
    topic = ("/joint_states", cdr.JOINT_STATE, cdr.joint_state_message("", ["j3", "j1", "j2"]), POSE)
    found = recording(bag(tmp_path, topic))
    assert read(found).pose.values.tobytes() == POSE.values.tobytes() and not found.warnings


def test_more_joints_whose_names_do_not_tell_are_refused_with_what_to_do(tmp_path: Path) -> None:
    path = bag(tmp_path, given(["j1", "j2", "j3", "j4"]))
    with pytest.raises(InputError, match=r"4 joints \(j1, j2, j3, j4\) where 3 gimbal axes.*--joints \"j1 j2 j3\""):
        read(recording(path))


@pytest.mark.parametrize("axes", ["y z", "y"])
def test_fewer_axes_than_named_gimbals_are_refused(tmp_path: Path, axes: str) -> None:
    with pytest.raises(InputError, match="or state all axes"):
        read(recording(bag(tmp_path, given(USUAL)), axes=axes))


def test_stated_joints_win_and_messages_of_others_are_passed_over(tmp_path: Path) -> None:
    arm = ["inner_wheel", "a_middle", "b_inner", "c_outer"]
    wheels = given(["wheel_left", "wheel_right", "wheel_back"])
    shifted = (*wheels[:3], Stream(wheels[3].time_ns + 1_000, wheels[3].values))
    path = bag(tmp_path, shifted, given(arm))
    found = recording(path, joints="c_outer a_middle, b_inner")
    assert read(found).pose.values.tobytes() == POSE.values.tobytes() and not found.warnings
    with pytest.raises(InputError, match=r"joint names change|names do not tell"):
        read(recording(path))
    with pytest.raises(InputError, match=r"no message .* names the joints p q r, it names wheel_left"):
        read(recording(path, joints="p q r"))
    with pytest.raises(InputError, match="so that p of the stated joints cannot be found in it"):
        read(recording(path, joints="c_outer a_middle p"))
    with pytest.raises(BenchError, match=r"joints names 2 gimbals .c_outer a_middle. where there are 3 axes"):
        recording(path, joints="c_outer a_middle")


def test_names_are_followed_from_message_to_message(tmp_path: Path) -> None:
    path = bag(tmp_path, given(USUAL, 0, 15), given(USUAL[::-1], 15, 25), given(["w", *USUAL], 25))
    found = recording(path)
    assert read(found).pose.values.tobytes() == POSE.values.tobytes() and len(found.warnings) == 1


def test_stated_joints_are_what_a_recording_calls_them(tmp_path: Path) -> None:
    bench = Bench(BENCH.axes, 9.81, joints=("inner", "b", "outer"))
    assert Bench.from_metadata(bench.to_metadata()) == bench
    batch = made_batch(100)
    path = record(tmp_path / "own.mcap", batch, bench)
    found = Recording(path)
    assert found.bench == bench and read(found).pose.values.tobytes() == batch.pose.values.tobytes()
    with Recorder(tmp_path / "back.mcap", bench) as recorder:
        start = recorder.flush()
        recorder.write(batch)
        (back,) = recorder.read_back(start, recorder.flush())
    assert back.pose.values.tobytes() == batch.pose.values.tobytes()


def test_stated_joints_name_the_columns_of_a_table(tmp_path: Path) -> None:
    table = tmp_path / "bench.csv"
    table.write_text("time_s,ax_g,ay_g,az_g,wheel_deg,C_deg,A_deg,b_rad\n1,0,1,0,77,3,1,2\n2,0,1,0,77,3,1,2\n")
    found = read(Lines(table, {"axes": "y z x", "gravity_mps2": "9.81", "joints": "A b C"}))
    np.testing.assert_allclose(found.pose.values[0], [np.radians(1), 2.0, np.radians(3)])
