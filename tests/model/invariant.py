"""The invariant of the service in words and as plain data: what it must serve, store and answer at any time.

Nothing here depends on the service. `Model` is updated after each action of a user, and states the expected result:

1.  **Served.** A style serves at most one policy version: that of its newest release that stands. A release stands
    until it is withdrawn: by hand, with a demonstration that its version depends on, by a mark of such a demonstration
    as recovery or failure (unless the version was trained from any outcome), or with the surgeon's consent to training
    (also if that is given again after its last day). The end of the served release also withdraws those that
    it superseded, so that nothing older returns by itself. Nothing is served on a day that consent to training does
    not cover. All requests for it agree.
2.  **Stored.** Everything uploaded and learnt, and neither erased nor deleted, is stored, and nothing else. A version
    depends on demonstrations that are stored; a distance in the atlas's cache is between two that are stored, and is
    correct. Nothing is stored that consent, at the moment of storing, did not cover, and nothing learnt from a recovery
    or a failure unless that was asked for. Of an erased surgeon no table
    holds the pseudonym.
3.  **Answered.** A job that succeeded has stored its stated result. A client that requests a training with a release,
    and waits, gets the answer "released" if, and only if, that version is then served; otherwise it gets the reason.
    A call that consent or a withdrawal forbids is refused. A job fails only if there was an obstacle. A job that was
    cancelled, or erased with what it is about, stores nothing from then on, whatever step it is in. The number of a
    version is never used twice in a style.
4.  **Restored.** Of the backup's content, everything erased, withdrawn, superseded or revoked since is so again after
    a restore, what was last marked recovery or failure since is marked so, and consent covers what it covered then and
    as it was last stated; the rest is as in the backup.
    Objects that were erased or withdrawn before another restore, and uploaded again since, end again as well: the
    list only removes. A restore never fails because of an entry of the list.
5.  **Keys.** A key is valid until it is revoked or has expired, and not after.
6.  **Passed on.** A recording, as bytes, as a timeline or in a dataset, is passed on while every surgeon in it allows
    export: who was named at its upload, or has, or had, a demonstration there. Erasing one of them closes it for good.
7.  **Rolled back.** If the database is put back to a state older than the saved head, nothing is served and nothing
    is written until the right one is back, or the rollback is accepted, which is a restore of the older one. Nor is
    anything served or written with another signing key.
8.  **Elsewhere.** Another machine, with another processor, learns every version again as it is stored, and exports the
    same bytes, or refuses for the same reason.
9.  **Proposals.** A proposal is accepted while a demonstration that was cut there is stored, also a withdrawn one.
    Otherwise it is as was last decided, and open at the beginning. After a restore the decisions are as in the
    backup: an open proposal gives nobody a permission, so the list has no rejections.
"""

from collections.abc import Set
from copy import deepcopy
from dataclasses import dataclass, field
from datetime import date
from itertools import count
from typing import Any

ALL_USES = ("training", "export", "atlas")
Style = tuple[str, str]  # surgeon and suture type
serial = count(1)


@dataclass(frozen=True)
class Consent:
    """The uses that a surgeon agreed to, None if nothing is recorded, which allows all; and the last day of it."""

    uses: frozenset[str] | None = None
    until: date | None = None

    @property
    def written(self) -> dict[str, Any] | None:
        """Return it as JSON."""
        if self == Consent():
            return None
        return {"uses": sorted(self.uses or ()), "until": self.until and self.until.isoformat()}

    def and_of(self, other: "Consent") -> "Consent":
        """Return the uses and the days that both cover."""
        if Consent() in (self, other):
            return other if self == Consent() else self
        ends = [end for end in (self.until, other.until) if end is not None]
        return Consent((self.uses or frozenset()) & (other.uses or frozenset()), min(ends, default=None))

    def covers(self, use: str, today: date) -> bool:
        return (self.uses is None or use in self.uses) and (self.until is None or today <= self.until)


@dataclass
class Demo:
    sha256: str
    style: Style
    recording: str
    withdrawn: bool = False
    mark: tuple[str, str] | None = None  # outcome and reason

    @property
    def failed(self) -> bool:
        return self.mark is not None and self.mark[0] != "success"


@dataclass(frozen=True)
class Version:
    sha256: str
    style: Style
    number: int
    demos: frozenset[str]
    releasable: bool
    of_any: bool  # trained from demonstrations of any outcome


