"""Loading of recordings into a service: the sample surgeons, and folders of the JIGSAWS data set; and its evaluation.

A JIGSAWS folder is sent trial by trial: a recording each, its surgeon, and the hand-offs proposed in it. The data set
is available on request from its authors and is not part of this project. Sending it again changes nothing, because a
recording is identified by its bytes and a demonstration by its part of the recording. An error is recorded for its
trial, and the others continue.

`evaluate_hand_offs` reads such a folder without a service, and compares the proposed hand-offs with the transcribed,
and the proposed transfers of a needle or a thread with the changes of hands in its motion primitives.
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
from skills.demonstration.partner import closed_jaw, find_transfers
from skills.demonstration.recording import Recording as Recorded
from skills.demonstration.recording import base_frames
from skills.demonstration.segments import Segment, propose_by_arm
from skills.errors import BadInput, BadRecording, SkillsError
from skills.formats.archive import pack
from skills.formats.jigsaws import RATE_HZ, Skill, Trial, meta_line, read_jigsaws, trials
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


NOT_FOUND, IN_ONE_CELL = "not-found", "never-leaves-goal"


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
        left_out: Those that cannot become one because their path fits into one cell, as text.
        problems: The errors, as text.
    """

    trial: str
    surgeon: str
    skill_level: Skill | None
    score: int | None
    recording: str | None = None
    proposed: int = 0
    demos: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def find_trials(folder: Path, tasks: Sequence[str] = (), primitives: Path | None = None) -> list[Trial]:
    """Return the trials in a folder, of all tasks or of some.

    Args:
        folder: The folder.
        tasks: Names of tasks; all if there are none.
        primitives: A folder with motion primitives, if they are not in `folder`.

    Raises:
        BadInput: There are none.
    """
    there = list(trials(folder, primitives))
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
            refused = sent.left_out if error.kind == IN_ONE_CELL else sent.problems
            refused.append(f"{part.arm} {part.start_s:.1f} to {part.end_s:.1f} s: {worded(error)}")


@contextmanager
def _packed(trial: Trial) -> Iterator[Path]:
    """Yield the file to send: the kinematics, zipped with its labels and rating if there are any."""
    if trial.transcription is None and trial.primitives is None and trial.rated is None:
        yield trial.kinematics
        return
    with TemporaryDirectory() as folder, trial.kinematics.open("rb") as kinematics:
        members: dict[str, IO[bytes]] = {f"{trial.name}.txt": kinematics}
        for name, path in (("transcriptions", trial.transcription), ("motion_primitives", trial.primitives)):
            if path is not None:
                members[f"{name}/{trial.name}.txt"] = io.BytesIO(path.read_bytes())
        if trial.rated is not None:
            members["meta_file.txt"] = io.BytesIO(meta_line(trial.rated).encode())
        path = Path(folder) / "trial.zip"
        with path.open("wb") as out:
            pack(members, out)
        yield path


@dataclass(frozen=True)
class Evaluated:
    """Proposals of one task, compared with one kind of labels, which they do not see.

    Attributes:
        task: Name of the task.
        proposals: "hand-offs"; "transfers" of what is held, at the moment at which it leaves the giver; or
            "a jaw opens", their rival, by which every release gives to the other hand.
        labels: "transcription" or "motion primitives"; None if no trial of the task has any.
        trials: Number of trials with these labels, or of all that were read if there are none.
        left_out: Number of trials that cannot be read, such as empty files.
        proposed: Number of proposals, of both hands, in these trials.
        labelled: Number of labelled hand-offs or changes of hands; None likewise.
        precision: Share of the proposals that are labelled; None likewise, or without a proposal.
        recall: Share of the labelled that are proposed; None likewise.
        error_s: Mean distance of a matched transfer from the end of the labelled release; None of hand-offs.
        brier: Mean squared difference between a proposal's confidence and 1 if labelled, else 0; None likewise.
    """

    task: str
    proposals: str
    labels: str | None
    trials: int
    left_out: int
    proposed: int
    labelled: int | None
    precision: float | None
    recall: float | None
    error_s: float | None
    brier: float | None


HAND_OFFS, TRANSFERS, OPENINGS, UNKNOWN = "hand-offs", "transfers", "a jaw opens", ""
LABELS = {HAND_OFFS: "transcription", TRANSFERS: "motion primitives", OPENINGS: "motion primitives"}
COUNTS = ("proposed", "labelled", "matched")
NO_LABELS = "no trial has a transcription or motion primitives (--primitives), so there is nothing to compare with."
HELD = re.compile(r"((?:Grasp|Release)\([LR]), (Needle|Thread)\)")
WITHIN_S = 1.0  # between a transfer and the end of the labelled release that are the same
SHARED = 0.5  # of the shorter of a label and a proposal that are the same hand-off


@dataclass(frozen=True)
class HandChange:
    """The moment at which something leaves a hand for the other, and the confidence of a proposal."""

    giver: str
    at_s: float
    confidence: float | None = None


