"""Suture points from a simulator: the poses of its Entry and Exit marks, transformed to an arm's base frame.

    MCAP --read_scene--> Recording of marks and bases --suture_points--> SuturePoints

AMBF's surgical robotics challenge publishes `/CRTK/Entry1..4/measured_cp` and `/CRTK/Exit1..4/measured_cp`, and for
each arm `/CRTK/<psm>/T_b_w`, the pose of its base; all PoseStamped, in metres, in the frame "world" (its
launch_crtk_interface.py and docs/scene_coordinate_frames.md). A plan needs the arm's base frame, so a mark p becomes
T_b_w^-1 p. In the scene's Recording the "arm" of a motion is the name of the mark, or of the arm of the base.

The Exit is proposed as the goal of a pass, not the Entry: the needle goes in at the Entry and comes out at the Exit,
where PSM_A holds it at the hand-off.
"""

import re
from typing import BinaryIO, Literal

import numpy as np

from skills.arrays import Floats, xyz, xyzw
from skills.demonstration.recording import Motion, Recording
from skills.errors import MixedFrames, NotMetres, NoUsableTopic, UnreadableRecording
from skills.formats.mcap import read_mcap
from skills.formats.reader_process import write_answer
from skills.formats.topics import POSE, Meaning, TopicKind
from skills.kinematics import angle_between, matrix_of, quaternion_of
from skills.remedies import did_you_mean
from skills.schemas.recordings import SuturePoint
from skills.schemas.recordings import SuturePoints as SuturePoints

READ = f"{__name__}:read"
STEADY_MM, STEADY_RAD = 1.0, 0.05  # ours: a fifth of the paper's cell; a mark that moves more has no single place
REACH_MM = 300.0  # ours: beyond a PSM's reach from its remote centre; AMBF's units taken for metres are ten times off

NO_MARKS = "The file has no poses of Entry or Exit marks, such as /CRTK/Exit1/measured_cp."

Kind = Literal["entry", "exit"]

_MARK = re.compile(r"(Entry|Exit)([1-9]\d{0,3})", re.IGNORECASE)
_BASE = "T_b_w"


def suture_points(scene: Recording, *, arm: str | None = None, frame: str | None = None) -> SuturePoints:
    """Transform the marks of a scene to the base frame of an arm.

    Args:
        scene: The recording from `read_scene`.
        arm: The arm; optional if the scene has the base of exactly one.
        frame: The name of that arm's base frame. If the scene has no base at all, or only other arms' and the marks
            state this very frame, the marks are taken to be in it.

    Raises:
        NoUsableTopic: There are no marks; or no base, several, or not this arm's, and no frame is given.
        MixedFrames: Mark and base are in different frames, or one of them moved.
        NotMetres: A mark is beyond the reach of any arm.
    """
    marks = sorted((m for m in scene.motions if _MARK.fullmatch(m.arm)), key=lambda m: _sort_key(m.arm))
    if not marks:
        raise NoUsableTopic(NO_MARKS)
    base = _base_of(scene, arm, frame, marks[0].frame)
    first: dict[Kind, Floats] = {}
    points = []
    for mark in marks:
        tip, rotation = _median_pose(mark)
        if base is not None:
            if mark.frame != base.frame:
                raise MixedFrames(f"{mark.topic} is in {mark.frame!r} and {base.topic} in {base.frame!r}.")
            origin, turned = _median_pose(base)
            tip, rotation = (tip - origin) @ turned, turned.T @ rotation
        if not (away_mm := float(np.linalg.norm(tip))) <= REACH_MM:
            raise NotMetres(
                f"{mark.topic} is {away_mm:.0f} mm from the arm's remote centre, and no PSM reaches beyond "
                f"{REACH_MM:g} mm; it belongs to another arm, or is in the simulator's units, not metres.",
                topic=mark.topic,
            )
        kind: Kind = "entry" if mark.arm.lower().startswith("entry") else "exit"
        turn = rotation @ first.setdefault(kind, rotation).T
        turns = map(xyzw, quaternion_of(np.stack([rotation, turn])))
        points.append(SuturePoint(mark.arm, kind, kind == "exit", xyz(tip), *turns))
    own_arm = arm if base is None or arm is not None else base.arm
    return SuturePoints(arm=own_arm, frame=frame or f"{own_arm}_base", points=tuple(points))


