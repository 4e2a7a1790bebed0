"""`/proposals`, and the decision on one: for clients, programs and commands."""

from contextlib import nullcontext

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.client import Client, Problem
from skills.seeds.recordings import sample_recordings
from tests.api.service import Service, assert_problem
from tests.library import cases

FIVE = next(one for one in sample_recordings() if len(one.segments) == 5)
HOW = {"surgeon": "kestrel", "suture": cases.SUTURE}


def test_proposals_are_listed_accepted_rejected_and_opened_again(service: Service):
    service.client.put_surgeon("kestrel")
    client = Client(service.http)
    recording = client.add_recording(FIVE.data, surgeon="kestrel").id
    one, two, *_ = client.proposals("open")
    assert (one.recording, one.number, one.surgeon, one.demo) == (recording, 1, "kestrel", None)
    assert one.reasons and one.found_by == "jaw" and one.confidence is None
    demo = client.cut_demo(
        recording, **HOW, arm=one.arm, start_s=one.start_s + 0.1, end_s=one.end_s, outcome="failure",
        outcome_reason="The needle fell.",
    )  # fmt: skip
    rejected = client.decide_proposal(recording[:12], two.number, "rejected", note="Only regrasped.")
    assert (rejected.state, rejected.note) == ("rejected", "Only regrasped.")
    (accepted,) = client.proposals(suture=cases.SUTURE)
    assert (accepted.state, accepted.demo, accepted.outcome) == ("accepted", demo.id, "failure")
    assert accepted.note == "The needle fell."
    assert [item.number for item in client.proposals("open", recording=recording)] == [3, 4, 5]
    assert client.decide_proposal(recording, two.number, "open").state == "open"
    with pytest.raises(Problem, match="was accepted"):
        client.decide_proposal(recording, 1, "rejected")
    where = f"/recordings/{recording}/proposals"
    assert_problem(service.http.put(f"{where}/6", json={"state": "rejected"}), 404, "not-found")
    assert_problem(service.http.put(f"{where}/2", json={"state": "accepted"}), 422)
    page = service.http.get("/proposals", params={"limit": 2, "state": "open"})
    assert [item["number"] for item in page.json()["items"]] == [2, 3]
    rest = service.http.get("/proposals" + page.headers["Link"].split(">")[0].strip("<"))
    assert [item["number"] for item in rest.json()["items"]] == [4, 5]


def test_commands_list_accept_correct_and_reject(service: Service, monkeypatch: pytest.MonkeyPatch):
    service.client.put_surgeon("kestrel")
    recording = service.client.add_recording(FIVE.data)["id"]
    monkeypatch.setattr("skills.cli.recordings.service", lambda: nullcontext(Client(service.http)))

    def run(*words: str) -> str:
        done = CliRunner().invoke(app, ["proposal", *words])
        assert done.exit_code == 0, done.output
        return done.output

    assert run("list").count(recording[:12]) == 5
    run("accept", recording, "1", "--surgeon", "kestrel", "--suture", cases.SUTURE, "--end-s", str(FIVE.segments[0][1]))
    assert "rejected" in run("reject", recording, "2", "--note", "idle")
    assert "idle" in run("list", "--state", "rejected")
    assert "open" in run("open", recording, "2")
    assert run("list", "--state", "open").count(recording[:12]) == 4
    done = CliRunner().invoke(app, ["proposal", "accept", recording, "9", "--surgeon", "kestrel", "--suture", "x"])
    assert done.exit_code == 1 and "It has 5" in done.output