@dataclass
class Release:
    version: Version
    withdrawn: bool = False
    id: int = field(default_factory=lambda: next(serial))


@dataclass
class Job:
    """A training with its demonstrations; a batch, with `ended` as the styles whose end is known; or a try.

    A try has no demonstrations, but a recording and a style.
    """

    id: str
    surgeon: str | None
    release: bool
    demos: frozenset[str]
    state: str
    batch: bool = False
    of_any: bool = False
    recording: str | None = None
    style: Style = ("", "")
    ended: set[str] = field(default_factory=set)
    doubt: set[str] = field(default_factory=set)  # obstacles during the work on it, by demonstration or recording


@dataclass
class Key:
    secret: str
    surgeon: str | None  # the only surgeon that it may see
    last_day: date | None
    revoked: bool = False


Fact = tuple[str, Any, int]  # an irreversible fact: its kind, its object, and its number
# In the order in which a restore applies them.
KINDS = (
    "erased surgeon",
    "erased demo",
    "deleted recording",
    "withdrawn demo",
    "marked demo",
    "ended policy",
    "revoked",
    "consent",
)


def _key(about: Any) -> Any:
    """Return the object of a fact; for a consent, the surgeon; for a mark, the demonstration."""
    return about[0] if isinstance(about, tuple) else about


