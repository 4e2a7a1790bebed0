"""The list of what ended for good: erasures, withdrawals, superseded releases, revoked keys, narrowed consent.

    Database --keep_erasures--> list of erasures, a file outside the database --read_erasures--> Erasures

A backup cannot contain later changes. The list contains all of them, so that a restoration applies them again. It only
removes data and permissions, never adds them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

from pydantic import BaseModel, TypeAdapter
from sqlalchemy import Select, exists, func, select, tuple_
from sqlalchemy.orm import Session

from skills.db.models import SUCCESS, Demonstration, Erasure, LastUsed, PolicyVersion, Release, StoredRecording, Surgeon
from skills.db.service_tables import Event, Key, record_event
from skills.db.session import Database
from skills.errors import Corrupt
from skills.library.operation.files import appearing_file, locked_folder
from skills.library.people.erasure import delete_recording, erase_demo, erase_surgeon
from skills.library.people.keys import revoke_key
from skills.library.people.surgeons import put_consent, salted
from skills.library.policies.releases import withdraw_policies
from skills.library.recordings.demos import MARKS, mark_demo, withdraw_demo
from skills.packing import canonical, sha256
from skills.schemas import DemoOutcome
from skills.schemas.people import Consent

ERASURES: Final = "suture-skills erasures 1"
# Events that end something permanently, with the name of their list. Releases end by being superseded as well.
ENDS = {
    ("erase", "demonstration"): "demonstrations",
    ("erase", "recording"): "recordings",
    ("withdraw", "demonstration"): "withdrawn",
    ("withdraw", "policy-version"): "releases",
    ("revoke", "key"): "keys",
}
RELEASED = ("release", "policy-version")
MARKED = {(action, "demonstration"): outcome for outcome, action in MARKS.items()}
LISTED = (
    *ENDS,
    *MARKED,
    ("erase", "surgeon"),
    RELEASED,
    ("add", "surgeon"),
    ("change", "surgeon"),
    ("train", "policy-version"),
)
V = TypeVar("V")
# By the list names in `ENDS`: digests or ids, and the moment at which each last ended.
Ended = Mapping[str, Mapping[str, datetime]]


@dataclass(frozen=True)
class Erasures:
    """The erasures, withdrawals and revocations of an installation that a restored backup must not undo.

    It names no person. An erased surgeon is a salted digest of the pseudonym, which can be recognised but not read; a
    surgeon with a consent is the random subject that events name as well.

    Attributes:
        surgeons: The salt and the moment of each erased surgeon, by the salted digest.
        ended: Demonstrations that were erased or withdrawn, recordings that were deleted and policies that are no
            longer served, by their SHA-256, and revoked keys by their id; each with the moment at which it last ended.
        consents: The consent of each surgeon as last stated, by subject, and the moment of the statement.
        outcomes: The outcome of each marked demonstration, by its SHA-256, and the moment of the newest mark; not the
            reason, which may name a person.
        numbers: The last version number of each style, by "subject/suture type": it is never used again.
    """

    surgeons: Mapping[str, tuple[str, datetime]] = field(default_factory=dict)
    ended: Ended = field(default_factory=dict)
    consents: Mapping[str, tuple[datetime, Consent | None]] = field(default_factory=dict)
    outcomes: Mapping[str, tuple[datetime, DemoOutcome]] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)

    @property
    def demos(self) -> frozenset[str]:
        """The erased demonstrations."""
        return frozenset(self.ended.get("demonstrations", ()))

    def __or__(self, other: "Erasures") -> "Erasures":
        """Return the union of two lists; for an entry in both the later moment counts."""
        kinds = [kind for kind in ENDS.values() if kind in self.ended or kind in other.ended]
        return Erasures(
            _merged(self.surgeons, other.surgeons),
            {kind: _merged(self.ended.get(kind, {}), other.ended.get(kind, {})) for kind in kinds},
            _merged(self.consents, other.consents),
            _merged(self.outcomes, other.outcomes),
            _merged(self.numbers, other.numbers),
        )

    def since(self, known: "Erasures") -> "Erasures":
        """Return the entries that an installation does not know.

        It knows an entry that ended there at the same moment or later, and a consent or an outcome that is as recent.
        """
        return Erasures(
            _newer(self.surgeons, known.surgeons),
            {kind: _newer(names, known.ended.get(kind, {})) for kind, names in self.ended.items()},
            _newer(self.consents, known.consents),
            _newer(self.outcomes, known.outcomes),
            _newer(self.numbers, known.numbers),
        )


def _newer(one: Mapping[str, V], other: Mapping[str, V]) -> dict[str, V]:
    """Return the entries of one list that the other lacks, or has with an earlier moment or a smaller number."""
    return {name: said for name, said in one.items() if name not in other or _order(other[name]) < _order(said)}


def _merged(one: Mapping[str, V], other: Mapping[str, V]) -> dict[str, V]:
    return {**other, **_newer(one, other)}


def _order(said: Any) -> Any:
    """Return what an entry is compared by: its moment, its number, or the salt, which is always the same."""
    return said[0] if isinstance(said, tuple) else said


NOTHING = Erasures()


class _File(BaseModel):
    """The contents of a file with a list, and the SHA-256 of the list as canonical JSON."""

    format: Literal["suture-skills erasures 1"]
    erasures: Erasures
    sha256: str


def _digest(listed: Erasures) -> str:
    return sha256(canonical(TypeAdapter(Erasures).dump_python(listed, mode="json")))


def erasures_of(database: Database) -> Erasures:
    """Return the list of erasures of an installation."""
    with database.reading() as session:
        return _listed(session)


def keep_erasures(database: Database, target: Path) -> Erasures:
    """Write the list of erasures to a file, merged with the list already in the file, so that no entry is ever lost."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with locked_folder(target.parent):
        listed = erasures_of(database) | (read_erasures(str(target)) if target.exists() else NOTHING)
        with appearing_file(target) as file:
            written = _File(format=ERASURES, erasures=listed, sha256=_digest(listed))
            file.write(written.model_dump_json(indent=1).encode() + b"\n")
    return listed


