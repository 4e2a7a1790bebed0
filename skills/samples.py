"""Loading of recordings into a service: the sample surgeons, and folders of the JIGSAWS data set; and its evaluation.

A JIGSAWS folder is sent trial by trial: a recording each, its surgeon, and the hand-offs proposed in it. The data set
is available on request from its authors and is not part of this project. Sending it again changes nothing, because a
recording is identified by its bytes and a demonstration by its part of the recording. An error is recorded for its
trial, and the others continue.

`evaluate_hand_offs` reads such a folder without a service, and compares the proposed hand-offs with the transcribed.
"""

import io
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from skills.client import Client, Problem
from skills.demonstration.recording import Recording as Recorded
from skills.demonstration.segments import Segment, propose_by_arm
from skills.errors import BadInput, BadRecording, SkillsError
from skills.formats.archive import pack
from skills.formats.jigsaws import Skill, Trial, meta_line, read_jigsaws, trials
from skills.remedies import did_you_mean
from skills.schemas.demos import Demonstration
from skills.schemas.recordings import Recording
from skills.seeds.recordings import sample_recordings


@contextmanager
def going_on(errors: list[str] | None, at: str) -> Iterator[None]:
    """Add an error of the block to a list, and go on after the block; without a list it is raised."""
    try:
        yield
    except SkillsError as error:
        if errors is None:
            raise
        errors.append(f"{at}: {error}")


def load_samples(client: Client, errors: list[str] | None = None) -> Iterator[Demonstration]:
    """Store the synthetic surgeons and every hand-off that the service proposes in their recordings.

    Args:
        client: The service.
        errors: Gets the errors, and the other samples are stored all the same; without it the first error is raised.
    """
    text = (resources.files("skills") / "seeds" / "surgeons.toml").read_text()
    for surgeon in tomllib.loads(text)["surgeon"]:
        with going_on(errors, surgeon["slug"]):
            client.put_surgeon(surgeon["slug"], skill_level=surgeon["skill_level"], handedness=surgeon["handedness"])
    for sample in sample_recordings():
        style = f"{sample.surgeon}, {sample.suture}"
        with going_on(errors, style):
            stored = client.add_recording(sample.data)
            for part in stored.segments:
                with going_on(errors, style):
                    yield client.cut_demo(
                        stored.sha256,
                        surgeon=sample.surgeon,
                        suture=sample.suture,
                        arm=part.arm,
                        start_s=part.start_s,
                        end_s=part.end_s,
                    )


def write_samples(folder: Path) -> list[tuple[Path, str]]:
    """Write the recordings of the synthetic surgeons as MCAP files; return each file and its surgeon."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for sample in sample_recordings():
        file = folder / f"{sample.name}.mcap"
        file.write_bytes(sample.data)
        written.append((file, sample.surgeon))
    return written


NOT_FOUND = "not-found"


@dataclass
class Sent:
    """The outcome of sending one trial.

    Attributes:
        trial: Its name.
        surgeon: The surgeon's pseudonym.
        skill_level: As the surgeon stated; None if the meta file has none.
        score: The global rating score, 6 to 30; None likewise.
        recording: The recording's digest; None if it was refused.
        proposed: The number of hand-offs that the service proposed, of the requested arm.
        demos: The digests of those that became demonstrations.
        problems: The errors, as text.
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
    """Return the trials in a folder, of all tasks or of some.

    Raises:
        BadInput: There are none.
    """
    there = list(trials(folder))
    found = [trial for trial in there if not tasks or trial.task in tasks]
    if there and not found:
        here = sorted({trial.task for trial in there})
        near = [one for task in tasks for one in did_you_mean(task, here)]
        raise BadInput(f"{folder} has trials of {', '.join(here)}, not of {', '.join(tasks)}.", *near)
    if not found:
        raise BadInput(
            f"{folder} has no trials of JIGSAWS; they are expected as TASK/kinematics/AllGestures/TASK_B001.txt."
        )
    return found


def send_trials(
    client: Client,
    found: Sequence[Trial],
    *,
    suture: str | None = None,
    arm: str | None = None,
    prefix: str = "jigsaws",
    worded: Callable[[SkillsError], str] = str,
) -> Iterator[Sent]:
    """Send trials one after the other, each with its surgeon.

    Args:
        client: The service.
        found: The trials, from `find_trials`.
        suture: The suture type of the demonstrations; None stores recordings only.
        arm: The arm of the hand-offs, "PSM_left" or "PSM_right"; None: both.
        prefix: Prefix of pseudonyms, before the surgeon's letter.
        worded: Words an error for `Sent.problems`; in those of Python by default.

    Raises:
        Problem: There is no such suture type; nothing was sent.
    """
    if suture is not None:
        client.suture_type(suture)
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
            # once for each surgeon, not for each trial
            if sent.surgeon not in known:
                make_known(client, sent.surgeon, sent.skill_level)
                known.add(sent.surgeon)
            with _packed(trial) as file:
                stored = client.add_recording(file, surgeon=sent.surgeon)
            sent.recording = stored.sha256
            _cut(client, stored, sent, suture, arm, worded)
        except SkillsError as error:
            # a refused trial does not stop the others
            sent.problems.append(worded(error))
        yield sent


def make_known(client: Client, surgeon: str, skill_level: Skill | None = None) -> None:
    """Create a surgeon, unless the surgeon exists."""
    try:
        client.surgeon(surgeon)
    except Problem as problem:
        if problem.kind != NOT_FOUND:
            raise
        client.put_surgeon(surgeon, skill_level=skill_level)


