"""Simulators with one fault each, to be named to `play` or `confined.run` in place of the real one."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from skills.sim import wire


def echo(request: bytes) -> bytes:
    return request[::-1]


def echo_and_chatter(request: bytes) -> bytes:
    os.write(1, b"banner of a C library\n")
    print("and of Python", flush=True)
    return request


def surroundings(request: bytes) -> bytes:
    return "\n".join(sorted(os.environ)).encode()


def open_too_many_files(request: bytes) -> bytes:
    opened = [os.open("/dev/null", os.O_RDONLY) for _ in range(1000)]
    return str(len(opened)).encode()


def crash(request: bytes) -> bytes:
    os.kill(os.getpid(), signal.SIGSEGV)
    return b""


def leave(request: bytes) -> bytes:
    os._exit(3)


def fail(request: bytes) -> bytes:
    raise RuntimeError("the joint that nobody knows")


def hang(request: bytes) -> bytes:
    if request.startswith(b"/"):  # where it should say who it is
        Path(request.decode()).write_text(str(os.getpid()))
    time.sleep(120)
    return b""


def eat_memory(request: bytes) -> bytes:
    return bytes(len(np.ones(1 << 30)))


def garbage(request: bytes) -> bytes:
    return b"PK\x03\x04 this is no archive"


def nothing(request: bytes) -> bytes:
    return b""


def pickled(request: bytes) -> bytes:
    import io

    out = io.BytesIO()
    np.savez(out, tip_mm=np.array([{"a": 1}], dtype=object))
    return out.getvalue()


def answer(request: bytes) -> dict[str, Any]:
    """Answer like a simulator that measures just what was asked."""
    asked = wire.unpack(request)
    count = len(asked["tip_mm"])
    return {
        "tip_mm": asked["tip_mm"],
        "rotation_xyzw": asked["rotation_xyzw"],
        "joints": asked["joints"],
        "tracking_mm": np.zeros(count),
        "efforts": np.zeros((count, 6)),
        "contact_n": np.zeros(count),
        "looked_at": asked["looks"],
        "clearances_mm": np.full((len(asked["looks"]), 4), 5.0),
        "shaft_off_mm": np.zeros(len(asked["looks"])),
        "files": np.array(["psm.urdf"]),
        "digests": np.array(["0" * 64]),
        "picture_png": np.frombuffer(b"\x89PNG\r\n\x1a\n", np.uint8),
        "engine": np.array("none"),
        "seconds_per_step": np.array(1e-5),
    }


def sound(request: bytes) -> bytes:
    return wire.pack(answer(request))


def not_a_number(request: bytes) -> bytes:
    wrong = answer(request)
    wrong["tracking_mm"][3] = np.nan
    return wire.pack(wrong)


def nan_joint(request: bytes) -> bytes:
    wrong = answer(request)
    wrong["joints"][3, 2] = np.nan
    return wire.pack(wrong)


def nan_clearance(request: bytes) -> bytes:
    wrong = answer(request)
    wrong["clearances_mm"][3, 1] = np.nan
    return wire.pack(wrong)


def looked_the_other_way(request: bytes) -> bytes:
    wrong = answer(request)
    return wire.pack(wrong | {"looked_at": wrong["looked_at"][::-1]})


def no_such_file(request: bytes) -> bytes:
    return wire.pack(answer(request) | {"files": np.array(["../psm.urdf"])})


def too_short(request: bytes) -> bytes:
    wrong = answer(request)
    return wire.pack(wrong | {"tip_mm": wrong["tip_mm"][:-1]})


def whole_numbers(request: bytes) -> bytes:
    wrong = answer(request)
    return wire.pack(wrong | {"joints": wrong["joints"].astype(np.int64)})


def no_picture(request: bytes) -> bytes:
    return wire.pack(answer(request) | {"picture_png": np.frombuffer(b"GIF89a", np.uint8)})


def incomplete(request: bytes) -> bytes:
    short = answer(request)
    del short["clearances_mm"]
    return wire.pack(short)
