"""Certificates computed again and policies learnt again, to be compared with the stored ones.

    PolicyVersion --compute_again--> Recomputed: in what it differs, or why it was not compared
    PolicyVersion and its recordings --learn_again--> likewise

A version names all that it follows from: demonstrations, learner, settings, seed, and the versions of learner and gate.
Another version of either may give another result without anybody having changed anything, so that is left out, with
the reason; likewise a version whose row has other demonstrations than its manifest. Nothing is stored.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion, StoredRecording
from skills.db.packed import digest, seal, unpack_as
from skills.db.session import Database
from skills.demonstration.demonstration import cut_demo, partner_motion
from skills.demonstration.partner import PartnerMotion
from skills.errors import NotFound
from skills.formats.parsed import ParsedContent
from skills.gridworld.grid import discretize
from skills.gridworld.reward import sparse_reward
from skills.learning.policy import LEARNER_VERSION, Policy
from skills.learning.tube import CertifiedPoses
from skills.library.operation.integrity import learnt
from skills.library.people.consent import refusal
from skills.library.policies.gate import GATE_VERSION
from skills.library.policies.learning import Learnt, Lesson, certified, combined_lesson, learn_style, lessons
from skills.library.policies.requests import request_of
from skills.library.recordings.content_cache import alike
from skills.library.recordings.recordings import Parser, recording_bytes
from skills.packing import canonical
from skills.settings import Settings

NUMBERS = "its values"
BESIDE = "the other arm's motion in its pose style"


@dataclass(frozen=True)
class Recomputed:
    """The result for one version: what differs from the stored one, or why it was not, or not wholly, compared."""

    differing: tuple[str, ...] = ()
    left_out: str | None = None


def compute_again(database: Database, row: int) -> Recomputed:
    """Certify and measure a stored policy again, and compare the result with its manifest.

    Args:
        database: The database, without restriction.
        row: The row of the version.

    Raises:
        NotFound: It was erased meanwhile.
        SkillsError: It cannot be computed, such as where a stored value does not match its digest.
    """
    with database.reading() as session:
        version = _found(session, row)
        if (other := _other_learner(version) or _other_demos(version) or _other_gate(version)) is not None:
            return Recomputed(left_out=f"{other}, its certificate was not computed again")
        policy, found = learnt(version), lessons(session, [one.row for one in version.demonstrations])
    lesson = _lesson(version, found)
    made = certified(lesson, request_of(version.manifest), lesson.motion, policy)
    return Recomputed(_differing(version, policy, made))


def learn_again(database: Database, row: int, recordings: "StoredRecordings", settings: Settings) -> Recomputed:
    """Cut the demonstrations of a version out of their recordings again, learn from them, and compare the result.

    The other arm's motion in its pose style is compared too.

    Args:
        database: The database, without restriction.
        row: The row of the version.
        recordings: Reads them.
        settings: Limits of time and memory.

    Raises:
        NotFound: It was erased meanwhile.
        SkillsError: It cannot be learnt any more, such as where a stored value does not match its digest.
    """
    with database.reading() as session:
        version = _found(session, row)
        if (other := _other_learner(version) or _other_demos(version)) is not None:
            return Recomputed(left_out=f"{other}, not learnt again")
        policy, gate = learnt(version), _other_gate(version)
        beside = None if version.poses is None else version.poses.poses.path.partner  # its row is checked by itself
        if policy.network is not None:
            return Recomputed(left_out="learnt by a network, whose values depend on the machine, not learnt again")
        if (refused := refusal(version.surgeon, "training")) is not None:
            return Recomputed(left_out=f"not learnt again: {refused.words()}")
        found = lessons(session, [one.row for one in version.demonstrations])
        cut = {one.row: (one, one.demo, one.path) for one in version.demonstrations}
    differing: list[str] = []
    for at, lesson in enumerate(found):
        shown, stored, in_grid = cut[lesson.row]
        recording = recordings.read(shown.recording_row).recording
        demo = cut_demo(recording, arm=stored.arm, topic=stored.topic, start_s=stored.start_s, end_s=stored.end_s)
        path = discretize(demo.tip_mm, in_grid.grid, in_grid.hysteresis)
        if (digest(demo), digest(path)) != (digest(stored), digest(in_grid)):
            differing.append(f"its demonstration {shown.sha256[:12]}, cut out of its recording again")
        reward, partner = sparse_reward(path, policy.levels), partner_motion(recording, demo)
        found[at] = replace(lesson, demo=seal(demo).packed, reward=seal(reward).packed, partners=(partner,))
    made = learn_style(_lesson(version, found), request_of(version.manifest), settings)
    differing += _differing(version, policy, made, numbers_only=bool(gate))
    if not alike(beside, _beside(made)):
        differing.append(BESIDE)
    return Recomputed(tuple(differing), None if gate is None else f"{gate}, only its values were compared")


def _found(session: Session, row: int) -> PolicyVersion:
    version = session.get(PolicyVersion, row)
    if version is None:
        raise NotFound("There is no such policy version.")
    return version


def _beside(made: Learnt) -> PartnerMotion | None:
    """Return the other arm's motion in the pose style of what was learnt; None if there is none."""
    return None if made.poses is None else unpack_as(CertifiedPoses, made.poses.packed).path.partner


