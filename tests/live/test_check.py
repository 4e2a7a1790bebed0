"""The check of an arm: each planted fault is named, sound arms pass, in memory and on a real bus in another process."""

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.errors import BadInput, BadSettings
from skills.formats import bag_writer as say
from skills.formats.topics import BOOL
from skills.kinematics import DEFAULT_INSTRUMENT, INSTRUMENTS
from skills.live.check import check, listen_to
from skills.live.interface import DECODERS, TELEOPERATION, SaidJoints, SaidPose, SaidState, decode, measured
from skills.live.stand_in import NAMES, StandIn
from tests.by_day import some
from tests.formats.others import JAZZY
from tests.live.memory import MemoryBus, heard_of, stepped
from tests.waiting import END_S, until

# What the check says of each fault: the topic, and words.
WORDS = {
    "unhomed": ("operating_state", "ENABLED and not homed"),
    "disabled": ("operating_state", "DISABLED and homed"),
    "faulted": ("operating_state", "FAULT"),
    "no pose in the base": ("local/measured_cp", "nothing came"),
    "no joints": ("measured_js", "nothing came"),
    "no jaw": ("jaw/measured_js", "nothing came"),
    "positions in mm": ("local/measured_cp", "if its unit is m"),
    "joints in degrees": ("measured_js", "which no PSM has"),
    "insertion in mm": ("measured_js", "insertion is 120 m"),
    "half a quaternion": ("measured_cp", "length 0.5"),
    "no frame": ("measured_cp", "names no frame"),
    "a frame that changes": ("measured_cp", "ECM, ECM_view"),
    "20 poses a second": ("local/measured_cp", "messages came per second"),
    "gaps": ("local/measured_cp", "Nothing came for"),
    "stamps of another clock": ("measured_js", "3.6e+03 s old"),
    "old stamps": ("measured_js", "0.3"),
    "stamps that repeat": ("measured_js", "repeat or go back"),
    "another instrument": ("local/measured_cp", "9.6 mm and 0.0 degrees from where the joints"),
    "joints of another arm": ("local/measured_cp", "from where the joints"),
    "five joints": ("measured_js", "5 joints, not 6"),
    "not a number": ("measured_js", "roll is nan rad"),
    "no state": ("operating_state", "Nobody publishes it"),
    "a state that is not kept": ("operating_state", "not kept"),
    "a second source": ("local/measured_cp", "2 publish it"),
    "another commander": ("servo_cp", "Somebody else"),
    "teleoperation": ("/console/teleop/enabled", "Teleoperation is on"),
}


def report_of(*faults: str, arm: str = "PSM1", stated: str = DEFAULT_INSTRUMENT, **options):
    bus = MemoryBus()
    how = {name: options.pop(name) for name in ("late_s", "clock_ns") if name in options}
    stepped(bus, StandIn(bus, [arm], faults=faults, **options), 1.5, **how)
    return check(heard_of(bus, arm, 1.5), stated)


def named(report, fault: str) -> bool:
    topic, words = WORDS[fault]
    return any(one.topic.endswith(topic) and words in str(one) for one in report.findings)


def test_every_fault_of_the_stand_in_has_its_words():
    assert set(WORDS) == set(NAMES) and len(NAMES) > 20


@pytest.mark.parametrize("fault", NAMES)
def test_a_planted_fault_is_named_with_a_remedy(fault):
    report = report_of(fault)
    assert named(report, fault), [str(one) for one in report.findings]
    assert all(one.remedy.endswith(".") for one in report.findings)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"camera": False},
        {"rate_hz": 100.0},
        {"rate_hz": 500.0},
        {"arm": "PSM2"},
        {"late_s": 0.03},
        {"clock_ns": 60_000_000},
        {"clock_ns": -60_000_000},
        *({"instrument": one, "stated": one} for one in INSTRUMENTS),
    ],
)
def test_a_sound_arm_may_be_followed(options):
    report = report_of(**options)
    assert [str(one) for one in report.findings] == []
    assert report.frame == ("ECM" if options.get("camera", True) else "PSM1_base")
    rate = options.get("rate_hz", 200.0)
    assert all(one.rate_hz == pytest.approx(rate, rel=0.01) for one in report.streams if "state" not in one.topic)