def read_scene(file: BinaryIO) -> Recording:
    """Read the poses of marks and of arm bases from an MCAP file, at its beginning.

    Returns:
        The poses as motions, in millimetres.

    Raises:
        UnreadableRecording: Truncated, corrupt, over a size limit, or in an unsupported encoding.
        NoUsableTopic: It has no mark.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    try:
        return read_mcap(file, _meaning)
    except NoUsableTopic as error:
        raise NoUsableTopic(NO_MARKS) from error


def read(file: BinaryIO, answer: BinaryIO) -> None:
    """Read a scene, and write it or its refusal; runs in a fork under limits."""
    write_answer(read_scene, file, answer)


# ---- from the file ----------------------------------------------------------------------------------------------


def _meaning(topic: str, message_type: str) -> Meaning | None:
    """Return the mark or the arm whose pose a topic carries; None for any other topic.

    Raises:
        UnreadableRecording: It is one, of another type than a pose.
    """
    *_, name, what = ["", *topic.split("/")]
    is_mark = what == "measured_cp" and _MARK.fullmatch(name)
    is_base = what == _BASE and name.lower().startswith("psm")
    if not (is_mark or is_base):
        return None
    if message_type != POSE:
        raise UnreadableRecording(f"{topic} is not a {POSE}; record it as one, or convert the bag.", topic=topic)
    return Meaning(TopicKind.MOTION, name)


# ---- one place --------------------------------------------------------------------------------------------------


def _base_of(scene: Recording, arm: str | None, frame: str | None, seen_in: str) -> Motion | None:
    """Return the base to transform the marks to; None where they are taken to be in the arm's frame already."""
    bases = [one for one in scene.motions if not _MARK.fullmatch(one.arm)]
    fitting = [one for one in bases if arm is None or one.arm.lower() == arm.lower()]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        named = ", ".join(one.arm for one in fitting)
        raise NoUsableTopic(f"The file has the bases of {named}; name the arm.", arms=[one.arm for one in fitting])
    if bases and frame != seen_in:
        raise NoUsableTopic(
            f"The marks are in the frame {seen_in!r}, and the file has the bases of "
            f"{', '.join(one.arm for one in bases)}, not of {arm}; name one of these arms, or record "
            f"/CRTK/<psm>/{_BASE} of {arm} too.",
            *did_you_mean(arm or "", [one.arm for one in bases]),
        )
    if frame is None:
        raise NoUsableTopic(
            f"The marks are in the frame {seen_in!r}, and the file has no pose of the arm's base in it; record "
            f"/CRTK/<psm>/{_BASE} too, or, if the marks are in the arm's base frame, name that as the frame.",
        )
    return None


def _median_pose(motion: Motion) -> tuple[Floats, Floats]:
    """Return the median pose of something that does not move.

    Returns:
        Position in mm, shape (3,), and rotation matrix, shape (3, 3).

    Raises:
        MixedFrames: It moved.
    """
    assert motion.rotation_xyzw is not None
    place = np.median(motion.tip_mm, axis=0)
    # q and -q are the same rotation; a median needs all of them on one side.
    alike = motion.rotation_xyzw * np.where(motion.rotation_xyzw @ motion.rotation_xyzw[0] < 0, -1.0, 1.0)[:, None]
    middle = matrix_of(np.median(alike, axis=0)[None])
    moved_mm = float(np.linalg.norm(motion.tip_mm - place, axis=1).max())
    turned = angle_between(matrix_of(alike), np.broadcast_to(middle, (len(alike), 3, 3)))
    if not (moved_mm <= STEADY_MM and float(turned.max()) <= STEADY_RAD):
        raise MixedFrames(
            f"{motion.topic} moved by {moved_mm:.1f} mm and {np.degrees(turned.max()):.1f} degrees in the "
            "recording; a plan needs a scene that does not move, so cut the recording.",
            topic=motion.topic,
        )
    return np.asarray(place), middle[0]


def _sort_key(name: str) -> tuple[int, str]:
    """Sort key: Entry1, Exit1, Entry2 ... by number, entries before exits."""
    found = _MARK.fullmatch(name)
    assert found is not None
    return int(found[2]), found[1].lower()
