"""A stand-in for a dVRK: arms that are simulated, on a bus, in real time; with faults of an interface on request.

    StandIn(bus, arms) --run--> what arms say, until the time is over

An arm is `dynamics.MovingArm`, in the middle of a servo's ranges, driven by what came last on `servo_jp` or `servo_cp`.
It has no planner (`move_*`), no masters and no contact. It is no robot: what works here may fail on one.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from skills.arrays import Floats
from skills.dynamics import MovingArm, Servo
from skills.errors import BadInput, BadSettings, Unreachable
from skills.formats import bag_writer as say
from skills.formats.columns import in_metres
from skills.formats.topics import JOINT_STATE
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, JOINTS, forward, inverse, matrix_of, quaternion_of
from skills.live.bus import Bus
from skills.live.interface import TELEOPERATION, SaidJoints, SaidPose, commands, decode, measured

HOME = (0.0, 0.0, 120.0, 0.0, 0.0, 0.0)  # rad and mm: straight, well inside the patient
STATE_AFTER_S = 0.2  # so that whoever listens from the beginning hears the change too
_ECM = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # a camera that looks down, seen from the base
_ECM_MM = np.array([0.0, 50.0, 20.0])


@dataclass
class Spoken:
    """What an arm is about to say of itself; a fault changes it.

    Lengths are m, angles rad, times ns; poses are positions and rotations [n o a].
    """

    now_ns: int
    number: int
    joints: list[float]
    speeds: list[float]
    efforts: list[float]
    base_mm: Floats
    base: Floats
    frame: str
    quaternion_length: float = 1.0
    scale: float = 1e-3
    silent: set[str] = field(default_factory=set)


def _silent(*names: str) -> Callable[[Spoken], None]:
    return lambda one: one.silent.update(names)


def _scaled(first: int, last: int, factor: float) -> Callable[[Spoken], None]:
    def change(one: Spoken) -> None:
        one.joints[first:last] = [factor * value for value in one.joints[first:last]]

    return change


def _put(**values: float | str) -> Callable[[Spoken], None]:
    return lambda one: one.__dict__.update(values)


def _stamped(change: Callable[[Spoken], int]) -> Callable[[Spoken], None]:
    return lambda one: one.__dict__.update(now_ns=change(one))


def _every(count: int, within: int = 1) -> Callable[[Spoken], None]:
    """Let an arm say nothing but in some of so many ticks."""
    return lambda one: one.silent.update(measured("")) if one.number % count >= within else None


# Faults of an interface by name; the first ones are of the state, see `StandIn`.
STATES = MappingProxyType({"unhomed": ("ENABLED", False), "disabled": ("DISABLED", True), "faulted": ("FAULT", True)})
FAULTS: MappingProxyType[str, Callable[[Spoken], None]] = MappingProxyType(
    {
        "no pose in the base": _silent("local/measured_cp"),
        "no joints": _silent("measured_js"),
        "no jaw": _silent("jaw/measured_js"),
        "positions in mm": _put(scale=1.0),
        "joints in degrees": _scaled(0, 6, float(np.degrees(1.0))),
        "insertion in mm": _scaled(2, 3, 1000.0),
        "half a quaternion": _put(quaternion_length=0.5),
        "no frame": _put(frame=""),
        "a frame that changes": lambda one: one.__dict__.update(frame="ECM" if one.number % 100 < 50 else "ECM_view"),
        "20 poses a second": _every(10),
        "gaps": _every(60, 45),
        "stamps of another clock": _stamped(lambda one: one.now_ns - 3_600_000_000_000),
        "old stamps": _stamped(lambda one: one.now_ns - 300_000_000),
        "stamps that repeat": _stamped(lambda one: one.now_ns // 1_000_000_000 * 1_000_000_000),
        "another instrument": _scaled(2, 3, 1.08),
        "joints of another arm": lambda one: one.joints.__setitem__(0, one.joints[0] + 0.2),
        "five joints": lambda one: one.joints.__delitem__(5),
        "not a number": lambda one: one.joints.__setitem__(3, float("nan")),
    }
)
AT_ONCE = ("no state", "a state that is not kept", "a second source", "another commander", "teleoperation")
NAMES = (*STATES, *FAULTS, *AT_ONCE)


class StandIn:
    """Simulated arms on a bus.

    Attributes:
        arms: The arms by name.
        period_s: Time of a tick.
        camera: Whether `measured_cp` is in the frame of a camera.
    """

    def __init__(
        self,
        bus: Bus,
        arms: Sequence[str],
        *,
        servo: Servo | None = None,
        rate_hz: float = 200.0,
        camera: bool = True,
        instrument: str = DEFAULT_INSTRUMENT,
        faults: Sequence[str] = (),
    ) -> None:
        """Announce the arms.

        Args:
            bus: The bus.
            arms: Their names, such as PSM1.
            servo: How they are driven; by default with velocities and compensated gravity.
            rate_hz: Messages and setpoints per second.
            camera: Whether a camera is configured, so that `measured_cp` is in its frame.
            instrument: Number of their instrument.
            faults: Names of `NAMES`.

        Raises:
            BadSettings: There is no such fault, or the rate is not above 0.
        """
        if unknown := set(faults) - set(NAMES):
            raise BadSettings(f"There is no fault {sorted(unknown)[0]!r}; there are {', '.join(NAMES)}.")
        if not 0 < rate_hz <= 1000:
            raise BadSettings("A stand-in says 1 to 1000 messages a second.", given=rate_hz)
        self.period_s, self.camera = 1.0 / rate_hz, camera
        driven = servo or Servo(gravity_compensated=True)
        self.arms = {name: SimulatedArm(bus, name, driven, instrument, tuple(faults)) for name in arms}
        if "teleoperation" in faults:
            bus.speak(TELEOPERATION)(say.boolean("", 0, True).data)

    def run(self, seconds: float, *, clock: Callable[[], float] = time.monotonic) -> int:
        """Move the arms and say where they are, for some seconds, and return the number of late ticks.

        Args:
            seconds: How long; infinity: until it is interrupted.
            clock: The clock, in s.
        """
        began, tick, late = clock(), 0, 0
        while (due := began + tick * self.period_s) < began + seconds:
            if (wait := due - clock()) > 0:
                time.sleep(wait)
            elif wait < -self.period_s:
                late += 1
                tick = int((clock() - began) / self.period_s)  # a tick that was missed is not made up for
            for arm in self.arms.values():
                arm.tick(self.period_s, tick, self.camera, time.time_ns())
            tick += 1
        return late


class SimulatedArm:
    """One arm: its motion, and what it says and hears."""

    def __init__(self, bus: Bus, name: str, servo: Servo, instrument: str, faults: tuple[str, ...]) -> None:
        self.name, self._instrument = name, instrument
        self.moving = MovingArm(HOME, servo, instrument)
        self.wanted, self._speeds, self._jaw = np.array(HOME), np.zeros(6), 0.3
        self._changes = [FAULTS[one] for one in faults if one in FAULTS]
        said = measured(name)
        if "a state that is not kept" in faults:
            said["operating_state"] = replace(said["operating_state"], event=False)
        silent = {"operating_state"} if "no state" in faults else set()
        self._speak = {key: bus.speak(topic) for key, topic in said.items() if key not in silent}
        if "a second source" in faults:
            bus.speak(said["local/measured_cp"])
        asked = commands(name)
        if "another commander" in faults:
            bus.speak(asked["servo_cp"])
        self._hear = {
            key: (bus.listen(asked[key]), asked[key].type) for key in ("servo_jp", "servo_cp", "jaw/servo_jp")
        }
        self._state = next((STATES[one] for one in faults if one in STATES), ("ENABLED", True))
        self._told = False

    def tick(self, period_s: float, number: int, camera: bool, now_ns: int) -> None:
        """Move for a period under what was heard last, and say where the arm is."""
        self._take(camera)
        self.moving.move(self.wanted, self._speeds, period_s)
        if not self._told and number * period_s >= STATE_AFTER_S:
            self._told = True
            self._say("operating_state", say.operating_state("", now_ns, *self._state, False))
        joints = in_metres(self.moving.joints[None])[0].tolist()
        speeds = in_metres(self.moving.speeds[None])[0].tolist()
        base, base_mm = (_ECM, _ECM_MM) if camera else (np.eye(3), np.zeros(3))
        frame = "ECM" if camera else f"{self.name}_base"
        one = Spoken(now_ns, number, joints, speeds, self.moving.efforts.tolist(), base_mm, base, frame)
        for change in self._changes:
            change(one)
        self._tell(one)

    def _tell(self, one: Spoken) -> None:
        wanted = in_metres(self.wanted[None])[0].tolist()
        for key, joints, velocities, efforts in (
            ("measured_js", one.joints, one.speeds, one.efforts),
            ("setpoint_js", wanted, (), ()),
            ("jaw/measured_js", [self._jaw], [0.0], [0.0]),
        ):
            if key not in one.silent:
                names = ["jaw"] if key.startswith("jaw") else JOINTS[: len(joints)]
                told = say.joint_state("", one.now_ns, joints, names, velocities=velocities, efforts=efforts)
                self._say(key, told)
        tips, turned = forward(np.stack([self.moving.joints, self.wanted]), self._instrument)
        for key, row, frame in (
            ("local/measured_cp", 0, f"{self.name}_base" if one.frame else ""),
            ("measured_cp", 0, one.frame),
            ("setpoint_cp", 1, one.frame),
        ):
            if key not in one.silent:
                local = key.startswith("local")
                tip = tips[row] if local else one.base @ tips[row] + one.base_mm
                turn = quaternion_of(turned[row][None] if local else (one.base @ turned[row])[None])[0]
                place = (one.scale * tip).tolist()
                self._say(key, say.pose("", one.now_ns, frame, place, (one.quaternion_length * turn).tolist()))

    def _say(self, key: str, message: say.Message) -> None:
        if key in self._speak:
            self._speak[key](message.data)

    def _take(self, camera: bool) -> None:
        """Take the newest setpoints; what is no setpoint of an arm is not followed."""
        for key, (take, kind) in self._hear.items():
            for seen in list(take())[-1:]:
                value = decode(kind, seen.data)
                if isinstance(value, SaidJoints) and key.startswith("jaw"):
                    self._jaw = value.position[0]
                elif isinstance(value, SaidJoints) and kind == JOINT_STATE and len(value.position) == len(HOME):
                    self.wanted, self._speeds = _in_mm(value.position), _in_mm(value.velocity or [0.0] * len(HOME))
                elif isinstance(value, SaidPose):
                    self._go_to(value, camera)

    def _go_to(self, pose: SaidPose, camera: bool) -> None:
        tip_mm, turn = 1e3 * np.array(pose.position_m), matrix_of(np.array([pose.rotation_xyzw]))[0]
        if camera:
            tip_mm, turn = _ECM.T @ (tip_mm - _ECM_MM), _ECM.T @ turn
        try:
            (joints,) = inverse(tip_mm[None], turn[None], self._instrument)
        except (BadInput, Unreachable):
            return
        self.wanted, self._speeds = joints, np.zeros(6)


def _in_mm(joints: Iterable[float]) -> Floats:
    found = np.array([*joints])
    found[INSERTION] *= 1e3
    return found
