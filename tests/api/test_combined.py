"""Several demonstrations over HTTP: requested, learnt, reported, fetched, verified, drawn and withdrawn."""

from typing import get_args, get_type_hints

import pytest

import skills
from skills.client import Client, policies
from skills.comparison.combining import COMBININGS
from skills.schemas.policies import Combined
from skills.schemas.training import CombineIn
from tests.api.service import CSV, KESTREL, POLICY, Service, assert_problem
from tests.by_day import some
from tests.library import cases

KINDS = pytest.mark.parametrize("kind", some(["corridor", "medoid", "barycentre"], 3))


def demos_of(service: Service) -> list[str]:
    """Add two demonstrations to the existing one, and return the ids of all, the oldest first."""
    for shift in ((0.0, 3.0, 0.0), (0.0, 1.5, 0.5)):
        service.client.add_demo(cases.hand_off(shift), media_type=CSV, **KESTREL)
    return [demo["id"] for demo in service.client.demos()][::-1]


@KINDS
def test_several_are_learnt_told_of_and_checked_by_a_client(trained: Service, kind: str):
    demos = demos_of(trained)
    job = trained.train(demos=demos, combine=kind, release=True)
    assert (job["request"]["demos"], job["request"]["combine"]) == (demos, {"kind": kind})
    assert job["result"]["released"], job
    said = Client(trained.http).policy(**KESTREL)
    assert (said.demos, said.combined.kind, said.combined.medoid) == (demos, kind, demos[2])
    assert len(said.combined.width_mm) == len(said.waypoints)
    policy = Client(trained.http).learnt(**KESTREL)  # compares the policy with its digest
    assert skills.rollout(policy, said.start_mm).states.tolist() == said.waypoints


@KINDS
def test_its_view_and_its_card_show_the_way_that_is_followed(trained: Service, kind: str):
    demos = demos_of(trained)
    trained.train(demos=demos, combine=kind)
    view = trained.http.get(f"/pages/styles/kestrel/{cases.SUTURE}/versions/2/view").json()
    assert len(view["path_mm"]) == len(trained.client.get_json(f"{POLICY}/versions/2")["waypoints"])
    card = trained.client.get_json(f"{POLICY}/versions/2/card")
    assert [one["sha256"] for one in card["demonstrations"]] == demos
    assert card["combined"]["in_words"] in card["what_it_is"]
    page = trained.http.get(f"{POLICY}/versions/2/card", headers={"Accept": "text/html"}).text
    assert "Quality of demonstration 3" in page
    assert page.count('<g class="corridor">') == 3  # one in each view
    style = trained.http.get(f"/pages/styles/kestrel/{cases.SUTURE}?version=2").text
    assert f"3 demonstrations, {kind}" in style


def test_one_alone_says_nothing_of_combining(trained: Service):
    assert trained.client.get_json(POLICY)["combined"] is None
    assert Client(trained.http).policy(**KESTREL).combined is None


def test_withdrawing_one_of_them_takes_the_policy_away(trained: Service):
    demos = demos_of(trained)
    trained.train(demos=demos, release=True)
    trained.client.withdraw_demo(demos[0])
    assert_problem(trained.http.get(POLICY), 404, "not-found")


@pytest.mark.parametrize(
    ("combine", "why"),
    [({"kind": "mean"}, "kind"), ({"kind": "medoid", "rounds": 3}, "has an unknown field"), ("medoid", "combine")],
)
def test_a_way_of_combining_that_there_is_not_is_refused(trained: Service, combine, why):
    answer = trained.http.post("/trainings", json=KESTREL | {"demos": demos_of(trained), "combine": combine})
    assert why in str(assert_problem(answer, 422))


def test_one_demonstration_is_not_combined(trained: Service):
    answer = trained.http.post("/trainings", json=KESTREL | {"combine": {"kind": "corridor"}})
    assert "name several" in assert_problem(answer, 422)["detail"]


def test_whoever_asks_may_choose_among_all_ways_that_there_are():
    asked = get_args(CombineIn.model_fields["kind"].annotation)
    assert asked == get_args(policies.Combining) == get_args(get_type_hints(Combined)["kind"]) == COMBININGS