def keep_up_erasures(database: Database, target: Path, known: int = 0) -> int:
    """Write the list of erasures if an event after the one of row `known` changes it.

    Returns:
        The row of the newest such event; `known` if there is none.
    """
    query = select(func.max(Event.row)).where(Event.row > known, tuple_(Event.action, Event.object_kind).in_(LISTED))
    with database.reading() as session:
        if session.scalar(query) is None:
            return known
    with database.writing() as session:  # alone: events of earlier rows may still be uncommitted, none is after this
        newest = session.scalar(query)
    assert newest is not None, "events are never deleted"
    keep_erasures(database, target)
    return newest


def read_erasures(source: str) -> Erasures:
    """Read a list of erasures from a file, or from the database of an installation if `source` is a URL.

    Raises:
        Corrupt: The file is not such a list, or was changed.
    """
    if "://" in source:
        database = Database(source)
        try:
            return erasures_of(database)
        finally:
            database.close()
    try:
        said = _File.model_validate_json(Path(source).read_bytes())
        if said.sha256 != _digest(said.erasures):
            raise ValueError("changed")
    except ValueError as error:
        raise Corrupt("This is not a list of erasures, or it was changed; use another copy of it.") from error
    return said.erasures


def _listed(session: Session) -> Erasures:
    """Return the list of an installation, with moments in the order of its events (`_in_order`)."""
    surgeons = {one.digest: (one.salt, one.erased_at) for one in session.scalars(select(Erasure))}
    ended: dict[str, dict[str, datetime]] = {kind: {} for kind in ENDS.values()}
    outcomes: dict[str, tuple[datetime, DemoOutcome]] = {}
    stated: dict[str | None, datetime] = {}
    released: dict[tuple[int, str], str] = {}  # by style, the policy of the last release
    query = select(PolicyVersion.sha256, PolicyVersion.surgeon_row, PolicyVersion.suture)
    styles = {sha256: (surgeon_row, suture) for sha256, surgeon_row, suture in session.execute(query)}
    for event, at in _in_order(session):
        kind, name = (event.action, event.object_kind), event.object_id
        if kind in ENDS:
            ended[ENDS[kind]][name] = at
        elif kind in MARKED:  # of an erased demonstration too: it may have been added anew since
            outcomes[name] = at, MARKED[kind]
        elif kind == RELEASED and name in styles:
            before = released.get(styles[name], name)
            released[styles[name]] = name
            if before != name:
                ended["releases"][before] = at
        elif event.object_kind == "surgeon":
            stated[event.subject] = at
    described = session.execute(select(Surgeon.subject, Surgeon.created_at, Surgeon.consent))
    consents = {subject: (stated.get(subject, created_at), consent) for subject, created_at, consent in described}
    return Erasures(surgeons, ended, consents, outcomes, _numbers(session))


def _numbers(session: Session) -> dict[str, int]:
    """Return the last version number of each style, by subject and suture type, also of erased versions."""
    found: dict[str, int] = {}
    for of, number in ((PolicyVersion, PolicyVersion.version), (LastUsed, LastUsed.last)):
        query = select(Surgeon.subject, of.suture, func.max(number)).join(of, of.surgeon_row == Surgeon.row)
        for subject, suture, last in session.execute(query.group_by(Surgeon.subject, of.suture)):
            style = f"{subject}/{suture}"
            found[style] = max(last, found.get(style, 0))
    return found


