"""What is drawn of a playback: a value like any other, so that it can be stored whole."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Pictures:
    """The pictures of a playback, each the bytes of a file.

    Attributes:
        animation_mp4: The film of the whole trajectory, H.264.
        animation_gif: The same film as a GIF.
        joints_png: The joints of both arms against their limits, over time.
        clearance_png: Distances between surfaces over time, with what is allowed.
    """

    animation_mp4: bytes
    animation_gif: bytes
    joints_png: bytes
    clearance_png: bytes
