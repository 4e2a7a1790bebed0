"""Film crews that answer, and not with a film."""

import numpy as np

from skills.sim import wire


def no_film(request: bytes) -> bytes:
    return wire.pack({})


def no_gif(request: bytes) -> bytes:
    return wire.pack({"mp4": np.frombuffer(b"\0\0\0\x20ftypisom", np.uint8), "gif": np.frombuffer(b"GIF", np.uint8)})
