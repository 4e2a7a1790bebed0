"""A CRTK arm that follows a pose style: a session over the network, setpoints on `servo_cp`. Research use only.

    python examples/crtk_session.py kestrel simple-running --arm PSM2              # prints the setpoints, moves nothing
    python examples/crtk_session.py kestrel simple-running --arm PSM2 --publish    # publishes them

The loop measures the pose, asks the session for the next one, and publishes it, once in each tick of the style. It
ends, and publishes nothing more, where it must not go on: the session was closed (withdrawn, lost, too slow), the
measured pose is old, in another frame or outside the tube, the arm is not enabled, or a setpoint is further away than
`MOST_MM` or `MOST_DEG`. It checks no joint limit and no distance: `skills plan`, `skills play` and the arm's own
controller do.

`follow` knows no ROS: `Bus` is all that it asks of an arm. `RosBus` is the one of ROS 2 with the topics of CRTK
(collaborative-robotics.github.io), in metres. The tests run `follow` with a stand-in for the bus and a real service;
`RosBus` was never run, neither on a robot nor on a simulator. Start with a simulator (docs/replay.md), an empty
workspace and the emergency stop at hand.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from skills.client import Client, SessionClosed

OLD_S = 0.1  # a pose that was measured longer ago is none; the dVRK publishes at 100 Hz and more
MOST_MM, MOST_DEG = 5.0, 10.0  # of a setpoint from the measured pose; a tick of a style is some tenths of a mm
AFRESH_S = 5.0  # for the first pose after the start


@dataclass(frozen=True)
class Measured:
    """A pose as `measured_cp` has it: mm, unit quaternion x y z w, its frame, and its age."""

    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    frame: str
    age_s: float


class Bus(Protocol):
    """An arm, as `follow` needs it."""

    def measured(self) -> Measured | None:
        """Return the newest pose; None before the first one."""

    def enabled(self) -> bool:
        """Return whether the arm is enabled and homed."""

    def servo(self, position_mm: Sequence[float], rotation_xyzw: Sequence[float], jaw_rad: float | None) -> None:
        """Publish a setpoint in the frame of the measured poses; None: the jaw stays."""

    def sleep(self, seconds: float) -> None:
        """Wait, while messages are received."""


def follow(bus: Bus, session: Any) -> str:
    """Follow a session from where the arm is until it ends, and return why it ended; "finished" if at the last pose."""
    opening, waited_s = session.opening, 0.0
    while bus.measured() is None:
        if waited_s >= AFRESH_S:
            return "no pose was measured: check the arm's name"
        bus.sleep(0.01)
        waited_s += 0.01
    while True:
        here = bus.measured()
        if here is None or not here.age_s <= OLD_S:
            return f"the measured pose is older than {OLD_S} s"
        if here.frame != opening.frame:
            return (
                f"the arm's poses are in '{here.frame}', the style's in '{opening.frame}': learn it in the arm's frame"
            )
        if not bus.enabled():
            return "the arm is not enabled and homed"
        try:
            step = session.next(here.position_mm, here.rotation_xyzw)
        except SessionClosed as closed:
            return f"the session was closed: {closed}"
        if not step.inside:
            return f"the arm is outside the tube: {step.off_mm:.1f} mm, {math.degrees(step.off_rad):.1f} degrees off"
        if step.finished:
            return "finished"
        far_mm = math.dist(here.position_mm, step.position_mm)
        far_deg = _turn_deg(here.rotation_xyzw, step.rotation_xyzw)
        if not (far_mm <= MOST_MM and far_deg <= MOST_DEG):
            return f"the next pose is {far_mm:.1f} mm and {far_deg:.1f} degrees away"
        bus.servo(step.position_mm, step.rotation_xyzw, step.jaw_rad)
        bus.sleep(opening.tick_s)


def _turn_deg(one: Sequence[float], other: Sequence[float]) -> float:
    return math.degrees(2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(one, other, strict=True))))))


class RosBus:
    """A CRTK arm on ROS 2, in a node of its own. Not run by the project: see the module."""

    def __init__(self, arm: str, publish: bool) -> None:
        """Subscribe to the arm's pose and state; with `publish` also advertise its setpoints."""
        import rclpy
        from crtk_msgs.msg import OperatingState
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import JointState

        rclpy.init()
        self._ros, self._pose_type, self._joint_type = rclpy, PoseStamped, JointState
        self._node = rclpy.create_node("suture_skills_session")
        self._pose: Any = None
        self._at_s, self._enabled, self._publish = 0.0, False, publish
        self._node.create_subscription(PoseStamped, f"/{arm}/measured_cp", self._take_pose, 1)
        self._node.create_subscription(OperatingState, f"/{arm}/operating_state", self._take_state, 10)
        if publish:
            self._cp = self._node.create_publisher(PoseStamped, f"/{arm}/servo_cp", 1)
            self._jaw = self._node.create_publisher(JointState, f"/{arm}/jaw/servo_jp", 1)

    def _take_pose(self, message: Any) -> None:
        self._pose, self._at_s = message, time.monotonic()

    def _take_state(self, message: Any) -> None:
        self._enabled = message.state == "ENABLED" and bool(message.is_homed)

    def measured(self) -> Measured | None:
        """Return the newest pose, in mm."""
        if self._pose is None:
            return None
        at, turn = self._pose.pose.position, self._pose.pose.orientation
        return Measured(
            (1e3 * at.x, 1e3 * at.y, 1e3 * at.z),
            (turn.x, turn.y, turn.z, turn.w),
            self._pose.header.frame_id,
            time.monotonic() - self._at_s,
        )

    def enabled(self) -> bool:
        """Return whether the arm says so."""
        return self._enabled

    def servo(self, position_mm: Sequence[float], rotation_xyzw: Sequence[float], jaw_rad: float | None) -> None:
        """Publish a setpoint in metres, or print it."""
        if not self._publish:
            print("would go to", [round(x, 2) for x in position_mm], "mm, jaw", jaw_rad)
            return
        pose = self._pose_type()
        pose.header.frame_id = self._pose.header.frame_id
        pose.header.stamp = self._node.get_clock().now().to_msg()
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = (float(x) / 1e3 for x in position_mm)
        turn = pose.pose.orientation
        turn.x, turn.y, turn.z, turn.w = map(float, rotation_xyzw)
        self._cp.publish(pose)
        if jaw_rad is not None:
            jaw = self._joint_type()
            jaw.name, jaw.position = ["jaw"], [float(jaw_rad)]
            self._jaw.publish(jaw)

    def sleep(self, seconds: float) -> None:
        """Receive messages for so long."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self._ros.spin_once(self._node, timeout_sec=left_s)


def main() -> None:
    """Follow a style with one arm."""
    given = argparse.ArgumentParser(description="Follow a pose style with a CRTK arm. Research use only.")
    given.add_argument("surgeon")
    given.add_argument("suture")
    given.add_argument("--arm", required=True, help="the arm's namespace, such as PSM2")
    given.add_argument("--server", default="http://127.0.0.1:8000", help="the service; the key is SKILLS_API_KEY")
    given.add_argument("--publish", action="store_true", help="move the arm; without it setpoints are printed alone")
    asked = given.parse_args()
    bus = RosBus(asked.arm, asked.publish)
    with Client(asked.server) as client, client.session(asked.surgeon, asked.suture, timeout_s=0.2) as session:
        print("It ended:", follow(bus, session))


if __name__ == "__main__":
    main()
