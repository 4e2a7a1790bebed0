"""The audit finds what is planted: a loss, a doubling, and a policy that was served wrongly."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.library.operation.backup import back_up
from skills.packing import sha256
from tests.api.service import CSV, KESTREL, POLICY, Service, copy_of_trained, serving
from tests.faults.audit import Verdict, audit, wrong_reads
from tests.faults.ledger import Ledger, Read, Write
from tests.library import cases


@dataclass
class Told:
    """A service, and the records of its only client."""

    service: Service
    ledger: Ledger
    backups: Path

    def upload(self, data: bytes) -> str:
        asked = self.ledger.ask("upload", sha256(data), data=data)
        answer = self.service.http.post("/demos", params=KESTREL, content=data, headers={"Content-Type": CSV})
        self.ledger.acknowledge(asked, answer.json()["id"])
        return str(answer.json()["id"])

    def read(self) -> None:
        began_s = monotonic()
        answer = self.service.http.get(POLICY)
        body = sha256(answer.content) if answer.status_code == 200 else None
        read = Read("kestrel", began_s, monotonic(), body, answer.headers["etag"].strip('"') if body else None)
        self.ledger.read(read, answer.content if body else None)

    def back_up(self) -> None:
        file = self.backups / f"{len(self.ledger.asks)}.zip"
        asked = self.ledger.ask("backup", file.name)
        back_up(self.service.database, file)
        self.ledger.acknowledge(asked, file.name)

    def withdraw(self) -> None:
        with self.ledger.writing("kestrel", None) as happened:
            happened.append(self.service.http.delete(f"{POLICY}/release").status_code == 204)

    def audit(self) -> Verdict:
        return audit(self.ledger, self.service.http, self.service.database, self.backups, {})


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    """Yield a service in which a style is learnt and released, and the records of all that was asked for."""
    (backups := tmp_path / "backups").mkdir()
    with serving(copy_of_trained(tmp_path)) as service:
        told = Told(service, Ledger(), backups)
        demo = told.upload(cases.hand_off())
        job, policy = service.http.get("/jobs").json()["items"][0]["id"], service.http.get(POLICY).json()["sha256"]
        told.ledger.acknowledge(told.ledger.ask("training", demo), job)
        told.ledger.acknowledge(told.ledger.ask("release", policy), policy)
        with told.ledger.writing("kestrel", policy) as happened:
            happened.append(True)
        told.upload(cases.hand_off((0.1, 0.0, 0.0)))
        told.read()
        yield told


def test_nothing_is_found_where_nothing_is_wrong(told: Told):
    told.upload(cases.hand_off((0.1, 0.0, 0.0)))  # a repetition, which asks for the same thing
    told.ledger.asks.pop()
    told.back_up()
    told.withdraw()
    told.read()
    found = told.audit()
    assert (found.lost, found.doubled, found.wrong, found.given_up) == ([], [], [], [])
    assert found.acknowledged == {"upload": 2, "training": 1, "release": 1, "backup": 1}
    assert found.reads == 3


def test_planted_losses_are_found(told: Told):
    last = "(SELECT max(row) FROM demonstrations)"
    told.service.tamper(
        f"DELETE FROM reward_maps WHERE demonstration_row = {last}",
        f"DELETE FROM demonstrations WHERE row = {last}",
        "DELETE FROM jobs",
        "DELETE FROM releases",
        "UPDATE recording_chunks SET data = zeroblob(length(data))",
    )
    lost = told.audit().lost
    for said in ("demonstration ", "job ", "release ", "recording of demonstration ", "skills verify: "):
        assert any(one.startswith(said) for one in lost), said


@pytest.mark.nightly  # of the audit of `make faults`; by day planted losses are found
def test_a_job_that_never_ends_is_lost(told: Told):
    told.service.tamper("UPDATE jobs SET state = 'running'")
    assert any("still running" in one for one in told.audit().lost)


@pytest.mark.nightly  # of the audit of `make faults`; by day planted losses are found
def test_a_failed_training_is_told_and_is_not_lost(told: Told):
    told.service.tamper("UPDATE jobs SET state = 'failed', error = 'Nobody knows.', result = NULL")
    assert told.audit().given_up == ["Nobody knows."]


@pytest.mark.nightly  # of the audit of `make faults`; by day planted losses are found
def test_a_backup_that_lacks_something_or_is_damaged_is_found(told: Told):
    told.back_up()
    (backup,) = told.backups.iterdir()
    told.upload(cases.hand_off((0.2, 0.0, 0.0)))
    told.ledger.acknowledge(told.ledger.ask("backup", backup.name), backup.name)
    assert any(f"in the backup {backup.name}" in one for one in told.audit().lost)

    backup.write_bytes(backup.read_bytes()[:-100])
    assert any(one.startswith(f"backup {backup.name}") for one in told.audit().lost)


@pytest.mark.nightly  # of the audit of `make faults`; by day planted losses are found
def test_planted_doublings_are_found(told: Told):
    job = (
        "kind, identity, progress, request, result, error, attempt, surgeon_row, plan, requested_by, submitted_at, "
        "created_at, started_at, ended_at"
    )
    release = "policy_row, surgeon_row, suture, released_at, released_by"
    event = "subject, actor, action, object_kind, object_id, at"
    told.service.tamper(
        f"INSERT INTO releases ({release}) SELECT {release} FROM releases",
        f"INSERT INTO jobs (id, state, {job}) SELECT id || 1, 'failed', {job} FROM jobs",
        f"INSERT INTO events (sha256, {event}) SELECT replace(sha256, '0', '1'), {event} FROM events "
        "WHERE action = 'train'",
    )
    told.ledger.asks.pop()  # an upload that nobody asked for
    told.ledger.asks[0].ids.add("another")
    doubled = told.audit().doubled
    for said in ("release ", "training ", "event train", "recording ", "upload "):
        assert any(one.startswith(said) for one in doubled), said


@pytest.mark.nightly  # of the audit of `make faults`; by day planted losses are found
def test_what_was_served_wrongly_is_found(told: Told):
    """A policy after its acknowledged withdrawal, and a document with other numbers."""
    (name,) = told.ledger.bodies
    changed = json.dumps(json.loads(told.ledger.bodies[name]) | {"goal_mm": [0.0, 0.0, 0.0]}).encode()
    read = told.ledger.reads[0]
    told.ledger.read(Read("kestrel", read.began_s, read.ended_s, sha256(changed), sha256(changed)), changed)
    told.withdraw()
    told.service.tamper("UPDATE releases SET withdrawn_at = NULL")
    told.read()
    wrong = told.audit().wrong
    assert any("is not that of version" in one for one in wrong)
    assert any("the last acknowledged release was None" in one for one in wrong)


# ---- the order of reads ------------------------------------------------------------------------------------------

WRITES = (Write("a", 0, 1, 1), Write("b", 10, 12, 12), Write(None, 20, 22, 22), Write("c", 30, None, 40))


@pytest.mark.parametrize(
    ("reads", "wrong"),
    [
        ([(2, 3, "a"), (11, 11.5, "a"), (11, 11.5, "b"), (13, 14, "b")], 0),
        ([(13, 14, "a")], 1),  # an older release than the acknowledged one
        ([(5, 6, "b")], 1),  # not released yet
        ([(10.5, 10.6, "b"), (10.7, 10.8, "a")], 1),  # back behind an earlier answer
        ([(10.5, 10.8, "b"), (10.7, 10.9, "a")], 0),  # at the same time
        ([(23, 24, None), (31, 32, None), (33, 34, "c"), (50, 51, "c")], 0),
        ([(33, 34, "c"), (50, 51, None)], 1),
        ([(50, 51, None)], 0),  # the last release was never acknowledged
        ([(23, 24, "b")], 1),
        ([(-2, -1, None)], 0),
        ([(-2, -1, "a")], 1),
    ],
)
def test_reads_are_judged_as_worked_by_hand(reads: list[tuple[float, float, str | None]], wrong: int):
    given_reads = [Read("kestrel", began_s, ended_s, value, value) for began_s, ended_s, value in reads]
    assert len(wrong_reads(WRITES, given_reads, str, {})) == wrong


moments = st.lists(st.tuples(st.floats(0, 100), st.floats(0, 5), st.floats(0, 1)), max_size=12)


@given(moments)
def test_reads_of_a_register_are_right_at_any_delay(reads: list[tuple[float, float, float]]):
    """Each write takes effect 0.6 into its time, each read somewhere in its own."""
    writes = [Write(str(k), 10.0 * k, 10.0 * k + 2, 10.0 * k + 2) for k in range(10)]

    def at(moment_s: float) -> str | None:
        done = [one.value for one in writes if one.sent_s + 0.6 <= moment_s]
        return done[-1] if done else None

    seen = [Read("kestrel", s, s + long_s, value := at(s + share * long_s), value) for s, long_s, share in reads]
    assert wrong_reads(writes, seen, str, {}) == []
