"""Suture points that a simulator publishes: the poses of its Entry and Exit marks, brought to an arm's base.

    MCAP --read_scene--> Recording of marks and bases --suture_points--> SuturePoints

AMBF's surgical robotics challenge publishes `/CRTK/Entry1..4/measured_cp` and `/CRTK/Exit1..4/measured_cp`, and for
each arm `/CRTK/<psm>/T_b_w`, the pose of its base; all PoseStamped, in metres, in the frame "world" (its
launch_crtk_interface.py and docs/scene_coordinate_frames.md). A plan wants the arm's base frame, so a mark p becomes
T_b_w^-1 p. In the scene's Recording a motion's "arm" is the name of the mark, or of the arm whose base it is.

The Exit is proposed as the goal of a pass, not the Entry: the needle goes in at the Entry and comes out at the Exit,
and it is there that PSM_A has it when it hands it over.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Literal

import numpy as np

from skills.errors import BadSettings, MixedFrames, NotMetres, NoUsableTopic, SkillsError, UnreadableRecording
from skills.recordings.cdr import Columns, Decoder, Wanted, fields_of
from skills.recordings.confined import answered
from skills.recordings.source import RECOVER
from skills.recordings.topics import POSE
from skills.recordings.walker import Channel, Walker
from skills.style._arrays import Floats
from skills.style.kinematics import angle_between, matrix_of, quaternion_of
from skills.style.recording import Motion, Recording, recorded_motion

PARSE = f"{__name__}:parse"
STEADY_MM, STEADY_RAD = 1.0, 0.05  # ours: a fifth of the paper's cell; a mark that moves more is no one place
REACH_MM = 300.0  # ours: what no PSM reaches from its remote centre; ten times a place is AMBF's unit taken for metres

Kind = Literal["entry", "exit"]

_MARK = re.compile(r"(Entry|Exit)([1-9]\d{0,3})", re.IGNORECASE)
_BASE = "T_b_w"
_WANTED = Wanted(
    tuple(f"pose.position.{axis}" for axis in "xyz") + tuple(f"pose.orientation.{axis}" for axis in "xyzw"),
    "header.frame_id",
)


@dataclass(frozen=True)
class Mark:
    """One mark in the arm's base frame.

    Attributes:
        name: Such as "Exit1".
        kind: Where the needle goes in, or where it comes out.
        is_goal: Whether it is proposed as a pass's goal: an exit is.
        position_mm: Its place.
        rotation_xyzw: How it is turned, as the simulator has its axes.
        turn_xyzw: The turn to it from the first mark of its kind: what turns a grid world here that was demonstrated
            there.
    """

    name: str
    kind: Kind
    is_goal: bool
    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    turn_xyzw: tuple[float, float, float, float]


@dataclass(frozen=True)
class SuturePoints:
    """The marks of a scene in one arm's base frame, in the order of their numbers, entries before exits."""

    arm: str | None
    frame: str
    points: tuple[Mark, ...]