@dataclass
class Model:
    """The expected state of an installation."""

    today: date
    surgeons: dict[str, Consent] = field(default_factory=dict)
    subjects: dict[str, int] = field(default_factory=dict)  # identities: a later surgeon may reuse a pseudonym
    erased: set[str] = field(default_factory=set)
    recordings: dict[str, set[str]] = field(default_factory=dict)  # the surgeons named at upload
    left: dict[str, set[str]] = field(default_factory=dict)  # whose erased demonstrations are still in its bytes
    closed: set[str] = field(default_factory=set)  # recordings in which somebody was erased
    decided: dict[str, tuple[str, str | None]] = field(default_factory=dict)  # on the proposal of a recording, and why
    demos: dict[str, Demo] = field(default_factory=dict)
    versions: dict[str, Version] = field(default_factory=dict)
    numbers: dict[Style, int] = field(default_factory=dict)  # the highest that a version of a style ever had
    plans: dict[str, str] = field(default_factory=dict)  # the versions that they are made of
    releases: list[Release] = field(default_factory=list)
    jobs: dict[str, Job] = field(default_factory=dict)
    keys: dict[str, Key] = field(default_factory=dict)
    facts: set[Fact] = field(default_factory=set)  # that the database knows
    listed: set[Fact] = field(default_factory=set)  # that only the list knows, from before a restore

    # ---- queries ---- --

    def may(self, surgeon: str, use: str) -> bool:
        return self.surgeons[surgeon].covers(use, self.today)

    def standing(self, style: Style) -> list[Release]:
        """List the releases of a style that stand, the newest first."""
        mine = [one for one in self.releases if one.version.style == style and not one.withdrawn]
        return sorted(mine, key=lambda one: -one.id)

    def served(self, style: Style) -> Version | None:
        standing = self.standing(style)
        return standing[0].version if standing and self.may(style[0], "training") else None

    def active(self, style: Style) -> list[Demo]:
        """List the demonstrations of a style that are not withdrawn, the oldest first."""
        return [one for one in self.demos.values() if one.style == style and not one.withdrawn]

    def in_atlas(self, suture: str) -> set[str]:
        newest = {  # of each recording, which the steps cut alike
            one.recording: one.sha256
            for one in self.demos.values()
            if one.style[1] == suture and not one.withdrawn and self.may(one.style[0], "atlas")
        }
        return {*newest.values()}

    def may_learn(self, demos: Set[str], of_any: bool = False) -> bool:
        """Return whether learning from these demonstrations, and storing the result, is allowed now."""
        found = [self.demos.get(one) for one in demos]
        return all(
            one is not None and not one.withdrawn and (of_any or not one.failed) and self.may(one.style[0], "training")
            for one in found
        )

    def may_serve(self, version: Version) -> bool:
        return self.may_learn(version.demos, version.of_any)

    def cut_from(self, recording: str) -> list[Demo]:
        return [one for one in self.demos.values() if one.recording == recording]

    def proposal(self, recording: str) -> str:
        """Return the state of the only proposal of a recording."""
        return "accepted" if self.cut_from(recording) else self.decided.get(recording, ("open", None))[0]

    def seen_in(self, recording: str) -> set[str]:
        cut = {one.style[0] for one in self.cut_from(recording)}
        return cut | self.recordings[recording] | self.left.get(recording, set())

    def may_export(self, recording: str) -> bool:
        return recording not in self.closed and all(self.may(one, "export") for one in self.seen_in(recording))

    def may_try(self, job: Job) -> bool:
        """Return whether a try has no obstacle now."""
        cut = [one for one in self.cut_from(job.recording or "") if one.style == job.style]
        free = job.recording in self.recordings and self.may(job.style[0], "training")
        return free and not any(one.withdrawn or one.failed for one in cut)

    def lets_in(self, key: Key) -> bool:
        return not key.revoked and (key.last_day is None or self.today <= key.last_day)

    # ---- actions ---- ------

    def agree(self, surgeon: str, consent: Consent) -> None:
        before = self.surgeons.get(surgeon, consent)
        covered = before.covers("training", self.today) and consent.covers("training", self.today)
        self.surgeons[surgeon] = consent
        if consent != before and not covered:  # also if it is given again, so that nothing returns by itself
            self._withdraw([one for one in self.releases if one.version.style[0] == surgeon and not one.withdrawn])
        self._note("consent", (self.subjects.setdefault(surgeon, next(serial)), consent))

    def add_demo(self, demo: Demo) -> None:
        self.recordings.setdefault(demo.recording, set())
        self.demos.setdefault(demo.sha256, demo)

    def add_recording(self, recording: str, surgeon: str | None) -> None:
        self.recordings.setdefault(recording, set()).update(() if surgeon is None else (surgeon,))

    def decide(self, recording: str, state: str, note: str | None) -> None:
        if self.proposal(recording) != state or recording in self.decided:
            self.decided[recording] = state, note

    def add_version(self, version: Version) -> None:
        assert self.may_serve(version), "stored, and consent, a withdrawal or a mark forbids it"
        self.versions[version.sha256] = version
        self.numbers[version.style] = max(version.number, self.numbers.get(version.style, 0))

    def delete_recording(self, recording: str) -> None:
        self._drop(recording)
        self._note("deleted recording", recording)

    def release(self, version: Version) -> None:
        standing = self.standing(version.style)
        if not standing or standing[0].version != version:
            before = [one for one in self.releases if one.version.style == version.style]
            if before and before[-1].version != version:
                self._note("ended policy", before[-1].version.sha256)
            self.releases.append(Release(version))

    def add_plan(self, plan: str, version: str) -> None:
        assert self.may_serve(self.versions[version]), "a plan is stored, and consent or a withdrawal forbids it"
        self.plans[plan] = version

    def withdraw(self, style: Style) -> None:
        self._withdraw(self.standing(style))

    def withdraw_demo(self, sha256: str) -> None:
        if not self.demos[sha256].withdrawn:
            self.demos[sha256].withdrawn = True
            self._note("withdrawn demo", sha256)
            self._withdraw_resting_on(sha256)

    def mark_demo(self, sha256: str, outcome: str, reason: str) -> None:
        demo = self.demos[sha256]
        if demo.mark != (outcome, reason):
            demo.mark = outcome, reason
            self._note("marked demo", (sha256, outcome))
        if demo.failed:
            self._withdraw_resting_on(sha256, even_of_any=False)

    def erase_demo(self, sha256: str) -> None:
        self.withdraw_demo(sha256)
        self._note("erased demo", sha256)
        self._erase_demo(sha256)

    def erase_surgeon(self, surgeon: str) -> None:
        self._note("erased surgeon", surgeon)
        self._erase_surgeon(surgeon)

    def revoke(self, key: str) -> None:
        self.keys[key].revoked = True
        self._note("revoked", key)

    def snapshot(self) -> "Model":
        return deepcopy(self)

    def restored(self, backup: "Model") -> "Model":
        """Return the expected state after a backup is restored with this installation's list."""
        listed = self.listed | self.facts
        model = backup.snapshot()
        model.today, model.listed = self.today, listed
        for (
            surgeon,
            suture,
        ), number in self.numbers.items():  # of the same surgeon, and not of a later one's pseudonym
            if model.subjects.get(surgeon, 0) == self.subjects[surgeon]:
                model.numbers[surgeon, suture] = max(number, model.numbers.get((surgeon, suture), 0))
        known = {(kind, _key(about)): number for kind, about, number in sorted(backup.facts, key=lambda fact: fact[2])}
        stated: dict[int, Consent] = {}
        marked: dict[str, str] = {}
        for kind, about, number in sorted(listed, key=lambda fact: (KINDS.index(fact[0]), fact[2])):
            if known.get((kind, _key(about)), 0) >= number:
                continue
            match kind:
                case "erased surgeon":
                    if about in model.surgeons:
                        model._erase_surgeon(about)
                    model.erased.add(about)
                    model.facts.add((kind, about, number))
                case "erased demo" if about in model.demos:
                    model._withdraw_resting_on(about)
                    model._note(kind, about)
                    model._erase_demo(about)
                case "deleted recording" if about in model.recordings and not model.cut_from(about):
                    model.delete_recording(about)
                case "withdrawn demo" if about in model.demos:
                    model.withdraw_demo(about)
                case "marked demo":
                    marked[about[0]] = about[1]
                case "ended policy" if about in model.versions:
                    standing = model.standing(model.versions[about].style)
                    model._end([one for one in standing if one.version.sha256 == about and one.id < number], standing)
                case "revoked" if about in model.keys:
                    model.revoke(about)
                case "consent":
                    stated[about[0]] = about[1]
        for demo, outcome in marked.items():
            if demo in model.demos and outcome != "success":
                model.mark_demo(demo, outcome, "restored")
        for surgeon, consent in model.surgeons.items():
            if (both := consent.and_of(stated.get(model.subjects[surgeon], consent))) != consent:
                model.agree(surgeon, both)
        return model

    def _note(self, kind: str, about: object) -> None:
        self.facts.add((kind, about, next(serial)))

    def _withdraw(self, releases: list[Release]) -> None:
        for one in releases:
            one.withdrawn = True
            self._note("ended policy", one.version.sha256)

    def _withdraw_resting_on(self, demo: str, *, even_of_any: bool = True) -> None:
        standing = self.standing(self.demos[demo].style)
        resting = [one for one in standing if demo in one.version.demos]
        self._end([one for one in resting if even_of_any or not one.version.of_any], standing)

    def _end(self, ending: list[Release], standing: list[Release]) -> None:
        """End releases; if the served version's release is among them, end all that stand."""
        self._withdraw(standing if standing and standing[0] in ending else ending)

    def _drop(self, recording: str) -> None:
        del self.recordings[recording]
        self.left.pop(recording, None)
        self.closed.discard(recording)
        self.decided.pop(recording, None)

    def _erase_demo(self, sha256: str) -> None:
        demo = self.demos.pop(sha256)
        recording, style = demo.recording, demo.style
        self.versions = {name: one for name, one in self.versions.items() if sha256 not in one.demos}
        self.plans = {name: one for name, one in self.plans.items() if one in self.versions}
        self.releases = [one for one in self.releases if sha256 not in one.version.demos]
        self.jobs = {
            name: one
            for name, one in self.jobs.items()
            if one.batch or (sha256 not in one.demos and (one.recording, one.surgeon) != (recording, style[0]))
        }
        if not self.cut_from(recording) and self.recordings[recording] <= {style[0]}:
            self._drop(recording)
        else:
            self.left.setdefault(recording, set()).add(style[0])

    def _erase_surgeon(self, surgeon: str) -> None:
        seen = {one for one in self.recordings if surgeon in self.seen_in(one)}
        for one in [one for one in self.demos.values() if one.style[0] == surgeon]:
            self._erase_demo(one.sha256)
        for recording, brought_as in list(self.recordings.items()):
            if brought_as == {surgeon} and not self.cut_from(recording):
                self._drop(recording)
            brought_as.discard(surgeon)
        self.closed |= seen & {*self.recordings}
        for left in self.left.values():
            left.discard(surgeon)
        self.jobs = {name: one for name, one in self.jobs.items() if one.surgeon != surgeon}
        del self.surgeons[surgeon]
        self.erased.add(surgeon)
