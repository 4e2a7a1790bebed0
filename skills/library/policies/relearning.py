"""Certificates computed again and policies learnt again, to be compared with the stored ones.

    PolicyVersion --compute_again--> Again: in what it differs, or why it was not compared
    PolicyVersion and its recordings --learn_again--> likewise

A version names all that it follows from: demonstrations, learner, settings, seed, and the versions of learner and gate.
Another version of either may give another result without anybody having changed anything, so that is left out, with
the reason; likewise a version whose row has other demonstrations than its manifest. Nothing is stored.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from sqlalchemy.orm import Session

from skills.db.models import Demonstration, PolicyVersion, StoredRecording
from skills.db.packed import digest, seal, unpack_as
from skills.db.session import Database
from skills.demonstration.demonstration import Demo, cut_demo, partner_motion
from skills.demonstration.partner import PartnerMotion
from skills.errors import NotFound
from skills.formats.parsed import ParsedContent
from skills.gridworld.grid import GridPath, discretize
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import NearLimits, OddsLimits
from skills.learning.policy import LEARNER_VERSION, Policy, describe_learner
from skills.learning.tube import CertifiedPoses
from skills.library.operation.integrity import learnt
from skills.library.operation.jobs import TrainingRequest
from skills.library.people.consent import refusal
from skills.library.policies.gate import GATE_VERSION, limits_of
from skills.library.policies.learning import ANY, Learnt, Lesson, certified, combined_lesson, learn_style, lessons
from skills.library.policies.training import POSES_VERSION
from skills.library.recordings.content_cache import alike
from skills.library.recordings.recordings import Parser, recording_bytes
from skills.packing import canonical
from skills.schemas.policies import PolicyManifest
from skills.settings import Settings

NUMBERS = "its values"
BESIDE = "the other arm's motion in its pose style"


@dataclass(frozen=True)
class Again:
    """The result for one version: what differs from the stored one, or why it was not, or not wholly, compared."""

    differing: tuple[str, ...] = ()
    left_out: str | None = None


def compute_again(database: Database, row: int) -> Again:
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
            return Again(left_out=f"{other}, its certificate was not computed again")
        stored, found = _Stored.of(version), lessons(session, [one.row for one in version.demonstrations])
    lesson = stored.lesson(found)
    return Again(stored.differing(certified(lesson, stored.request, unpack_as(Demo, lesson.demo), stored.policy)))


def learn_again(database: Database, row: int, recordings: "StoredRecordings", settings: Settings) -> Again:
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
            return Again(left_out=f"{other}, not learnt again")
        stored, gate = _Stored.of(version), _other_gate(version)
        beside = None if version.poses is None else version.poses.poses.path.partner  # its row is checked by itself
        if stored.policy.network is not None:
            return Again(left_out="learnt by a network, whose values depend on the machine, not learnt again")
        if (refused := refusal(version.surgeon, "training")) is not None:
            return Again(left_out=f"not learnt again: {refused.words()}")
        cuts = [_Cut.of(one) for one in sorted(version.demonstrations, key=lambda one: one.row)]
        found = lessons(session, [one.row for one in version.demonstrations])
    differing: list[str] = []
    for at, cut in enumerate(cuts):
        demo, path, partner = cut.again(recordings)
        if (digest(demo), digest(path)) != (cut.demo, cut.path):
            differing.append(f"its demonstration {cut.sha256[:12]}, cut out of its recording again")
        reward = sparse_reward(path, stored.policy.levels)
        found[at] = replace(found[at], demo=seal(demo).packed, reward=seal(reward).packed, partners=(partner,))
    made = learn_style(stored.lesson(found), stored.request, settings)
    differing += stored.differing(made, numbers_only=bool(gate))
    if not alike(beside, _beside(made)):
        differing.append(BESIDE)
    return Again(tuple(differing), None if gate is None else f"{gate}, only its values were compared")


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

    def __init__(self, database: Database, tell: Parser) -> None:
        """Read from this database, by a reader that is possibly in another process."""
        self._database, self._tell = database, tell
        self._last: tuple[int, ParsedContent] | None = None

    def read(self, row: int) -> ParsedContent:
        """Decode a recording.

        Raises:
            SkillsError: Its bytes do not match its digest, or cannot be decoded.
        """
        if self._last is None or self._last[0] != row:
            self._last = None  # two large ones do not fit into memory
            self._last = row, decoded(self._database, row, self._tell)
        return self._last[1]


def decoded(database: Database, row: int, tell: Parser) -> ParsedContent:
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
        return tell(file, **options)


@dataclass(frozen=True)
class _Cut:
    """Where a demonstration lies in its recording and in its grid, and the digests of both."""

    recording: int
    sha256: str
    named: dict[str, Any]
    of_grid: tuple[Any, float]
    demo: str
    path: str

    @classmethod
    def of(cls, row: Demonstration) -> "_Cut":
        demo, path = row.demo, row.path
        named = {name: getattr(demo, name) for name in ("arm", "topic", "start_s", "end_s")}
        return cls(row.recording_row, row.sha256, named, (path.grid, path.hysteresis), digest(demo), digest(path))

    def again(self, told: StoredRecordings) -> tuple[Demo, GridPath, PartnerMotion | None]:
        recording = told.read(self.recording).recording
        demo = cut_demo(recording, **self.named)
        return demo, discretize(demo.tip_mm, *self.of_grid), partner_motion(recording, demo)


@dataclass(frozen=True)
class _Stored:
    """A stored version with the request of which it is the result."""

    sha256: str
    manifest: PolicyManifest
    policy: Policy
    request: TrainingRequest

    @classmethod
    def of(cls, version: PolicyVersion) -> "_Stored":
        policy = learnt(version)
        return cls(version.sha256, version.manifest, policy, request_of(version.manifest, policy))

    def lesson(self, found: list[Lesson]) -> Lesson:
        """Return what the version was learnt from, with the outcomes that its demonstrations had then."""
        combined, outcomes = self.manifest.combined, self.manifest.outcomes
        lesson = found[0] if combined is None else combined_lesson(found, combined.kind)
        return lesson if outcomes is None else replace(lesson, outcomes=tuple(outcomes))

    def differing(self, made: Learnt, *, numbers_only: bool = False) -> tuple[str, ...]:
        """Return what differs, such as "its values" and "metrics.rmse_mm"."""
        if made.sha256 == self.sha256:
            return ()
        equal = digest(unpack_as(Policy, made.policy)) == digest(self.policy)
        fields = () if numbers_only else _unequal(self.manifest.digested, made.manifest.digested)
        return (*(() if equal else (NUMBERS,)), *fields)


def request_of(manifest: PolicyManifest, policy: Policy) -> TrainingRequest:
    """Return the request of which a version is the result, as `training.request_training` writes it."""
    request: TrainingRequest = {
        "surgeon": manifest.surgeon,
        "suture": manifest.suture,
        "demos": manifest.demos,
        "learner": describe_learner(manifest.learnt_with),
        "learner_version": LEARNER_VERSION,
        "gate": GATE_VERSION,
        "poses": POSES_VERSION,
        "near": asdict(limits_of(NearLimits, manifest.grid_certificate.near)),
        "seed": manifest.seed,
        "release": False,
    }
    if manifest.combined is not None:
        request["combine"] = {"kind": manifest.combined.kind}
    if manifest.outcomes is not None:
        request["outcomes"] = ANY
    if policy.ties is not None and policy.ties.depth_along is not None:
        request["depth_along"] = [*policy.ties.depth_along]
    if policy.surroundings is not None and manifest.scene is not None:
        request["surroundings"] = policy.surroundings.as_json()
        request["odds"] = asdict(limits_of(OddsLimits, manifest.scene.near))
    return request


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