def suture_points(scene: Recording, *, arm: str | None = None, frame: str | None = None) -> SuturePoints:
    """Bring the marks of a scene to the base of an arm.

    Args:
        scene: What `read_scene` gave.
        arm: The arm; may be left out where the scene has the base of one.
        frame: The name of that arm's base frame. Where the scene has no base of it, this says that the marks are in it.

    Raises:
        NoUsableTopic: There are no marks; or no base, several, or not this arm's, and no frame is given.
        MixedFrames: Mark and base are not in one frame, or one of them moved.
        NotMetres: A mark is where no arm reaches.
    """
    marks = sorted((m for m in scene.motions if _MARK.fullmatch(m.arm)), key=lambda m: _order(m.arm))
    if not marks:
        raise NoUsableTopic("The file has no poses of Entry or Exit marks, such as /CRTK/Exit1/measured_cp.")
    base = _base_of(scene, arm, frame, marks[0].frame)
    first: dict[Kind, Floats] = {}
    points = []
    for mark in marks:
        tip, rotation = _steady(mark)
        if base is not None:
            if mark.frame != base.frame:
                raise MixedFrames(f"{mark.topic} is in {mark.frame!r} and {base.topic} in {base.frame!r}.")
            origin, turned = _steady(base)
            tip, rotation = (tip - origin) @ turned, turned.T @ rotation
        if not (away_mm := float(np.linalg.norm(tip))) <= REACH_MM:
            raise NotMetres(
                f"{mark.topic} is {away_mm:.0f} mm from the arm's remote centre, and no PSM reaches beyond "
                f"{REACH_MM:g} mm; it is another arm's, or in the simulator's units, not metres.",
                topic=mark.topic,
            )
        kind: Kind = "entry" if mark.arm.lower().startswith("entry") else "exit"
        turn = rotation @ first.setdefault(kind, rotation).T
        points.append(Mark(mark.arm, kind, kind == "exit", _xyz(tip), _xyzw(rotation), _xyzw(turn)))
    whose = arm if base is None or arm is not None else base.arm
    return SuturePoints(whose, frame or f"{whose}_base", tuple(points))


def read_scene(file: BinaryIO, *, rate_hz: float | None = None, frame: str | None = None) -> Recording:
    """Read the poses of marks and of arms' bases from an MCAP file, at its beginning.

    Args:
        file: The file.
        rate_hz: Not for an MCAP file; here as `read_recording` has it.
        frame: What `suture_points` is told later; nothing is chosen by it.

    Raises:
        UnreadableRecording: Truncated, corrupt, over the limits of size, or of an encoding that is not read here.
        NoUsableTopic: It has no mark.
        BadSettings: A rate was given.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    if rate_hz is not None:
        raise BadSettings("An MCAP file has stamps of its own; leave rate_hz out.")
    try:
        walker = Walker(file)
        motions = tuple(_motions(walker))
    except (SkillsError, MemoryError):
        raise
    except Exception as error:  # a damaged file makes a parser raise anything
        raise UnreadableRecording(
            f"The MCAP file is truncated or corrupt ({type(error).__name__}: {error}). {RECOVER}"
        ) from error
    if not motions:
        raise NoUsableTopic("The file has no poses of Entry or Exit marks, such as /CRTK/Exit1/measured_cp.")
    return Recording(format="mcap", integrity=walker.integrity, motions=motions)


def parse(file: BinaryIO, answer: BinaryIO, **how: str | float | None) -> None:
    """Read a scene in a process of its own, and write it or its refusal."""
    answered(read_scene, file, answer, **how)


# ---- from the file ----------------------------------------------------------------------------------------------


def _whose(topic: str) -> str | None:
    """Return the mark or the arm that a topic tells the place of; None for any other topic."""
    *_, name, what = ["", *topic.split("/")]
    is_mark = what == "measured_cp" and _MARK.fullmatch(name)
    is_base = what == _BASE and name.lower().startswith("psm")
    return name if is_mark or is_base else None


def _motions(walker: Walker) -> Iterator[Motion]:
    decoders: dict[int, Decoder] = {}
    found: dict[str, list[tuple[np.ndarray, Columns]]] = {}
    for stretch in walker.stretches():
        channel = stretch.channel
        if _whose(channel.topic) is None:
            continue
        if channel.number not in decoders:
            decoders[channel.number] = _decoder(walker, channel)
        columns = decoders[channel.number].decode(stretch.data, stretch.begin, stretch.length)
        found.setdefault(channel.topic, []).append((stretch.log_ns, columns))
    for topic, parts in sorted(found.items()):
        yield _motion(topic, parts)


def _decoder(walker: Walker, channel: Channel) -> Decoder:
    schema = walker.schemas.get(channel.schema)
    encodings = (channel.encoding, None if schema is None else schema.encoding)
    if (
        schema is None
        or schema.name.replace("/msg/", "/") != POSE.replace("/msg/", "/")
        or encodings != ("cdr", "ros2msg")
    ):
        raise UnreadableRecording(
            f"{channel.topic} is not {POSE} as ROS 2 writes it; record it so, or convert the bag.", topic=channel.topic
        )
    return Decoder(channel.topic, fields_of(schema.name, schema.definition.decode()), _WANTED)


def _motion(topic: str, parts: list[tuple[np.ndarray, Columns]]) -> Motion:
    frames = sorted({label for _, columns in parts for label in columns.labels})
    if len(frames) > 1:
        raise MixedFrames(f"{topic} gives poses in {len(frames)} frames; record them apart.", frames=frames[:20])
    order = np.argsort(np.concatenate([log_ns for log_ns, _ in parts]), kind="stable")
    values = np.concatenate([columns.values for _, columns in parts])[order]
    stamps_ns = np.concatenate([columns.stamps_ns for _, columns in parts if columns.stamps_ns is not None])[order]
    with np.errstate(over="ignore"):  # what becomes infinite is refused below
        tip_mm = 1000.0 * values[:, :3]  # the simulator speaks metres
    return recorded_motion(
        arm=_whose(topic) or "",
        topic=topic,
        frame=frames[0],
        stamps_ns=stamps_ns,
        tip_mm=tip_mm,
        rotation_xyzw=values[:, 3:],
    )


# ---- one place --------------------------------------------------------------------------------------------------


def _base_of(scene: Recording, arm: str | None, frame: str | None, seen_in: str) -> Motion | None:
    """Choose the base that the marks are brought to; None where they are said to be in the arm's frame already."""
    bases = [one for one in scene.motions if not _MARK.fullmatch(one.arm)]
    fitting = [one for one in bases if arm is None or one.arm.lower() == arm.lower()]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        named = ", ".join(one.arm for one in fitting)
        raise NoUsableTopic(f"The file has the bases of {named}; name the arm.", arms=[one.arm for one in fitting])
    if frame is None:
        raise NoUsableTopic(
            f"The marks are in the frame {seen_in!r}, and the file does not say where the arm's base is in it; record "
            f"/CRTK/<psm>/{_BASE} too, or, where the marks are in the arm's base frame, name that as the frame."
        )
    return None