def _in_order(session: Session) -> Iterator[tuple[Any, datetime]]:
    """Yield the listed events in their order, each with a moment that is never before that of an earlier one.

    The order is that of their rows. A clock that was set back would make a later event look earlier, and what ended
    twice look known to a backup that knows the first end; so such an event follows the one before by a microsecond.
    Events are never deleted, so a backup and a later list give the same moments to those that both have.
    """
    columns = (Event.action, Event.object_kind, Event.object_id, Event.subject, Event.at)
    kinds = tuple_(Event.action, Event.object_kind).in_(LISTED)
    last: datetime | None = None
    for event in session.execute(select(*columns).where(kinds).order_by(Event.row)):
        last = event.at if last is None or event.at >= last else last + timedelta(microseconds=1)
        yield event, last


def apply_erasures(session: Session, erasures: Erasures) -> dict[str, int]:
    """Apply the entries of a list that the backup does not know; an entry that it knows may have been added anew since.

    An erased surgeon that is not in the backup stays listed, so that nobody can take the pseudonym.
    """
    later, served = erasures.since(_listed(session)), _served(session)
    slugs = list(session.scalars(select(Surgeon.slug)))
    surgeons: set[str] = set()
    for digest, (salt, erased_at) in sorted(later.surgeons.items()):
        surgeons.update(slug for slug in slugs if salted(salt, slug) == digest)
        session.add(Erasure(salt=salt, digest=digest, erased_at=erased_at))
    for slug in sorted(surgeons):
        erase_surgeon(session, slug, "restore")

    def end(kind: str, in_force: Select[str], again: Callable[[str], object]) -> int:
        names = {*later.ended.get(kind, ())}.intersection(session.scalars(in_force))
        for name in sorted(names):
            again(name)
        return len(names)

    erased = end("demonstrations", select(Demonstration.sha256), lambda demo: erase_demo(session, demo, "restore"))
    # A recording with demonstrations was uploaded again after its deletion, in a history that the list does not cover.
    uncut = select(StoredRecording.sha256).where(~exists().where(Demonstration.recording_row == StoredRecording.row))
    deleted = end("recordings", uncut, lambda name: delete_recording(session, name, "restore", as_admin=True))
    active = select(Demonstration.sha256).where(Demonstration.withdrawn_at.is_(None))
    withdrawn = end("withdrawn", active, lambda demo: withdraw_demo(session, demo, "restore"))
    marked = _mark_again(session, later.outcomes)
    withdraw_policies(session, later.ended.get("releases", {}), "restore")
    valid = select(Key.id).where(Key.revoked_at.is_(None))
    revoked = end("keys", valid, lambda key: revoke_key(session, key, "restore"))
    narrowed = _narrow(session, later.consents)
    rows = {one.subject: one.row for one in session.scalars(select(Surgeon))}
    for style, last in later.numbers.items():
        subject, _, suture = style.partition("/")
        if subject in rows:
            session.add(LastUsed(surgeon_row=rows[subject], suture=suture, last=last))
    return {
        "surgeons_erased": len(surgeons),
        "demos_erased": erased,
        "recordings_deleted": deleted,
        "demos_withdrawn": withdrawn,
        "styles_stopped": len(served - _served(session)),
        "keys_revoked": revoked,
        "consents_narrowed": narrowed,
        "demos_marked": marked,
    }


def _mark_again(session: Session, outcomes: Mapping[str, tuple[datetime, DemoOutcome]]) -> int:
    """Mark recoveries and failures again; a later success is not restored, because a list never adds a permission."""
    failed = {demo: outcome for demo, (_, outcome) in outcomes.items() if outcome != SUCCESS}
    here = sorted({*failed}.intersection(session.scalars(select(Demonstration.sha256))))
    for demo in here:
        mark_demo(session, demo, failed[demo], "Marked after the backup that was restored.", "restore")
    return len(here)


def _served(session: Session) -> set[tuple[int, str]]:
    """Return the styles that have a released policy, as the surgeon's row and the suture type."""
    released = select(Release.surgeon_row, Release.suture).where(Release.withdrawn_at.is_(None)).distinct()
    return {(surgeon, suture) for surgeon, suture in session.execute(released)}


def _narrow(session: Session, consents: Mapping[str, tuple[datetime, Consent | None]]) -> int:
    """Restrict each surgeon's consent to the uses that both the backup and the consent stated since allow."""
    changed = 0
    for surgeon in session.scalars(select(Surgeon)).all():
        _, stated = consents.get(surgeon.subject, (None, None))
        both = _both(surgeon.consent, stated)
        if both != surgeon.consent:
            record_event(session, "restore", "change", "surgeon", surgeon.subject, surgeon)
            put_consent(session, surgeon, both, "restore")
            changed += 1
    return changed


def _both(one: Consent | None, other: Consent | None) -> Consent | None:
    """Return the intersection of two consents: the uses in both, until the earlier end; None allows everything."""
    if one is None or other is None:
        return one or other
    ends = [end for end in (one.until, other.until) if end is not None]
    return Consent(uses=[use for use in one.uses if use in other.uses], until=min(ends, default=None))
