"""Reader of JIGSAWS trials (Gao et al., "The JHU-ISI Gesture and Skill Assessment Working Set", M2CAI 2014).

A kinematics file has one row per video frame, 30 per second, with 76 numbers and no header:

    columns 1-19 master left, 20-38 master right, 39-57 instrument right, 58-76 instrument left; for each
    x y z (m), rotation matrix by rows (9), linear velocity (3), angular velocity (3), gripper (rad)

The data set's own description has the instruments the other way round. But in all 79 trials of Knot_Tying and
Needle_Passing the left master moves as columns 58-76 do (correlation of speeds at least 0.99; with columns 39-57 at
most 0.73), and those who labelled the videos call columns 58-76 the left instrument (COMPASS, Hutchinson et al. 2023).
A trial in which the masters move as the other way round is refused.

A public copy has the same numbers as comma-separated text below a line of names, which calls columns 39-57
`SLAVE_LEFT`.

A transcription has one gesture per line, `start end G6`, in frames counted from 1, both inclusive. Motion primitives,
as COMPASS labels them from the videos, stand below the line `Start Stop Motion Primitive`, one or more per line,
`start end Grasp(L, Needle) Release(R, Needle)`, in frames counted from 0, both inclusive; L and R are the instruments
by side in the video, `PSM_left` and `PSM_right` here. COMPASS calls Suturing_B001 `Suturing_S02_T01`. A meta file has
one trial per line: its name, the surgeon's self-reported skill (N, I or E), the global rating score and its six parts.

The data set does not specify the frame of the poses, only that it is the same for both sides; it is called "jigsaws"
here. It is not the base of an arm, so it cannot be determined whether an arm can reach a pose. The instruments are
named `PSM_left` and `PSM_right`, the masters `MTML` and `MTMR`. Velocities are not used. Text has no checksum:
integrity "none".
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from skills.arithmetic import product
from skills.arrays import Floats, Ints
from skills.demonstration.recording import Label, Motion, Recording, Topic, recorded_motion, recorded_signal
from skills.errors import NotAQuaternion, NotFinite, UnreadableRecording
from skills.formats.cells import is_number
from skills.formats.tags import in_time
from skills.kinematics import nearest_quaternions
from skills.scoring.calibration import PARTS

COLUMNS = 76
RATE_HZ = 30.0
FRAME = "jigsaws"
ROWS = 1_000_000  # nine hours; the longest trial has 9,000
GESTURES = 10_000  # of a trial; the longest has 60
ORTHONORMAL = 5e-3  # ours: we measured deviations of 1e-3 in the masters' matrices of the data set
Skill = Literal["novice", "intermediate", "expert"]
SKILLS: dict[str, Skill] = {"N": "novice", "I": "intermediate", "E": "expert"}

_ARMS = {"MTML": 0, "MTMR": 19, "PSM_left": 57, "PSM_right": 38}  # index of the first of the arm's 19 columns
SIDES = 0.1  # ours: correlations of speeds differ by at least 0.27 in 79 trials
_PARTS = (
    *(f"POS_{axis}" for axis in "XYZ"),
    *(f"ROT_R{row}{column}" for row in "123" for column in "123"),
    *(f"{kind}_VEL_{axis}" for kind in ("LIN", "ROT") for axis in "XYZ"),
    "GRIPPER_ANGLE",
)
HEADER = ",".join(
    f"{side}_{part}" for side in ("MASTER_LEFT", "MASTER_RIGHT", "SLAVE_LEFT", "SLAVE_RIGHT") for part in _PARTS
)
_GESTURE = re.compile(r"\s*(\d{1,7})\s+(\d{1,7})\s+(G\d{1,2})\s*")
_PRIMITIVES = re.compile(r"\s*(\d{1,7})\s+(\d{1,7})\s+((?:[A-Z][a-z]+\(\w+, [\w/]+\)\s*)+)")
_TRIAL_OF_COMPASS = re.compile(r"([A-Za-z_]+)_S(0[1-9]|1\d|2[0-6])_T(\d{2})")
_RATING = re.compile(r"[0-9]{1,4}")
_TRIAL = re.compile(r"(?P<task>[A-Za-z_]+)_(?P<user>[A-Z])(?P<number>\d{3})")


@dataclass(frozen=True)
class RatedTrial:
    """The ratings of one trial in a meta file.

    Attributes:
        trial: Its name, such as "Suturing_B001".
        skill: "novice", "intermediate" or "expert", as reported by the surgeon.
        score: The global rating score, 6 to 30: the sum of the parts.
        parts: One to five for each of `PARTS`.
    """

    trial: str
    skill: Skill
    score: int
    parts: tuple[int, ...]


@dataclass(frozen=True)
class Trial:
    """The files of one trial in a JIGSAWS folder.

    Attributes:
        name: Such as "Suturing_B001".
        task: Such as "Suturing".
        user: The letter of the surgeon.
        number: The number of the repetition.
        kinematics: The file with its motion.
        meta: The file with the ratings of its task, which may be missing.
        transcription: The file with its gestures, None where there is none.
        primitives: The file with its motion primitives, None likewise.
        rated: Its ratings in the task's meta file, None where there are none.
    """

    name: str
    task: str
    user: str
    number: int
    kinematics: Path
    meta: Path
    transcription: Path | None
    primitives: Path | None
    rated: RatedTrial | None


def looks_like_kinematics(first_line: str) -> bool:
    """Return whether a text with this first line may be kinematics."""
    return first_line.strip() == HEADER or ("," not in first_line and len(first_line.split()) == COLUMNS)


def read_jigsaws(file: BinaryIO, *labels: str, rated: RatedTrial | None = None) -> Recording:
    """Read a trial.

    Args:
        file: The kinematics, at their beginning.
        *labels: The texts of its transcription and of its motion primitives.
        rated: Its ratings, which are stored in the notes.

    Returns:
        The recording, in millimetres, in the frame "jigsaws".

    Raises:
        UnreadableRecording: A row without 76 numbers, a gesture or primitive outside the trial, or instruments that are
            exchanged.
        NotFinite: NaN or infinity.
        NotAQuaternion: A matrix that is not a rotation.
        NotMetres: As in `skills.demonstration.recording`.
    """
    table = _table(file)
    stamps_ns = np.rint(np.arange(len(table)) * (1e9 / RATE_HZ)).astype(np.int64)
    motions = {arm: _motion(arm, table, stamps_ns, first) for arm, first in _ARMS.items()}
    _check_sides(table)
    grippers = {arm: recorded_signal(stamps_ns, table[:, first + 18], _columns(first)) for arm, first in _ARMS.items()}
    return Recording(
        format="jigsaws",
        integrity="none",
        motions=tuple(motion for arm, motion in motions.items() if arm.startswith("PSM")),
        masters=tuple(motion for arm, motion in motions.items() if arm.startswith("MTM")),
        jaws=tuple((arm, signal) for arm, signal in grippers.items() if arm.startswith("PSM")),
        grippers=tuple((arm, signal) for arm, signal in grippers.items() if arm.startswith("MTM")),
        topics=tuple(Topic(_columns(first), "jigsaws", len(table)) for first in sorted(_ARMS.values())),
        labels=in_time(label for text in labels for label in _labels(text, stamps_ns)),
        notes=() if rated is None else _notes(rated),
    )


def read_meta(text: str) -> dict[str, RatedTrial]:
    """Parse a meta file and return the ratings by trial; lines in another form are skipped."""
    rated = {}
    for line in text.splitlines():
        cells = line.split()
        if len(cells) == 3 + len(PARTS) and cells[1] in SKILLS and all(_RATING.fullmatch(cell) for cell in cells[2:]):
            score, *parts = map(int, cells[2:])
            rated[cells[0]] = RatedTrial(cells[0], SKILLS[cells[1]], score, tuple(parts))
    return rated


def meta_line(rated: RatedTrial) -> str:
    """Return the line of a meta file that `read_meta` parses into these ratings."""
    letter = next(letter for letter, skill in SKILLS.items() if skill == rated.skill)
    return "\t".join([rated.trial, "", letter, str(rated.score), "", *(str(part) for part in rated.parts)]) + "\r\n"


def is_transcription(text: str) -> bool:
    """Return whether a text starts with a line of a transcription."""
    return _GESTURE.fullmatch(text.lstrip().split("\n", 1)[0]) is not None


def is_primitives(text: str) -> bool:
    """Return whether a text starts with the first line of motion primitives."""
    return text.split("\n", 1)[0].split() == ["Start", "Stop", "Motion", "Primitive"]


def trials(folder: Path, primitives: Path | None = None) -> Iterator[Trial]:
    """Yield the trials in a folder of the data set, or of one of its tasks, sorted by path.

    A trial of the comma-separated copy is omitted where the folder has it in the data set's own form too.

    Args:
        folder: The folder.
        primitives: A folder with motion primitives, at any depth; by default they are in folders of `folder` that are
            named `motion_primitives`, with any ending but those of COMPASS for a single hand, `_L` and `_R`.
    """
    labelled = _primitives_in(primitives or folder, "**/*.txt" if primitives else "motion_primitives*/**/*.txt")
    found = sorted(folder.rglob("kinematics/AllGestures/*.txt"))
    names = {path.stem for path in found}
    found += sorted(path for path in folder.rglob("processed/*/*.csv") if path.stem not in names)
    for kinematics in found:
        if (named := _TRIAL.fullmatch(kinematics.stem)) is None:
            continue
        home, task = kinematics.parents[2], named["task"]
        places = (home / f"meta_file_{task}.txt", home / "trial_results" / f"meta_file_{task}.txt")
        meta = next((place for place in places if place.is_file()), places[0])
        transcription = home / "transcriptions" / f"{kinematics.stem}.txt"
        rated = read_meta(meta.read_text(errors="replace")) if meta.is_file() else {}
        yield Trial(
            name=kinematics.stem,
            task=task,
            user=named["user"],
            number=int(named["number"]),
            kinematics=kinematics,
            meta=meta,
            transcription=transcription if transcription.is_file() else None,
            primitives=labelled.get(kinematics.stem),
            rated=rated.get(kinematics.stem),
        )


def _primitives_in(folder: Path, pattern: str) -> dict[str, Path]:
    """Return the files of motion primitives by the names that JIGSAWS gives to their trials."""
    found = {}
    for path in sorted(folder.rglob(pattern)):
        if not path.parent.name.endswith(("_L", "_R")) and is_primitives(path.read_text(errors="replace")):
            of = _TRIAL_OF_COMPASS.fullmatch(path.stem)
            found[f"{of[1]}_{chr(ord('A') + int(of[2]) - 1)}{int(of[3]):03}" if of else path.stem] = path
    return found


def _table(file: BinaryIO) -> Floats:
    """Return the numbers, shape (T, 76)."""
    first = file.readline().decode("utf-8", "replace")
    file.seek(0)
    if not first:
        raise UnreadableRecording("The kinematics file is empty.")
    comma, heads = (",", 1) if first.strip() == HEADER else (None, 0)
    try:
        table = np.loadtxt(
            file, comments=None, delimiter=comma, skiprows=heads, ndmin=2, max_rows=ROWS + 1, encoding="utf-8"
        )
    except (ValueError, UnicodeDecodeError) as error:
        where = _wrong_row(file, comma, heads)
        raise UnreadableRecording(f"{where} JIGSAWS kinematics have {COLUMNS} numbers per row.") from error
    if table.shape[1:] != (COLUMNS,) or len(table) > ROWS:
        raise UnreadableRecording(
            f"The table has {table.shape[1]} columns and {len(table)} rows; JIGSAWS kinematics have {COLUMNS} columns "
            f"and at most {ROWS} rows."
        )
    wrong = ~np.isfinite(table)
    if wrong.any():
        row, column = (int(index) + 1 for index in np.argwhere(wrong)[0])
        raise NotFinite(f"Row {row}, column {column}: NaN or infinity; cut the row.", row=row, column=column)
    return table


def _check_sides(table: Floats) -> None:
    """Refuse a trial whose masters move as the instruments of the other side do.

    Raises:
        UnreadableRecording: The speeds of a master and the instrument of the other side agree better than with its own.
    """
    speeds = {arm: np.linalg.norm(np.diff(table[:, first : first + 3], axis=0), axis=1) for arm, first in _ARMS.items()}
    for master, own, other in (("MTML", "PSM_left", "PSM_right"), ("MTMR", "PSM_right", "PSM_left")):
        if all(np.ptp(speeds[arm]) > 0 for arm in (master, own, other)):  # no correlation with one that stands still
            with_own, with_other = (float(np.corrcoef(speeds[master], speeds[arm])[0, 1]) for arm in (own, other))
            if not with_other <= with_own + SIDES:
                raise UnreadableRecording(
                    f"{master} moves as {_columns(_ARMS[other])} do (correlation of speeds {with_other:.2f}), not as "
                    f"{_columns(_ARMS[own])} ({with_own:.2f}), which it drives in JIGSAWS: check the order of columns.",
                    correlation=with_other,
                )


def _wrong_row(file: BinaryIO, comma: str | None, heads: int) -> str:
    """Return a description of the first invalid row, with its position."""
    file.seek(0)
    for number, line in enumerate(file, start=1):
        cells = line.strip().split(comma.encode() if comma else None) if number > heads else []
        if cells and len(cells) != COLUMNS:
            return f"Row {number} has {len(cells)} cells."
        for column, cell in enumerate(cells, start=1):
            if not is_number(cell.decode("ascii", "replace")):
                return f"Row {number}, column {column}: not a number."
    return "The text cannot be read."


def _motion(arm: str, table: Floats, stamps_ns: Ints, first: int) -> Motion:
    return recorded_motion(
        arm=arm,
        topic=_columns(first),
        frame=FRAME,
        stamps_ns=stamps_ns,
        tip_mm=1000.0 * table[:, first : first + 3],  # the data set is in metres
        rotation_xyzw=_quaternions(arm, table[:, first + 3 : first + 12].reshape(-1, 3, 3)),
    )


def _quaternions(arm: str, matrices: Floats) -> Floats:
    """Convert rotation matrices to unit quaternions x, y, z, w with continuous signs.

    Args:
        arm: For error messages.
        matrices: Shape (T, 3, 3).

    Returns:
        Shape (T, 4).

    Raises:
        NotAQuaternion: A matrix deviates from orthonormality by more than `ORTHONORMAL`, or is a reflection.
    """
    off = np.abs(product(matrices, matrices.transpose(0, 2, 1)) - np.eye(3)).max(axis=(1, 2))
    wrong = (off > ORTHONORMAL) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        raise NotAQuaternion(
            f"Row {row}: the matrix of {arm} is not a rotation: its deviation is {off[row - 1]:.2g}; at most "
            f"{ORTHONORMAL} is accepted as rounding. Check that the columns are in the order of JIGSAWS.",
            row=row,
            off=float(off[row - 1]),
        )
    return nearest_quaternions(matrices)


def _labels(text: str, stamps_ns: Ints) -> Iterator[Label]:
    """Yield the gestures of a transcription, or motion primitives."""
    kind: Literal["primitive", "gesture"] = "primitive" if is_primitives(text) else "gesture"
    form, first, example = (_PRIMITIVES, 0, "Grasp(L, Needle)") if kind == "primitive" else (_GESTURE, 1, "G6")
    lines = text.splitlines()
    if len(lines) > GESTURES:
        raise UnreadableRecording(f"The {kind}s of the trial have more than {GESTURES} lines.")
    for number, line in enumerate(lines, start=1):
        if not line.strip() or is_primitives(line):
            continue
        found = form.fullmatch(line)
        start, end = (int(found[1]) - first, int(found[2]) - first) if found else (-1, -1)
        if found is None or not 0 <= start <= end < len(stamps_ns):
            raise UnreadableRecording(
                f"Line {number} of the {kind}s is not one of this trial; `start end {example}` is expected, in frames "
                f"from {first} to {len(stamps_ns) - 1 + first}."
            )
        for name in re.split(r"(?<=\))\s+", found[3].strip()):
            yield Label(name, kind, int(stamps_ns[start]), int(stamps_ns[end]))


def _notes(rated: RatedTrial) -> tuple[tuple[str, str], ...]:
    parts = zip(PARTS, rated.parts, strict=True)
    about = [("trial", rated.trial), ("skill", rated.skill), ("global rating score", str(rated.score))]
    return (*about, *((name, str(value)) for name, value in parts))


def _columns(first: int) -> str:
    return f"columns {first + 1}-{first + 19}"
