"""Suture points out of what a simulator published; nothing is stored."""

from functools import partial

from skills.library.recordings import Reader, Upload, read_upload
from skills.recordings.suture_points import PARSE, SuturePoints, suture_points


def find_suture_points(upload: Upload, arm: str | None, read: Reader) -> SuturePoints:
    """Read the marks of a scene, in a process of their own, and bring them to an arm's base.

    Args:
        upload: An MCAP file; its `frame` names the arm's base frame.
        arm: The arm; None where the file has the base of one.
        read: What reads apart, `ConfinedReader` or what is called like it.

    Raises:
        BadRecording: It cannot be used; `skills.errors` names the kinds.
    """
    return suture_points(read_upload(upload, partial(read, target=PARSE)), arm=arm, frame=upload.frame)
