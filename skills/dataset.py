"""Send a whole folder of JIGSAWS: every trial as a recording, its surgeons, and the hand-offs proposed in it.

The data set is had by request from its authors and is not part of this project. Running it again changes nothing: a
recording is known by its bytes, a demonstration by what it is cut from. What is refused is told trial by trial, and the
rest goes on.
"""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from skills.api.schemas.given import Recording
from skills.client import Client, Problem
from skills.errors import BadInput, SkillsError
from skills.recordings.archive import pack
from skills.recordings.jigsaws import Skill, Trial, meta_line, trials

NOT_FOUND = "not-found"


@dataclass
class Sent:
    """What became of one trial.

    Attributes:
        trial: Its name.
        surgeon: The pseudonym of who did it.
        skill_level: As the surgeon said; None where the meta file says nothing.
        score: The global rating score, 6 to 30; None as well.
        recording: Its digest, None where it was refused.
        proposed: How many hand-offs the service proposed in it, of the arm asked for.
        demos: The digests of those that became demonstrations.
        problems: What was refused, in words.
    """

    trial: str
    surgeon: str
    skill_level: Skill | None
    score: int | None
    recording: str | None = None
    proposed: int = 0
    demos: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def find_trials(folder: Path, tasks: Sequence[str] = ()) -> list[Trial]:
    """Find the trials of a folder, of all tasks or of some.

    Raises:
        BadInput: There are none.
    """
    found = [trial for trial in trials(folder) if not tasks or trial.task in tasks]
    if not found:
        raise BadInput(
            f"{folder} has no trials of JIGSAWS{' in ' + ', '.join(tasks) if tasks else ''}; they are expected as "
            "TASK/kinematics/AllGestures/TASK_B001.txt."
        )
    return found


def send_trials(
    client: Client,
    found: Sequence[Trial],
    *,
    suture: str | None = None,
    arm: str | None = None,
    prefix: str = "jigsaws",
) -> Iterator[Sent]:
    """Send trials one after the other, each with its surgeon.

    Args:
        client: Where to.
        found: What `find_trials` found.
        suture: The suture type of the demonstrations; None stores recordings only.
        arm: Of which arm hand-offs are taken, "PSM_left" or "PSM_right"; None of both.
        prefix: Before the letter of a surgeon, in their pseudonym.
    """
    known: set[str] = set()
    for trial in found:
        rated = trial.rated
        sent = Sent(
            trial=trial.name,
            surgeon=f"{prefix}-{trial.user.lower()}",
            skill_level=None if rated is None else rated.skill,
            score=None if rated is None else rated.score,
        )
        try:
            if sent.surgeon not in known:
                _make_known(client, sent.surgeon, sent.skill_level)
                known.add(sent.surgeon)
            with _packed(trial) as file:
                stored = client.add_recording(file)
            sent.recording = stored.sha256
            _cut(client, stored, sent, suture, arm)
        except SkillsError as error:
            sent.problems.append(str(error))
        yield sent


def _make_known(client: Client, surgeon: str, skill_level: Skill | None) -> None:
    """Write a surgeon who is not there yet; one who is stays as they are."""
    try:
        client.surgeon(surgeon)
    except Problem as problem:
        if problem.kind != NOT_FOUND:
            raise
        client.put_surgeon(surgeon, skill_level=skill_level)


def _cut(client: Client, stored: Recording, sent: Sent, suture: str | None, arm: str | None) -> None:
    proposed = [part for part in stored.segments if arm in (None, part.arm)]
    sent.proposed = len(proposed)
    for part in proposed if suture else ():
        session = re.sub(r"[^a-z0-9_-]", "-", sent.trial.lower())
        try:
            demo = client.cut_demo(
                stored.sha256,
                surgeon=sent.surgeon,
                suture=str(suture),
                arm=part.arm,
                start_s=part.start_s,
                end_s=part.end_s,
                session=session,
            )
            sent.demos.append(demo.id)
        except SkillsError as error:
            sent.problems.append(f"{part.arm} {part.start_s:.1f} to {part.end_s:.1f} s: {error}")


@contextmanager
def _packed(trial: Trial) -> Iterator[Path]:
    """Give the file to send: the kinematics, zipped with their gestures and rating where there are any."""
    if trial.transcription is None and trial.rated is None:
        yield trial.kinematics
        return
    with TemporaryDirectory() as folder, trial.kinematics.open("rb") as kinematics:
        members: dict[str, IO[bytes]] = {trial.kinematics.name: kinematics}
        if trial.transcription is not None:
            members[f"transcriptions/{trial.kinematics.name}"] = io.BytesIO(trial.transcription.read_bytes())
        if trial.rated is not None:
            members["meta_file.txt"] = io.BytesIO(meta_line(trial.rated).encode())
        path = Path(folder) / "trial.zip"
        with path.open("wb") as out:
            pack(members, out)
        yield path