def test_another_instrument_is_named_where_one_fits():
    other = next(one for one in INSTRUMENTS if one != DEFAULT_INSTRUMENT and report_of(instrument=one).findings)
    (found,) = report_of(instrument=other).findings
    assert other in found.remedy and "name it" in found.remedy


def test_an_arm_that_is_not_there_is_told_from_those_that_are():
    bus = MemoryBus()
    stepped(bus, StandIn(bus, ["PSM1", "PSM2"]), 0.5)
    (found,) = check(heard_of(bus, "PSM3", 0.5)).findings
    assert str(found) == "/PSM3: Nobody publishes anything of it. There are PSM1, PSM2."
    (found,) = check(heard_of(MemoryBus(), "PSM3", 0.5)).findings
    assert "No arm is on this bus" in found.remedy


def test_messages_are_read_as_rosbags_reads_them():
    made = {
        "geometry_msgs/msg/PoseStamped": say.pose("", 5_000_000_007, "ECM", (0.1, -0.2, 0.3), (0.5, 0.5, 0.5, -0.5)),
        "sensor_msgs/msg/JointState": say.joint_state(
            "", 5_000_000_007, [0.1, 0.2], ["yaw", "a"], velocities=[1.0, 2.0], efforts=[3.0]
        ),
        "sensor_msgs/msg/Joy": say.joy("", 7, [2]),
        "std_msgs/msg/Bool": say.boolean("", 0, True),
        "std_msgs/msg/String": say.text("", 0, "äöü"),
    }
    theirs = {kind: JAZZY.deserialize_cdr(one.data, kind) for kind, one in made.items()}
    ours = {kind: decode(kind, one.data) for kind, one in made.items()}
    pose, joints = theirs["geometry_msgs/msg/PoseStamped"], theirs["sensor_msgs/msg/JointState"]
    place, turn = pose.pose.position, pose.pose.orientation
    assert ours["geometry_msgs/msg/PoseStamped"] == SaidPose(
        pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec,
        pose.header.frame_id,
        (place.x, place.y, place.z),
        (turn.x, turn.y, turn.z, turn.w),
    )
    rows = (tuple(getattr(joints, name).tolist()) for name in ("position", "velocity", "effort"))
    assert ours["sensor_msgs/msg/JointState"] == SaidJoints(5_000_000_007, tuple(joints.name), *rows)
    assert ours["sensor_msgs/msg/Joy"].pressed == theirs["sensor_msgs/msg/Joy"].buttons[0]
    assert ours["std_msgs/msg/Bool"] is theirs["std_msgs/msg/Bool"].data is True
    assert ours["std_msgs/msg/String"] == theirs["std_msgs/msg/String"].data
    state = say.operating_state("", 7, "PAUSED", True, False)
    assert decode("crtk_msgs/msg/OperatingState", state.data) == SaidState(7, "PAUSED", True, False)


@pytest.mark.parametrize("kind", DECODERS)
def test_bytes_that_are_no_message_are_refused(kind):
    for data in (b"", b"\0\1\0\0", b"\0\0\0\0\0\0\0\0", b"\0\1\0\0" + b"\xff" * 7 * (kind != BOOL)):
        with pytest.raises(BadInput):
            decode(kind, data)


def test_what_a_stand_in_cannot_be_asked_is_refused():
    with pytest.raises(BadSettings, match="no fault 'tired'; there are unhomed"):
        StandIn(MemoryBus(), ["PSM1"], faults=["tired"])
    with pytest.raises(BadSettings, match="1 to 1000"):
        StandIn(MemoryBus(), ["PSM1"], rate_hz=0)


# ---- on DDS, the stand-in in another process -------------------------------------------------------------------------


