"""Digest prefixes: accepted in place of a digest everywhere, if they are unambiguous."""

import pytest

from skills.client import Problem
from tests.api.service import KESTREL, Service, assert_problem
from tests.library import cases


def test_the_beginning_of_a_digest_finds_what_the_whole_one_finds(trained: Service):
    client = trained.client
    (demo,) = client.demos()
    plan = client.plan(**KESTREL, suture_points=[{"position_mm": [5.0, 55.0, -125.0]}], handoff="none")
    policy = client.policy(**KESTREL)["sha256"]
    for path, digest in (
        ("/demos/{}", demo["id"]),
        ("/demos/{}/path", demo["id"]),
        ("/demos/{}/report", demo["id"]),
        ("/recordings/{}", demo["recording"]),
        ("/plans/{}", plan["id"]),
        ("/plans/{}/trajectory", plan["id"]),
        ("/policy-versions/{}", policy),
        ("/demos?recording={}", demo["recording"]),
    ):
        whole = trained.http.get(path.format(digest))
        short = trained.http.get(path.format(digest[:12]))
        assert (whole.status_code, short.status_code, short.content) == (200, 200, whole.content), path
        assert_problem(trained.http.get(path.format(digest[:7])), 422)
    whole, short = (client.train(**KESTREL, demos=[demo["id"][:length]]) for length in (64, 10))
    assert (short["id"], short["request"]["demos"]) == (whole["id"], [demo["id"]])
    assert client.play(plan["id"][:9])["request"]["plan"] == plan["id"]
    compared = client.compare(plan["id"][:8], demo["id"][:8])
    assert (compared["plan"], compared["demo"]) == (plan["id"], demo["id"])
    scored = client.score(**KESTREL, demo=demo["id"][:8], reference=demo["id"][:8])
    assert scored["reference"]["demo"] == demo["id"]


def test_a_digest_prefix_withdraws_a_demo_and_erases_it_with_its_jobs(trained: Service):
    (demo,) = trained.client.demos()
    trained.client.withdraw_demo(demo["id"][:8])
    assert trained.client.demo(demo["id"])["state"] == "withdrawn"
    trained.client.withdraw_demo(demo["id"][:8], erase=True)
    assert trained.client.demos() == []
    jobs = [job for job in trained.client.jobs() if demo["id"] in str(job)]
    assert jobs == [], "the jobs that learnt from it are deleted too"


def test_a_beginning_that_several_share_lists_them(trained: Service):
    trained.client.put_surgeon("wren")
    trained.client.add_demo(cases.hand_off(), media_type="text/csv", surgeon="wren", suture=cases.SUTURE)
    one, other = (demo["id"] for demo in trained.client.demos())
    twin = one[:20] + other[20:]
    trained.tamper("UPDATE demonstrations SET sha256 = :twin WHERE sha256 = :other", twin=twin, other=other)
    with pytest.raises(Problem) as refused:
        trained.client.demo(one[:20])
    assert (refused.value.status, refused.value.kind) == (422, "ambiguous-digest")
    assert sorted(refused.value.numbers["candidates"]) == sorted([one, twin])
    assert one in str(refused.value) and twin in str(refused.value) and "Give more" in str(refused.value)
    assert trained.client.demo(one)["id"] == one
