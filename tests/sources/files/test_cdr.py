"""CDR layouts against the official encoder, and what a decoder refuses."""

import struct
from types import SimpleNamespace as Message

import numpy as np
import pytest
from mcap_ros2._dynamic import serialize_dynamic

from kf_calib.bench.streams import Stream
from kf_calib.sources.files import cdr

FRAMES = ["", "a", "ab", "accelerometer", "platform", "some/long_frame-é"]
NAMES = [[], ["q"], ["outer", "inner"], ["outer", "middle", "inner"], ["a", "bb", "ccc", "dddd", "eeeee"]]


def stream(width: int, count: int = 50, seed: int = 1) -> Stream:
    rng = np.random.default_rng(seed)
    time_ns = np.sort(rng.integers(0, 2**31 * 10**9, count))
    values = rng.normal(size=(count, width)) * 10.0 ** rng.integers(-300, 300, (count, width))
    if values.size:
        values.flat[:: max(values.size // 3, 1)] = np.inf
    return Stream(time_ns, values)


def official(kind: cdr.MessageType, message: Message) -> bytes:
    return serialize_dynamic(kind.name, kind.schema)[kind.name](message)


def header(time_ns: int, frame: str) -> Message:
    sec, nanosec = divmod(int(time_ns), 10**9)
    return Message(stamp=Message(sec=sec, nanosec=nanosec), frame_id=frame)


def xyz(values, **more: float) -> Message:
    return Message(**dict(zip("xyz", values, strict=True)), **more)


def encode_officially(kind: cdr.MessageType, frame: str, names: list[str], time_ns: int, values: list[float]) -> bytes:
    head = header(time_ns, frame)
    unmeasured = [-1.0] + [0.0] * 8
    match kind:
        case cdr.IMU:
            fields = {
                "orientation": xyz([0.0] * 3, w=1.0),
                "orientation_covariance": unmeasured,
                "angular_velocity": xyz([0.0] * 3),
                "angular_velocity_covariance": unmeasured,
                "linear_acceleration": xyz(values),
                "linear_acceleration_covariance": [0.0] * 9,
            }
        case cdr.JOINT_STATE:
            fields = {"name": names, "position": values, "velocity": [], "effort": []}
        case cdr.QUATERNION:
            fields = {"quaternion": xyz(values[:3], w=values[3])}
        case _:
            fields = {"temperature": values[0], "variance": 0.0}
    return official(kind, Message(header=head, **fields))


CASES = [
    *((cdr.IMU, cdr.imu_message(frame), frame, [], 3) for frame in FRAMES),
    *((cdr.QUATERNION, cdr.quaternion_message(frame), frame, [], 4) for frame in FRAMES),
    *((cdr.TEMPERATURE, cdr.temperature_message(frame), frame, [], 1) for frame in FRAMES),
    *(
        (cdr.JOINT_STATE, cdr.joint_state_message(frame, names), frame, names, len(names))
        for frame in FRAMES
        for names in NAMES
    ),
]


@pytest.mark.parametrize(("kind", "template", "frame", "names", "width"), CASES)
def test_packs_as_the_official_encoder_does_and_unpacks_it_bit_for_bit(kind, template, frame, names, width) -> None:
    samples = stream(width)
    packed = cdr.pack(kind, template, samples)
    for message, time_ns, values in zip(packed[:3], samples.time_ns, samples.values.tolist(), strict=False):
        assert message == encode_officially(kind, frame, names, time_ns, values)
    found = decode(cdr.Decoder(kind, width), packed)
    assert np.array_equal(found.time_ns, samples.time_ns)
    assert found.values.tobytes() == samples.values.tobytes()


def decode(decoder: cdr.Decoder, messages: list[bytes], gap: bytes = b"#" * 5) -> Stream:
    """The messages, all of one length, at odd offsets in a buffer."""
    size = len(messages[0])
    at = len(gap) + (size + len(gap)) * np.arange(len(messages))
    return decoder(gap + b"".join(message + gap for message in messages), at, size)


def joint_states(samples: Stream, strings: list[tuple[str, list[str]]]) -> list[bytes]:
    return [
        cdr.pack(cdr.JOINT_STATE, cdr.joint_state_message(*strings[i]), samples[i : i + 1])[0]
        for i in range(len(samples))
    ]


def test_refuses_joints_that_become_others() -> None:
    messages = joint_states(stream(2, count=2), [("f", ["x", "yy"]), ("f", ["x", "zz"])])
    with pytest.raises(cdr.MessageError, match="joint names change from x yy to x zz"):
        decode(cdr.Decoder(cdr.JOINT_STATE, 2), messages)


def test_frames_of_changing_length_in_messages_of_one_length() -> None:
    samples = stream(3, count=6)
    templates = [cdr.imu_message("abcd"), cdr.imu_message("abcdefg")]  # both padded to the same length
    assert len(templates[0]) == len(templates[1])
    messages = [cdr.pack(cdr.IMU, templates[i % 2], samples[i : i + 1])[0] for i in range(6)]
    found = decode(cdr.Decoder(cdr.IMU, 3), messages)
    assert found.values.tobytes() == samples.values.tobytes()


def test_joints_in_another_order_keep_their_columns() -> None:
    samples = stream(3, count=2)
    as_sent = Stream(samples.time_ns, np.stack([samples.values[0], samples.values[1, [2, 0, 1]]]))
    messages = joint_states(as_sent, [("f", ["a", "b", "c"]), ("f", ["c", "a", "b"])])
    found = decode(cdr.Decoder(cdr.JOINT_STATE, 3), messages)
    assert found.values.tobytes() == samples.values.tobytes()


IMU = cdr.imu_message("accelerometer")
JOINTS = cdr.joint_state_message("platform", ["outer", "inner"])


@pytest.mark.parametrize(
    ("kind", "width", "message", "says"),
    [
        (cdr.IMU, 3, b"\x00\x00" + IMU[2:], "encapsulation is 00 00"),
        (cdr.IMU, 3, b"\x00\x03" + IMU[2:], "encapsulation is 00 03"),
        (cdr.IMU, 3, IMU[:-8], "takes 332 bytes, the message has 324"),
        (cdr.IMU, 3, IMU + bytes(8), "takes 332 bytes, the message has 340"),
        (cdr.IMU, 3, IMU[:10], "does not fit in its 10 bytes"),
        (cdr.IMU, 3, IMU[:12] + b"\xff\xff\xff\xff" + IMU[16:], "ends at byte 4294967311 of 332"),
        (cdr.IMU, 3, IMU[:-72] + struct.pack("<d", -1.0) + IMU[-64:], "not measured"),
        (cdr.JOINT_STATE, 3, JOINTS, "gives 2 positions for 3 gimbal axes"),
        (cdr.JOINT_STATE, 1, JOINTS, "gives 2 joints .outer, inner. where 1 gimbal axes are stated"),
        (cdr.TEMPERATURE, 1, IMU, "the message has 332"),
    ],
)
def test_refuses_what_it_cannot_read(kind, width, message, says) -> None:
    with pytest.raises(cdr.MessageError, match=says):
        decode(cdr.Decoder(kind, width), [message])


def joint_state(names: list[str], position: list[float], velocity: list[float], effort: list[float]) -> bytes:
    fields = Message(header=header(5, "f"), name=names, position=position, velocity=velocity, effort=effort)
    return official(cdr.JOINT_STATE, fields)


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        ([joint_state(["a", "b"], [], [], [])], "names 2 joints but gives 0 positions"),
        ([joint_state(["a", "b"], [1.0] * 3, [], [])], "names 2 joints but gives 3 positions"),
        ([joint_state([], [1.0, 2.0], [3.0], []), joint_state([], [1.0], [2.0, 3.0], [])], "gives 1 positions for 2 g"),
    ],
)
def test_refuses_joints_with_another_number_of_positions(messages: list[bytes], says: str) -> None:
    """The last two are of one length."""
    with pytest.raises(cdr.MessageError, match=says):
        decode(cdr.Decoder(cdr.JOINT_STATE, 2), messages)


def test_reads_past_velocities_and_efforts() -> None:
    found = decode(cdr.Decoder(cdr.JOINT_STATE, 1), [joint_state(["a"], [1.5], [2.0], [3.0, 4.0])])
    assert (found.time_ns.tolist(), found.values.tolist()) == ([5], [[1.5]])


@pytest.mark.parametrize("time_ns", [-1, 2**31 * 10**9])
def test_refuses_stamps_that_do_not_fit(time_ns: int) -> None:
    with pytest.raises(cdr.MessageError, match="between the years 1970 and 2038"):
        cdr.pack(cdr.IMU, IMU, Stream(np.array([time_ns]), np.zeros((1, 3))))


def test_refuses_values_of_another_width() -> None:
    with pytest.raises(cdr.MessageError, match="holds 3 values"):
        cdr.pack(cdr.IMU, IMU, stream(2))
