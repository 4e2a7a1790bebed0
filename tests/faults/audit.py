"""Comparison of a ledger with an installation after its recovery: what is lost, doubled, or was served wrongly.

- **Lost**: something acknowledged is not there: a recording byte by byte, a demonstration, a job with its policy, a
  release, a withdrawal, a backup with all that was acknowledged before it began; or `skills verify` finds damage.
- **Doubled**: something that was asked for once is there twice, or something is there that nobody asked for. A request
  that is repeated because its answer was lost asks for the same thing.
- **Served wrongly**: an answer to GET /policies is not the document of the version that was released at some time
  during that request, or a later answer goes back behind an earlier one.
"""

import heapq
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

import httpx2 as httpx
from sqlalchemy import func, select

from skills.db.models import Demonstration, PolicyVersion, Release, StoredRecording
from skills.db.service_tables import Event, Job
from skills.db.session import Database
from skills.errors import SkillsError
from skills.library.operation.backup import restore
from skills.library.operation.inspection import inspect_installation
from skills.packing import sha256
from tests.faults.ledger import Ask, Ledger, Read, Write
from tests.library import cases

OF_THE_RELEASE = ("released_at", "released_by")  # null in the document of a version
BEFORE = -1  # the place of what was served before the first write
ONCE = ("add", "ask", "train", "finish")  # actions of events of which an object has one
Stored = Mapping[str, Counter[str]]  # by kind: how often something is stored, by the name that a client has for it


@dataclass
class Verdict:
    """What an audit has found; empty lists if all is well.

    `given_up` are acknowledged trainings that ended as failed, with the reason: they are there, and not lost.
    """

    acknowledged: Counter[str]
    reads: int
    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    given_up: list[str] = field(default_factory=list)


def audit(ledger: Ledger, http: httpx.Client, database: Database, backups: Path, before: Stored) -> Verdict:
    """Compare what clients were told with what is there.

    Args:
        ledger: The records of the clients, which have ended, as have all jobs.
        http: A client of the recovered service.
        database: Its database, without restriction.
        backups: The folder with the backups.
        before: What was stored before the clients began.
    """
    for style in ledger.writes:
        _read_once_more(ledger, http, style)
    verdict = Verdict(ledger.acknowledged(), len(ledger.reads))
    done = [one for one in ledger.asks if one.acked_s is not None]
    for one in done:
        if one.kind == "upload":
            verdict.lost += _missing_upload(one, http)
        elif one.kind == "training":
            _look_at_job(one, http, verdict)
    after, demos = stored(database), _demos_of_policies(database)
    asked = _asked(ledger, demos)
    for kind, found in after.items():
        more = found - before.get(kind, Counter())
        verdict.doubled += [f"{kind} {name[:40]}: {n - asked[kind][name]} too many" for name, n in more.items()
                            if n > asked[kind][name]]  # fmt: skip
        verdict.lost += [f"{kind} {name[:40]}" for name in _acknowledged(ledger, kind) if not found[name]]
    verdict.doubled += [f"{one.kind} {one.what[:12]}: {len(one.ids)} ids" for one in ledger.asks if len(one.ids) > 1]
    verdict.lost += _missing_in_backups(done, backups)
    for part in {part.what: part for part in inspect_installation(database)}.values():
        verdict.lost += [f"skills verify: {what}, {why}" for what, why in part.wrong]
    verdict.wrong += _wrong_bodies(ledger, http)
    for style, writes in ledger.writes.items():
        reads = [one for one in ledger.reads if one.surgeon == style]
        found = wrong_reads(writes, reads, lambda body: policy_in(ledger.bodies[body]), demos)
        verdict.wrong += [f"{style}: {said}" for said in found]
    return verdict


# ---- what is there -----------------------------------------------------------------------------------------------


def stored(database: Database) -> Stored:
    """Count what is stored, by the names that clients have for it."""
    recording, demo, policy, release = StoredRecording, Demonstration, PolicyVersion, Release
    with database.reading() as session:
        cut = select(recording.sha256).join(demo, demo.recording_row == recording.row)
        released = select(policy.sha256).join(release, release.policy_row == policy.row)
        jobs = session.scalars(select(Job.request).where(Job.kind == "training"))
        of_event = (Event.action, Event.object_kind, Event.object_id)
        events = session.execute(select(*of_event, func.count()).where(Event.action.in_(ONCE)).group_by(*of_event))
        return {
            "recording": Counter(session.scalars(select(recording.sha256))),
            "upload": Counter(session.scalars(cut)),
            "training": Counter(request["demos"][0] for request in jobs),
            "policy version": Counter(found.demos[0] for found in session.scalars(select(policy.manifest))),
            "release": Counter(session.scalars(released)),
            "event": Counter({f"{action} {kind} {name}": n for action, kind, name, n in events if n > 1}),
        }


def _asked(ledger: Ledger, demos: Mapping[str, str]) -> Stored:
    """Count what was asked for, in the same names."""
    of = {kind: Counter(one.what for one in ledger.asks if one.kind == kind) for kind in ("upload", "training")}
    files = Counter(one.what for one in ledger.asks if one.kind in ("upload", "recording"))
    writes = [write.value for of_style in ledger.writes.values() for write in of_style if write.value is not None]
    released = Counter(
        {policy: sum(value in (policy, f"of {demo}") for value in writes) for policy, demo in demos.items()}
    )
    return {**of, "recording": files, "policy version": of["training"], "release": released, "event": Counter()}