@pytest.fixture
def domain(worker_id: str):
    """Return a domain of this test process alone."""
    return 100 + int(worker_id.removeprefix("gw") or 0) if worker_id.startswith("gw") else 99


def simulated(domain: int, *arguments: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "skills", "arm", "simulate", "PSM1", "--domain", str(domain), *arguments]
    return subprocess.Popen([*command, "--seconds", "120"], stderr=subprocess.DEVNULL)


@pytest.mark.parametrize("fault", ["", *some(NAMES, 9)])
def test_a_stand_in_on_dds_is_checked_from_another_process(domain, fault):
    from skills.live.dds import DdsBus

    process = simulated(domain, *(["--fault", fault] if fault else []))
    bus = DdsBus(domain)
    try:
        heard = bus.listen(measured("PSM1")["setpoint_cp"])
        until(heard, by=[process])
        for _ in range(5):  # beside other tests a machine may be late itself
            report = check(listen_to(bus, "PSM1", 1.5))
            if named(report, fault) if fault else not report.findings:
                return
        pytest.fail(str([str(one) for one in report.findings]))
    finally:
        process.kill()
        process.wait(END_S)
        bus.close()


SPEAKS = """
import sys, time
from skills.formats import bag_writer as say
from skills.formats.topics import BOOL
from skills.live.dds import DdsBus
from skills.live.interface import TELEOPERATION, measured
bus = DdsBus(int(sys.argv[1]))
bus.speak(TELEOPERATION)(say.boolean("", 0, True).data)
speak = bus.speak(measured("PSM9")["measured_js"])
for stamp in range(1, 100_000):
    speak(say.joint_state("", stamp, [0.1 * stamp] * 6, ["a"], velocities=[1.0], efforts=[float(stamp)]).data)
    time.sleep(0.005)
"""


def test_what_is_kept_reaches_who_comes_late_and_bytes_are_as_sent(domain):
    from skills.live.dds import DdsBus

    process = subprocess.Popen([sys.executable, "-c", SPEAKS, str(domain)])
    bus, topic = DdsBus(domain), measured("PSM9")["measured_js"]
    try:
        passing, came = bus.listen(topic), []
        until(lambda: came.extend(one.data for one in passing()) or len(came) > 200, by=[process])
        kept, seen = bus.listen(TELEOPERATION), []
        until(lambda: seen.extend(one.data for one in kept()) or seen, by=[process])
        assert [decode(TELEOPERATION.type, one) for one in seen] == [True]
        stamps = [decode(topic.type, one).stamp_ns for one in came]
        assert stamps == sorted(set(stamps)), "none twice, none out of order"
        for stamp, data in zip(stamps, came, strict=True):
            efforts = [float(stamp)]
            sent = say.joint_state("", stamp, [0.1 * stamp] * 6, ["a"], velocities=[1.0], efforts=efforts).data
            assert data == sent
        writers = {one.topic: one for one in bus.writers()}
        assert writers[topic.name].type == topic.type
        assert not writers[topic.name].keeps and writers[TELEOPERATION.name].keeps
        assert not any(one.is_ours for one in writers.values())
        bus.speak(topic)
        until(lambda: any(one.is_ours for one in bus.writers()))
    finally:
        process.kill()
        process.wait(END_S)
        bus.close()


@pytest.mark.parametrize(("domain_id", "interface"), [(-1, None), (233, None), (0, 'lo"/><x y="'), (0, "")])
def test_a_domain_and_an_interface_cannot_be_anything(domain_id, interface):
    from skills.live.dds import DdsBus

    with pytest.raises(BadSettings):
        DdsBus(domain_id, interface)


def test_without_the_extra_the_commands_say_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    for command in (["arm", "check", "PSM1"], ["arm", "simulate", "PSM1", "--seconds", "1"]):
        ran = CliRunner().invoke(app, command)
        assert ran.exit_code == 1 and "pip install 'suture-skills[live]'" in ran.output