def _steady(motion: Motion) -> tuple[Floats, Floats]:
    """Take the middle pose of something that stands still: mm, shape (3,), and its rotation, shape (3, 3).

    Raises:
        MixedFrames: It moved.
    """
    assert motion.rotation_xyzw is not None
    place = np.median(motion.tip_mm, axis=0)
    alike = motion.rotation_xyzw * np.where(motion.rotation_xyzw @ motion.rotation_xyzw[0] < 0, -1.0, 1.0)[:, None]
    middle = matrix_of(np.median(alike, axis=0)[None])
    moved_mm = float(np.linalg.norm(motion.tip_mm - place, axis=1).max())
    turned = angle_between(matrix_of(alike), np.broadcast_to(middle, (len(alike), 3, 3)))
    if not (moved_mm <= STEADY_MM and float(turned.max()) <= STEADY_RAD):
        raise MixedFrames(
            f"{motion.topic} moved by {moved_mm:.1f} mm and {np.degrees(turned.max()):.1f} degrees in the recording; a "
            "plan is for a scene that stands still, so cut the recording.",
            topic=motion.topic,
        )
    return np.asarray(place), middle[0]


def _order(name: str) -> tuple[int, str]:
    """Sort Entry1, Exit1, Entry2 ... by number; entries before exits."""
    found = _MARK.fullmatch(name)
    assert found is not None
    return int(found[2]), found[1].lower()


def _xyz(place: Floats) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def _xyzw(rotation: Floats) -> tuple[float, float, float, float]:
    x, y, z, w = quaternion_of(rotation[None])[0].tolist()
    return x, y, z, w
