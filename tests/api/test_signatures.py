"""Signatures of policies and cards: of exactly the bytes that are sent, under the history that covers them."""

import hashlib
from typing import Any

import pytest

from skills.errors import Busy
from skills.library.operation import proofs
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.schemas.people import SurgeonIn
from skills.transparency.signing_keys import SigningKey
from tests.api.service import KESTREL, POLICY, Service, assert_problem
from tests.independent_history import check_envelope, root_in

NPZ = {"Accept": "application/x-npz"}
CARD = f"{POLICY}/versions/1/card"


def key_of(service: Service) -> str:
    return str(service.http.get("/history/checkpoint").json()["verifier"])


def signed(service: Service, path: str) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the digests and the facts of a signature, after a check that shares no code with the service."""
    answer = service.http.get(path)
    assert answer.status_code == 200, answer.text
    said = check_envelope(answer.content, key_of(service))
    root_in(said["predicate"]["checkpoint"], key_of(service))
    return {one["name"]: one["digest"]["sha256"] for one in said["subject"]}, said["predicate"]


def digest(service: Service, path: str, **headers: str) -> str:
    return hashlib.sha256(service.http.get(path, headers=headers).content).hexdigest()


def test_the_signature_of_a_policy_covers_every_file_of_it(trained: Service):
    files, facts = signed(trained, f"{POLICY}/signature")
    sha256 = trained.http.get(POLICY).json()["sha256"]
    assert facts.pop("checkpoint")
    assert facts == {**KESTREL, "kind": "policy", "version": 1, "policy": sha256}
    assert files["policy.json"] == digest(trained, POLICY)
    assert files["policy.npz"] == digest(trained, POLICY, **NPZ) == digest(trained, f"/policy-versions/{sha256}", **NPZ)
    assert files["policy-version.json"] == digest(trained, f"{POLICY}/versions/1")
    if "pose-style.json" in files:
        assert files["pose-style.json"] == digest(trained, f"{POLICY}/pose-style")


def test_a_signature_is_made_once_and_again_after_a_release(trained: Service, monkeypatch: pytest.MonkeyPatch):
    made: list[bytes] = []
    sign = SigningKey.signature_of
    monkeypatch.setattr(SigningKey, "signature_of", lambda key, message: made.append(message) or sign(key, message))
    path = f"{POLICY}/signature"
    first = trained.http.get(path)
    statements = len(made)
    assert trained.http.get(path).content == first.content
    tag = {"If-None-Match": first.headers["etag"]}
    assert trained.http.get(path, headers=tag).status_code == 304
    assert len(made) == statements  # nothing is signed for an answer from memory
    trained.client.withdraw(**KESTREL)
    assert_problem(trained.http.get(path), 404)
    trained.client.release(**KESTREL, version=1)
    files, _ = signed(trained, path)
    assert files["policy.json"] == digest(trained, POLICY)


def test_new_rows_are_signed_first_and_keep_the_first_head_covering_them(
    trained: Service, monkeypatch: pytest.MonkeyPatch
):
    def added(slug: str) -> tuple[str, int]:
        with trained.database.writing() as session:
            put_surgeon(session, slug, SurgeonIn(), "test")
            return "surgeons", find_surgeon(session, slug).row

    first = added("heron")
    with monkeypatch.context() as busy:
        busy.setattr(proofs, "sign_history", lambda *_: None)
        with pytest.raises(Busy, match="not signed up to these rows yet"):
            proofs.head_over(trained.database, [first])
    head = proofs.head_over(trained.database, [first])
    second = added("wren")
    later = proofs.head_over(trained.database, [first, second])
    assert later.checkpoint.size > head.checkpoint.size
    assert proofs.head_over(trained.database, [first]) == head
    assert proofs.head_over(trained.database, [second, first]) == later


def test_the_card_has_the_history_on_it_and_is_signed(trained: Service):
    card = trained.http.get(CARD).json()["history"]
    size, root = root_in(card["note"], key_of(trained))
    assert (card["size"], card["root"]) == (size, root.hex())
    page = trained.http.get(CARD, headers={"Accept": "text/html"}).text
    assert f"{size} leaves" in page and root.hex() in page
    files, facts = signed(trained, f"{CARD}/signature")
    assert files == {"card.json": digest(trained, CARD), "card.html": digest(trained, CARD, Accept="text/html")}
    assert (facts["kind"], facts["checkpoint"]) == ("card", card["note"])
    assert_problem(trained.http.get(f"{POLICY}/versions/9/card/signature"), 404)


PAST = [("releases", "released_by = 'ada'"), ("policy_versions", "releasable = 1 - releasable")]


@pytest.mark.parametrize(("table", "change"), PAST)
def test_a_row_that_was_written_past_the_service_is_not_signed(trained: Service, table: str, change: str):
    with trained.app.state.database.engine.connect() as connection:
        connection.exec_driver_sql(f"DROP TRIGGER {table}_append_only")
        connection.exec_driver_sql(f"UPDATE {table} SET {change}")
        connection.commit()
    answer = trained.http.get(f"{POLICY}/signature")
    assert_problem(answer, 503)
    assert f"A row of {table} is not as the history has it" in answer.json()["detail"]
