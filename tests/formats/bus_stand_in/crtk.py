"""A stand-in for crtk-python: every command is a line of JSON in the file $BUS; sleeping takes $SLEEP of its time."""

import json
import os
import sys
import time

_sleep = time.sleep
time.sleep = lambda seconds: _sleep(seconds * float(os.environ["SLEEP"]))


def _say(topic: str, position, velocity) -> None:
    line = {"at_s": time.monotonic(), "topic": topic, "position": list(position), "velocity": list(velocity)}
    with open(os.environ["BUS"], "a") as bus:
        bus.write(json.dumps(line) + "\n")


class ral:  # noqa: N801 - crtk's name
    def __init__(self, name: str) -> None:
        self.name = name

    @staticmethod
    def ros_version() -> int:
        return 2

    @staticmethod
    def parse_argv(argv: list[str]) -> list[str]:
        return argv

    @staticmethod
    def to_sec(stamp) -> float:
        return stamp.sec + stamp.nanosec / 1e9

    def create_child(self, name: str) -> "ral":
        return ral(f"{self.name.removeprefix('dvrk_bag_replay')}/{name.strip('/')}")

    def spin(self) -> None:
        pass

    def check_connections(self) -> None:
        pass

    def shutdown(self) -> None:
        sys.stdout.flush()


class _Moved:
    def wait(self) -> None:
        pass


class utils:  # noqa: N801 - crtk's name
    def __init__(self, class_instance, ral: ral, operating_state_instance=None) -> None:
        self.of, self.name = class_instance, ral.name

    def add_operating_state(self) -> None:
        self.of.enable = self.of.home = lambda timeout: True

    def add_servo_jp(self) -> None:
        self.of.servo_jp = lambda position, velocity: _say(f"{self.name}/servo_jp", position, velocity)

    def add_move_jp(self) -> None:
        def move(position) -> _Moved:
            _say(f"{self.name}/move_jp", position, ())
            return _Moved()

        self.of.move_jp = move

    def add_servo_cp(self) -> None:
        pass

    def add_move_cp(self) -> None:
        pass