@dataclass(frozen=True)
class Agreement:
    """Proposals of a recording compared with its labels, which were not shown to the proposals.

    Attributes:
        proposed: Number of proposals, of all arms.
        labelled: Number of labelled hand-offs.
        matched: Number of pairs of one proposal and one label that share `SHARED` of the shorter, of one arm.
        confident: Confidence of each proposal, and whether it was matched; without those that have none.
        errors_s: Of each pair of moments, that of the proposal after that of the label.
    """

    proposed: int
    labelled: int
    matched: int
    confident: tuple[tuple[float, bool], ...]
    errors_s: tuple[float, ...] = ()


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
    """Compare proposals with labels, task by task and kind by kind.

    Args:
        found: The trials, from `find_trials`.
    """
    by_task: dict[str, list[dict[str, Agreement] | None]] = {}
    for trial in found:
        by_task.setdefault(trial.task, []).append(_agreements(trial))
    return [one for task, rows in by_task.items() for one in _evaluated(task, rows)]


def _agreements(trial: Trial) -> dict[str, Agreement] | None:
    """Compare one trial with each kind of labels that it has; None if it cannot be read."""
    files = trial.transcription, trial.primitives
    texts = ["" if path is None else path.read_text(errors="replace") for path in files]
    try:
        with trial.kinematics.open("rb") as file:
            recording = read_jigsaws(file, *texts)
    except BadRecording:
        return None
    found = transfer_agreements(recording) if trial.primitives else {}
    kind = HAND_OFFS if trial.transcription else UNKNOWN
    return found if trial.primitives and not trial.transcription else found | {kind: agreement(recording)}


def transfer_agreements(recording: Recorded) -> dict[str, Agreement]:
    """Compare transfers, and the openings of a jaw, with the changes of hands in the motion primitives.

    Args:
        recording: A recording with motion primitives; what is proposed after the last of them is not counted.
    """
    closed = {arm: closed_jaw(recording, arm) or [] for arm in recording.arms}
    transfers = find_transfers(recording, closed, base_frames(recording))
    proposed = {
        TRANSFERS: [HandChange(one.giver, one.freed_s, one.confidence) for one in transfers],
        OPENINGS: [HandChange(arm, span[1]) for arm, spans in closed.items() for span in spans],
    }
    last_ns = max((one.end_ns for one in recording.labels if one.kind == "primitive"), default=recording.origin_ns)
    last_s = (last_ns - recording.origin_ns) / 1e9 + WITHIN_S
    return {kind: _matched(some, hand_changes(recording), last_s) for kind, some in proposed.items()}


def hand_changes(recording: Recorded) -> list[HandChange]:
    """Return the changes of hands in the motion primitives: who lets go of the needle or the thread, and when.

    It changes hands where one hand grasps it and the other releases it, without another grasp or release of it between,
    and not both at once. The release ends with the sample after its last frame.
    """
    seen: dict[str, dict[int, set[str]]] = {}
    for one in recording.labels:
        if one.kind == "primitive" and (found := HELD.fullmatch(one.name)):
            seen.setdefault(found[2], {}).setdefault(one.end_ns, set()).add(found[1])
    changes = []
    for moments in seen.values():
        before: set[str] = set()
        for end_ns, now in sorted(moments.items()):
            for giver, grasp, release in (("PSM_left", "Grasp(R", "Release(L"), ("PSM_right", "Grasp(L", "Release(R")):
                if now == {grasp, release} or (now == {release} and before == {grasp}):
                    changes.append(HandChange(giver, (end_ns - recording.origin_ns) / 1e9 + 1.0 / RATE_HZ))
            before = now
    return changes


def _matched(proposed: Sequence[HandChange], labelled: Sequence[HandChange], last_s: float) -> Agreement:
    """Pair moments of one giver that are within `WITHIN_S`, the nearest first, each once."""
    proposed = [one for one in proposed if one.at_s <= last_s]
    near = sorted((abs(a.at_s - b.at_s), k, n) for k, a in enumerate(proposed) for n, b in enumerate(labelled))
    pairs: dict[int, int] = {}
    for apart_s, k, n in near:
        if (
            apart_s <= WITHIN_S
            and proposed[k].giver == labelled[n].giver
            and k not in pairs
            and n not in pairs.values()
        ):
            pairs[k] = n
    confident = tuple((one.confidence, k in pairs) for k, one in enumerate(proposed) if one.confidence is not None)
    errors_s = tuple(proposed[k].at_s - labelled[n].at_s for k, n in pairs.items())
    return Agreement(len(proposed), len(labelled), len(pairs), confident, errors_s)


def _evaluated(task: str, rows: Sequence[dict[str, Agreement] | None]) -> Iterator[Evaluated]:
    read = [one for one in rows if one is not None]
    for kind in [one for one in LABELS if any(one in trial for trial in read)] or [UNKNOWN]:
        both = [trial[kind] for trial in read if kind in trial]
        count, labelled, matched = (sum(getattr(one, name) for one in both) for name in COUNTS)
        missed = [(said - is_matched) ** 2 for one in both for said, is_matched in one.confident if kind]
        errors_s = [abs(error_s) for one in both for error_s in one.errors_s]
        yield Evaluated(
            task=task,
            proposals=kind or HAND_OFFS,
            labels=LABELS.get(kind),
            trials=len(both),
            left_out=len(rows) - len(read),
            proposed=count,
            labelled=labelled if kind else None,
            precision=_ratio(matched, count if kind else 0),
            recall=_ratio(matched, labelled),
            error_s=_ratio(sum(errors_s), len(errors_s)),
            brier=_ratio(sum(missed), len(missed)),
        )


def _ratio(part: float, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None