class StoredRecordings:
    """Reads recordings from their stored bytes; the last one is kept, because versions in turn are often of one."""

    def __init__(self, database: Database, parse: Parser) -> None:
        """Read from this database, by a reader that is possibly in another process."""
        self._database, self._parse = database, parse
        self._last: tuple[int, ParsedContent] | None = None

    def read(self, row: int) -> ParsedContent:
        """Decode a recording.

        Raises:
            SkillsError: Its bytes do not match its digest, or cannot be decoded.
        """
        if self._last is None or self._last[0] != row:
            self._last = None  # two large ones do not fit into memory
            self._last = row, decoded(self._database, row, self._parse)
        return self._last[1]


def decoded(database: Database, row: int, parse: Parser) -> ParsedContent:
    """Decode the stored bytes of a recording, whatever is cached of it.

    Raises:
        NotFound: It was erased meanwhile.
        SkillsError: Its bytes do not match its digest, or cannot be decoded.
    """
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            stored = session.get(StoredRecording, row)
            if stored is None:
                raise NotFound("There is no such recording.")
            options = stored.reading.options
            file.writelines(recording_bytes(session, stored))
        return parse(file, **options)


def _lesson(version: PolicyVersion, found: list[Lesson]) -> Lesson:
    """Return what a version was learnt from, with the outcomes that its demonstrations had then."""
    outcomes = version.manifest.outcomes
    lesson = combined_lesson(found, request_of(version.manifest).combine)
    return lesson if outcomes is None else replace(lesson, outcomes=tuple(outcomes))


def _differing(version: PolicyVersion, policy: Policy, made: Learnt, *, numbers_only: bool = False) -> tuple[str, ...]:
    """Return in what a result differs from the stored version, such as "its values" and "metrics.rmse_mm"."""
    if made.sha256 == version.sha256:
        return ()
    equal = digest(unpack_as(Policy, made.policy)) == digest(policy)
    fields = () if numbers_only else _unequal(version.manifest.digested, made.manifest.digested)
    return (*(() if equal else (NUMBERS,)), *fields)


def _other_gate(version: PolicyVersion) -> str | None:
    gate = version.manifest.grid_certificate.gate
    return None if gate == GATE_VERSION else f"checked by another release gate (version {gate}, now {GATE_VERSION})"


def _other_learner(version: PolicyVersion) -> str | None:
    made = version.manifest.learner_version
    age = "an older" if made < LEARNER_VERSION else "a newer"
    return None if made == LEARNER_VERSION else f"made by {age} learner (version {made}, now {LEARNER_VERSION})"


def _other_demos(version: PolicyVersion) -> str | None:
    """Return that the row has other demonstrations than its manifest, which `verify` reports with the row."""
    if version.manifest.demos == [one.sha256 for one in version.demonstrations]:
        return None
    return "stored with other demonstrations than its manifest names"


def _unequal(stored: dict[str, Any], made: dict[str, Any], prefix: str = "") -> Iterable[str]:
    """Yield the names of the fields of two JSON objects that differ, those of objects within with a dot."""
    for name in sorted({*stored, *made}):
        one, other = stored.get(name), made.get(name)
        if isinstance(one, dict) and isinstance(other, dict):
            yield from _unequal(one, other, f"{prefix}{name}.")
        elif canonical(one) != canonical(other) or (name in stored) != (name in made):
            yield f"{prefix}{name}"
