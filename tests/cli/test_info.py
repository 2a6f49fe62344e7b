"""``info`` says what is in a file, what it lacks, and a command that then works."""

import shlex
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.recordings import ACCEL, ANGLES, BATCH, START_NS, read, record, write_db3, write_messages, write_officially

from kf_calib.bench.bench import Bench
from kf_calib.sources.files.inventory import Topic
from kf_calib.sources.files.recording import Recording

FACES = ROOT / "recordings" / "mems_faces.mcap"
REAL = Path("/work/shared/recordings/ferraris_hand.mcap")


@pytest.fixture
def facts(run: Any) -> Any:
    """The object that ``info --json`` prints."""
    return partial(run.json, "info")


def test_a_recording(facts: Any, run: Any) -> None:
    found = facts(FACES)
    counts = {topic["topic"]: topic["messages"] for topic in found["topics"]}
    whole = read(Recording(FACES))
    assert counts == {"/accelerometer": len(whole.accel), "/platform/angles": len(whole.pose),
                      "/temperature": len(whole.temperature)}  # fmt: skip
    first = found["topics"][0]
    assert (first["first_ns"], first["last_ns"]) == (whole.accel.time_ns[0], whole.accel.time_ns[-1])
    assert first["rate_hz"] == pytest.approx(50) and first["gaps"] == 0
    assert len(found["dwells"]) == run.json("replay", FACES)["dwells"] == 6
    assert [round(angle, 3) for angle in found["dwells"][1]["pose"]] == [0.0, -1.571, 0.0]
    assert found["missing"] == [] and found["command"] == f"kf-calib replay {FACES}"
    assert found["bench"]["gravity_mps2"] == "9.81"


def faces_as_db3(path: Path) -> Path:
    whole = read(Recording(FACES))
    return write_db3(path, ((*ACCEL[:3], whole.accel), (*ANGLES[:3], whole.pose)))


def test_the_command_of_a_bag_that_lacks_its_bench_works(facts: Any, run: Any, tmp_path: Path) -> None:
    bag = faces_as_db3(tmp_path / "my bag" / "bag_0.db3").parent
    found = facts(bag, "--angle-sigma", "0.2")
    assert found["format"] == "db3" and found["bench"] == {"angle_sigma_deg": "0.2"} and found["dwells"] is None
    assert [text.partition(":")[0] for text in found["missing"]] == ["the gimbal axes, outer to inner", "local gravity"]
    assert found["command"] == f'kf-calib replay "{bag}" --angle-sigma 0.2 --axes "y z x" --gravity 9.81'
    words = shlex.split(found["command"])[1:]
    again = facts(*words[1:])
    assert again["missing"] == [] and len(again["dwells"]) == run.json(*words)["dwells"] == 6


def test_lines(facts: Any, run: Any, tmp_path: Path) -> None:
    table = tmp_path / "log.csv"
    felt_at = {"0,0,0": "0,1,0", "0,90,0": "1,0,0", "0,180,0": "0,-1,0", "0,270,0": "-1,0,0", "0,0,90": "0,0,-1",
               "0,0,270": "0,0,1"}  # fmt: skip
    dwells = [(felt, angles) for angles, felt in felt_at.items()]
    rows = [f"{k / 20},{','.join(dwells[k // 200])}" for k in range(1200)]
    table.write_text("\n".join(["when_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg", *rows]))
    found = facts(table, "--column", "when_s=time_s")
    assert [(topic["topic"], topic["messages"]) for topic in found["topics"]] == [("readings", 1200),
                                                                                ("platform angles", 1200)]  # fmt: skip
    assert len(found["missing"]) == 2 and "--column when_s=time_s" in found["command"]
    assert [round(dwell["norm_mps2"], 3) for dwell in found["dwells"]] == [9.807] * 6
    assert run.json(*shlex.split(found["command"])[1:])["samples"] > 1000
    assert len(facts(table, "--column", "when_s=time_s", "--axes", "y z x", "--gravity", "9.81")["dwells"]) == 6


STAMPS = [{"header": {"stamp": {"sec": 1, "nanosec": k * 10**7}}} for k in range(20)]


def test_what_messages_in_json_have(facts: Any, tmp_path: Path) -> None:
    messages = [{"t": k / 100, "acc": {"x": 0}, "l": [{"v": 1}]} for k in range(20)]
    path = write_messages(tmp_path / "json.mcap", {"/imu": messages})
    found = facts(path)
    assert found["topics"][0]["fields"] == ["t", "acc.x", "l.v"]
    assert len(found["missing"]) == 3 and "has no accelerometer topic" in found["missing"][0]
    assert (
        "--field" in found["missing"][0]
        and "--field accel=TOPIC:X,Y,Z@TIME --field angles=TOPIC:OUTER,MIDDLE,INNER@TIME" in found["command"]
    )
    assert "TOPIC" not in facts(path, "--field", "accel=/imu:l.v@t", "--field", "attitude=/imu:acc@t")["command"]