def _cut(
    client: Client,
    stored: Recording,
    sent: Sent,
    suture: str | None,
    arm: str | None,
    worded: Callable[[SkillsError], str],
) -> None:
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
            sent.problems.append(f"{part.arm} {part.start_s:.1f} to {part.end_s:.1f} s: {worded(error)}")


@contextmanager
def _packed(trial: Trial) -> Iterator[Path]:
    """Yield the file to send: the kinematics, zipped with its gestures and rating if there are any."""
    if trial.transcription is None and trial.rated is None:
        yield trial.kinematics
        return
    with TemporaryDirectory() as folder, trial.kinematics.open("rb") as kinematics:
        members: dict[str, IO[bytes]] = {f"{trial.name}.txt": kinematics}
        if trial.transcription is not None:
            members[f"transcriptions/{trial.name}.txt"] = io.BytesIO(trial.transcription.read_bytes())
        if trial.rated is not None:
            members["meta_file.txt"] = io.BytesIO(meta_line(trial.rated).encode())
        path = Path(folder) / "trial.zip"
        with path.open("wb") as out:
            pack(members, out)
        yield path


@dataclass(frozen=True)
class Evaluated:
    """The proposed hand-offs of one task, compared with the transcribed ones.

    Attributes:
        task: Name of the task.
        trials: Number of trials that were read.
        left_out: Number of trials that cannot be read, such as empty files.
        proposed: Number of proposals, of both hands; the transcriptions were not used.
        transcribed: Number of hand-offs in the transcriptions; None if no trial has one.
        precision: Share of the proposals that are transcribed; None likewise, or without a proposal.
        recall: Share of the transcribed hand-offs that are proposed; None likewise.
        brier: Mean squared difference between a proposal's confidence and 1 if transcribed, else 0; None likewise.
    """

    task: str
    trials: int
    left_out: int
    proposed: int
    transcribed: int | None
    precision: float | None
    recall: float | None
    brier: float | None

    @property
    def a_trial(self) -> float:
        """Proposals per trial."""
        return self.proposed / max(self.trials, 1)


SHARED = 0.5  # of the shorter of a label and a proposal that are the same hand-off


@dataclass(frozen=True)
class Agreement:
    """Proposals of a recording compared with its labels, which were not shown to the proposals.

    Attributes:
        proposed: Number of proposals, of all arms.
        labelled: Number of labelled hand-offs.
        matched: Number of pairs of one proposal and one label that share `SHARED` of the shorter, of one arm.
        confident: Confidence of each proposal, and whether it was matched; without those that have none.
    """

    proposed: int
    labelled: int
    matched: int
    confident: tuple[tuple[float, bool], ...]


def agreement(recording: Recorded) -> Agreement:
    """Compare the proposals that are made without labels with the labelled hand-offs.

    Args:
        recording: A recording; without labels, none of its proposals is matched.
    """
    labelled = [one for one in propose_by_arm(recording) if one.found_by in ("stage", "gesture")]
    proposed = propose_by_arm(replace(recording, labels=()))
    left, matched = list(labelled), []
    for one in proposed:
        same = next((label for label in left if label.arm == one.arm and _shared(label, one) >= SHARED), None)
        matched.append(same is not None)
        if same is not None:
            left.remove(same)
    pairs = zip(proposed, matched, strict=True)
    confident = tuple((one.confidence, is_matched) for one, is_matched in pairs if one.confidence is not None)
    return Agreement(len(proposed), len(labelled), sum(matched), confident)


def _shared(one: Segment, other: Segment) -> float:
    """Return the common time of two segments as a share of the shorter one."""
    common_s = min(one.end_s, other.end_s) - max(one.start_s, other.start_s)
    return common_s / max(min(one.end_s - one.start_s, other.end_s - other.start_s), 1e-9)


def evaluate_hand_offs(found: Iterable[Trial]) -> list[Evaluated]:
    """Compare proposed with transcribed hand-offs, task by task; precision and recall only of trials with both.

    Args:
        found: The trials, from `find_trials`.
    """
    by_task: dict[str, list[tuple[bool, Agreement | None]]] = {}
    for trial in found:
        by_task.setdefault(trial.task, []).append((trial.transcription is not None, _agreement(trial)))
    return [_evaluated(task, rows) for task, rows in by_task.items()]


def _agreement(trial: Trial) -> Agreement | None:
    """Compare one trial; None if it cannot be read."""
    try:
        with trial.kinematics.open("rb") as file:
            transcription = "" if trial.transcription is None else trial.transcription.read_text(errors="replace")
            return agreement(read_jigsaws(file, transcription))
    except BadRecording:
        return None


def _evaluated(task: str, rows: Sequence[tuple[bool, Agreement | None]]) -> Evaluated:
    read = [one for _, one in rows if one is not None]
    both = [one for has_labels, one in rows if one is not None and has_labels]
    proposed, labelled, matched = (
        sum(getattr(one, name) for one in both) for name in ("proposed", "labelled", "matched")
    )
    missed = [(confidence - is_matched) ** 2 for one in both for confidence, is_matched in one.confident]
    return Evaluated(
        task=task,
        trials=len(read),
        left_out=len(rows) - len(read),
        proposed=sum(one.proposed for one in read),
        transcribed=labelled if both else None,
        precision=matched / proposed if proposed else None,
        recall=matched / labelled if labelled else None,
        brier=sum(missed) / len(missed) if missed else None,
    )
