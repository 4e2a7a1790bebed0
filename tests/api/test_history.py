"""Which version was served at a time, with proofs that are checked without the package."""

from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select

from skills.db import now, rfc3339
from skills.db.models import Release
from skills.library.operation.history import sign_history
from skills.library.people.surgeons import find_surgeon
from skills.library.policies.releases import withdraw
from tests.api.service import Service, assert_problem
from tests.independent_history import check_disclosed, root_in


def asked(service: Service, **given: str) -> Any:
    return service.http.get("/history", params={"surgeon": "kestrel", "suture": "simple-running", **given})


def served(service: Service, at: str) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return the answer, and the release and the policy that it proves."""
    answer = asked(service, at=at)
    assert answer.status_code == 200, answer.text
    said = answer.json()
    head = said["checkpoint"]
    assert [one["table"] for one in said["proofs"]] == ["releases", "policy_versions"]
    release, policy = (check_disclosed(one, head["note"], head["verifier"]) for one in said["proofs"])
    assert policy["row"] == release["policy_row"]
    assert policy["sha256"] == said["policy"]
    return said, release, policy


def test_who_was_served_which_version_at_a_time_is_proven(trained: Service):
    database = trained.app.state.database
    sign_history(database)
    with database.reading() as session:
        released_at = session.scalars(select(Release.released_at).order_by(Release.row)).all()[-1]
    assert_problem(asked(trained, at="2020-01-01T00:00:00Z"), 404)
    said, release, _ = served(trained, rfc3339(now()) or "")
    assert release["released_at"] == released_at.isoformat()
    assert release["withdrawn_at"] is None
    assert release["suture"] == said["suture"] == "simple-running"
    with database.writing() as session:
        withdraw(session, find_surgeon(session, "kestrel"), "simple-running", "test")
    assert_problem(asked(trained, at=rfc3339(released_at) or ""), 503, "busy")  # its new leaf is not signed yet
    sign_history(database)
    again, withdrawn, _ = served(trained, rfc3339(released_at) or "")
    assert again["policy"] == said["policy"]
    assert withdrawn["withdrawn_at"] is not None
    assert_problem(asked(trained, at=rfc3339(now() + timedelta(seconds=1)) or ""), 404)


def test_a_proof_that_was_changed_anywhere_is_refused(trained: Service):
    sign_history(trained.app.state.database)
    said, _, _ = served(trained, rfc3339(now()) or "")
    head, proof = said["checkpoint"], said["proofs"][0]
    changed = [
        {"disclosed": {**proof["disclosed"], "policy_row": "json99"}},
        {"digests": {**proof["digests"], "suture": "0" * 32}},
        {"entry": proof["entry"].replace('"add"', '"change"')},
        {"number": proof["number"] ^ 1},
        {"hashes": proof["hashes"][:-1]},
        {"hashes": ["0" * 64, *proof["hashes"][1:]]},
        {"salt": "0" * 64},
    ]
    for wrong in changed:
        with pytest.raises(AssertionError):
            check_disclosed(proof | wrong, head["note"], head["verifier"])
    other = head["note"].replace("suture-skills/", "suture-skills/0", 1)
    with pytest.raises(AssertionError):
        check_disclosed(proof, other, head["verifier"])


def test_the_newest_checkpoint_is_signed_by_the_key_that_is_named(trained: Service):
    sign_history(trained.app.state.database)
    head = trained.http.get("/history/checkpoint").json()
    assert trained.client.checkpoint() == head
    served_now = trained.client.served_at("kestrel", "simple-running", now())
    assert served_now["policy"] == trained.client.policy("kestrel", "simple-running")["sha256"]
    size, _ = root_in(head["note"], head["verifier"])
    assert size > 0


@pytest.mark.parametrize("at", ["2026-01-01", "2026-01-01T00:00:00", "yesterday", "9999-99-99T00:00:00Z"])
def test_a_time_without_its_zone_is_refused(trained: Service, at: str):
    assert_problem(asked(trained, at=at), 422)