@pytest.mark.parametrize(
    ("stamped", "proposed"), [(True, "/tool:pose.orientation"), (False, "/tool:pose.orientation@TIME")]
)
def test_a_quaternion_in_messages_is_proposed_as_attitude(
    facts: Any, tmp_path: Path, stamped: bool, proposed: str
) -> None:
    """As of the pose of a robot's tool; axes of gimbals are not asked for then."""
    turned = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    at = STAMPS if stamped else [{}] * 20
    topics = {"/imu": [own | {"acc": [0, 0, 9.81]} for own in at], "/tool": [own | {"pose": turned} for own in at]}
    path = write_messages(tmp_path / "json.mcap", topics)
    found = facts(path, "--field", "accel=/imu:acc")
    assert found["command"].endswith(f"--field attitude={proposed} --gravity 9.81")
    assert not any("axes" in each for each in found["missing"])


def test_the_orientation_in_an_imu_is_not_proposed(facts: Any, tmp_path: Path) -> None:
    """It is what that sensor makes of the readings that are to be calibrated."""
    fields = {"orientation": {"x": 0, "y": 0, "z": 0, "w": 1}, "linear_acceleration": {"x": 0, "y": 0, "z": 9.81}}
    topics = {"/imu": [own | fields for own in STAMPS]}
    path = write_messages(tmp_path / "json.mcap", topics, schema="sensor_msgs/msg/Imu")
    command = facts(path)["command"]
    assert "--field" not in command and command.endswith("--no-angles")


def test_gaps_and_times_that_go_back() -> None:
    step, topic = 10_000_000, Topic("/a", "", "cdr")
    times = START_NS + step * np.arange(5000)
    times[3000:] += 700 * step
    times[4000:] -= 50 * step
    for part in np.array_split(times, 7):
        topic.add(part)
    topic.settle()
    assert (topic.count, topic.gaps, topic.backward) == (5000, 1, 1)
    assert topic.longest_gap_s == pytest.approx(7.01) and topic.longest_gap_at_s == pytest.approx(29.99)


def test_other_topics_are_counted_too(facts: Any, tmp_path: Path) -> None:
    other = ("/other", *ACCEL[1:])
    for path in (write_db3(tmp_path / "a.db3", (ACCEL, ANGLES, other)),
                 write_officially(tmp_path / "a.mcap", (ACCEL, ANGLES, other))):  # fmt: skip
        counts = [topic["messages"] for topic in facts(path)["topics"]]
        assert counts == [len(BATCH.accel), len(BATCH.pose), len(BATCH.accel)]


def test_damage_is_told_beside_what_is_there(facts: Any, tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", BATCH, Bench.from_metadata({"axes": "y z x", "gravity_mps2": "9.81"}))
    path.write_bytes(path.read_bytes()[:-200])
    found = facts(path)
    assert any("was not finished or has lost its end" in said for said in found["warnings"])
    assert found["topics"][0]["messages"] == len(BATCH.accel)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"\0\1\2" * 100, "is not an MCAP file"),
        (b"SQLite format 3\0" + bytes(500), "cannot be read as a ROS 2 bag"),
        (b"\x28\xb5\x2f\xfd....", "does not decompress"),
        (b"#ROSBAG V2.0\n", "is a bag of ROS 1"),
        (b"a,b\n1,2\n", "has no table of three columns, it begins with 'a,b': write a header and a row for each"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(run: Any, tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "broken"
    path.write_bytes(content)
    assert says in run.refused("info", path)


def test_a_calibration_says_what_it_holds(facts: Any, run: Any, tmp_path: Path) -> None:
    saved = tmp_path / "cal.json"
    run("replay", FACES, "--save", saved)
    _, said, _ = run("info", saved)
    assert "a calibration, of mems_faces.mcap of 2025-06-15, twelve parameters and no effects." in said
    assert "It takes readings in m/s^2" in said and "Model and measurements agree" in said and "1.02273" in said
    told = facts(saved)
    assert told["kind"] == "calibration" and len(told["parameters"]) == 12
    assert "is a calibration, not a recording" in run.refused("replay", saved)


def test_a_file_that_is_not_there(run: Any, tmp_path: Path) -> None:
    assert "does not exist" in run.refused("info", tmp_path / "none.mcap")


@pytest.mark.skipif(not REAL.exists(), reason="the real recordings are not on this machine")
def test_a_real_recording(facts: Any) -> None:
    found = facts(REAL)
    assert len(found["dwells"]) == 6 and found["missing"] == []