def _acknowledged(ledger: Ledger, kind: str) -> list[str]:
    return [one.what for one in ledger.asks if one.kind == kind and one.acked_s is not None]


def _demos_of_policies(database: Database) -> dict[str, str]:
    """Return, by policy, the demonstration from which it was learnt."""
    with database.reading() as session:
        found = session.execute(select(PolicyVersion.sha256, PolicyVersion.manifest)).all()
    return {policy: manifest.demos[0] for policy, manifest in found}


def _missing_upload(one: Ask, http: httpx.Client) -> list[str]:
    demo = min(one.ids)
    if http.get(f"/demos/{demo}").status_code != 200:
        return [f"demonstration {demo[:12]}"]
    if http.get(f"/demos/{demo}/recording").content != one.about["data"]:
        return [f"recording of demonstration {demo[:12]}: other bytes"]
    return []


def _look_at_job(one: Ask, http: httpx.Client, verdict: Verdict) -> None:
    for job in one.ids:
        answer = http.get(f"/jobs/{job}")
        found = answer.json()
        if answer.status_code != 200:
            verdict.lost.append(f"job {job}")
        elif found["state"] == "failed":
            verdict.given_up.append(found["error"])
        elif found["state"] != "succeeded":
            verdict.lost.append(f"job {job}: still {found['state']}")
        elif http.get(f"/policy-versions/{found['result']['sha256']}").status_code != 200:
            verdict.lost.append(f"the policy of job {job}")


def _missing_in_backups(done: Sequence[Ask], backups: Path) -> list[str]:
    """Restore the newest acknowledged backup, and look for everything that was acknowledged before it began."""
    taken = [one for one in done if one.kind == "backup"]
    if not taken:
        return []
    newest = max(taken, key=lambda one: one.sent_s)
    with (
        TemporaryDirectory(prefix="skills-restored-") as folder,
        closing(Database(f"sqlite:///{folder}/skills.sqlite")) as database,
    ):
        try:
            restore(database, backups / newest.what)
        except (SkillsError, OSError) as error:
            return [f"backup {newest.what}: {error}"]
        there = stored(database)
    earlier = [one for one in done if one.kind in there and (one.acked_s or newest.sent_s) < newest.sent_s]
    said = f"in the backup {newest.what}"
    return [f"{one.kind} {one.what[:12]} {said}" for one in earlier if not there[one.kind][one.what]]


# ---- what was served ---------------------------------------------------------------------------------------------


def policy_in(body: bytes) -> str:
    """Return the digest of the policy in a document that was served."""
    return str(json.loads(body)["sha256"])


def _read_once_more(ledger: Ledger, http: httpx.Client, style: str) -> None:
    began_s = monotonic()
    answer = http.get(f"/policies/{style}/{cases.SUTURE}")
    body = sha256(answer.content) if answer.status_code == 200 else None
    etag = answer.headers["etag"].strip('"') if body else None
    ledger.read(Read(style, began_s, monotonic(), body, etag), answer.content if body else None)


def _wrong_bodies(ledger: Ledger, http: httpx.Client) -> list[str]:
    """Compare each document that was served with that of its version, byte by byte but for the release."""
    wrong = [
        f"a body {one.body[:12]} with the ETag {one.etag}" for one in ledger.reads if one.body and one.body != one.etag
    ]
    for name, body in ledger.bodies.items():
        version = http.get(f"/policy-versions/{policy_in(body)}")
        document = json.loads(body) | dict.fromkeys(OF_THE_RELEASE)
        if version.status_code != 200 or document != version.json():
            wrong.append(f"the body {name[:12]} is not that of version {policy_in(body)[:12]}")
    return wrong


def wrong_reads(
    writes: Sequence[Write], reads: Iterable[Read], policy: Callable[[str], str], demos: Mapping[str, str]
) -> list[str]:
    """Return the reads of a style that no order of its writes explains.

    The writes have one writer, who begins one after the end of the other, so a read returns the last one that was
    acknowledged before it began, or a later one that was sent before it ended; and never one before that of a read
    that had ended when it began (Herlihy and Wing, "Linearizability", ACM TOPLAS 1990).

    Args:
        writes: The changes, in order.
        reads: The reads, in any order.
        policy: Returns the policy in a body.
        demos: By policy, the demonstration from which it was learnt.
    """
    wrong, floor = [], BEFORE
    ended: list[tuple[float, int]] = []  # of earlier reads: when each ended, and the earliest write that explains it
    for read in sorted(reads, key=lambda one: one.began_s):
        while ended and ended[0][0] < read.began_s:
            floor = max(floor, heapq.heappop(ended)[1])
        value = None if read.body is None else policy(read.body)
        names = {value} if value is None else {value, f"of {demos.get(value)}"}
        last = max((k for k, one in enumerate(writes) if one.acked_s and one.acked_s <= read.began_s), default=BEFORE)
        begun = [k for k in range(max(last, floor, 0), len(writes)) if k == last or writes[k].sent_s <= read.ended_s]
        places = [k for k in begun if writes[k].value in names]
        if not places and max(last, floor) == BEFORE and value is None:
            places = [BEFORE]
        if places:
            heapq.heappush(ended, (read.ended_s, places[0]))
        else:
            served = "nothing" if value is None else value[:12]
            due = "nothing" if last == BEFORE else str(writes[last].value)[:12]
            wrong.append(f"served {served}, and the last acknowledged release was {due}")
    return wrong
