"""A policy learnt from several demonstrations: its dependencies, and the effect of removing one of them."""

from pathlib import Path

import numpy as np
import pytest

from skills.comparison.combining import COMBININGS
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, Release
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound
from skills.formats.parsed import parse_recording
from skills.learning.evaluation import dtw
from skills.library.operation.backup import back_up, restore
from skills.library.operation.inspection import inspect_policies
from skills.library.operation.integrity import learnt
from skills.library.operation.styles import matrix
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.plans.plans import hand_of, trajectory_of
from skills.library.policies import training
from skills.library.policies.cards import card_of
from skills.library.policies.combined import learnt_from
from skills.library.policies.releases import release
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.versions import find_by_digest
from skills.library.recordings.demos import upload_demo, withdraw_demo
from skills.schemas.demos import DemoIn
from skills.settings import Settings
from skills.verification.intent import compare
from skills.verification.requested import requested_motion
from tests import backends
from tests.library import cases
from tests.library.cases import wrong
from tests.library.styles import counted, retrain, served

SHIFTS_MM = ((0.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 1.5, 0.5))
GONE = pytest.mark.parametrize(  # the demonstration that the policy's row names, and another one
    ("how", "gone"), [("medoid", 2), ("medoid", 0), ("corridor", 2), ("corridor", 1)], ids=str
)
HOWS = pytest.mark.parametrize("how", COMBININGS)


def add_three(database: Database) -> list[Demonstration]:
    return [cases.add_demo(database, cases.hand_off(shift)) for shift in SHIFTS_MM]


def train(database: Database, demos: list[Demonstration], **asked) -> PolicyVersion:
    return cases.train(database, demos=[demo.sha256 for demo in demos], **asked)


@HOWS
def test_it_names_all_of_them_passes_the_gate_and_is_verified(database: Database, how):
    demos = add_three(database)
    version = train(database, demos, combine=how, release=True)
    assert version.manifest.demos == [demo.sha256 for demo in demos]
    assert (version.releasable, served(database), wrong(database)) == (True, [1], [])
    assert counted(database, PolicyDemonstration) == 2
    with database.reading() as session:
        stored = find_by_digest(session, version.sha256)
        assert [one.sha256 for one in stored.demonstrations] == version.manifest.demos
        assert digest(learnt_from(stored).path) == digest(learnt(stored).path)
    said = version.manifest.combined
    assert said.kind == how
    assert len(said.width_mm) == len(version.manifest.waypoints)
    assert len(said.apart_mm) == 3


def test_demos_are_combined_as_a_corridor_by_default_in_any_order(database: Database):
    demos = add_three(database)
    job = cases.ask_training(database, demos=[demo.sha256 for demo in demos])
    again = cases.ask_training(database, demos=[demo.sha256 for demo in demos[::-1]], combine="corridor")
    assert job.request["combine"] == {"kind": "corridor"}
    assert again.row == job.row


def test_the_medoid_is_one_of_them_and_its_path_that_ones(database: Database):
    demos = add_three(database)
    version = train(database, demos, combine="medoid")
    assert version.manifest.combined.medoid == demos[2].sha256  # which lies between the others
    with database.reading() as session:
        stored = find_by_digest(session, version.sha256)
        assert stored.demonstration.sha256 == demos[2].sha256
        assert digest(stored.learnt.path) == digest(stored.demonstration.path)


def test_the_middle_lies_between_the_demonstrations(database: Database):
    demos = add_three(database)
    version = train(database, demos, combine="barycentre")
    with database.reading() as session:
        way = learnt_from(find_by_digest(session, version.sha256)).demo
    between = cases.points_mm((0.0, 1.5, 0.5))
    assert dtw(way.tip_mm, between).differences_mm.sum(axis=1).mean() < 1.0


@GONE
def test_withdrawing_any_of_the_demos_withdraws_and_blocks_the_release(database: Database, how, gone):
    demos = add_three(database)
    version = train(database, demos, combine=how, release=True)
    with database.writing() as session:
        assert len(withdraw_demo(session, demos[gone].sha256, "test")) == 1
    assert served(database) == []
    with pytest.raises(Conflict, match="withdrawn"), database.writing() as session:
        release(session, find_by_digest(session, version.sha256), "test")
    assert wrong(database) == []


@GONE
def test_erasing_any_of_them_erases_the_policy(database: Database, how, gone):
    demos = add_three(database)
    train(database, demos, combine=how, release=True)
    cases.add_plan(database)
    with database.writing() as session:
        assert erase_demo(session, demos[gone].sha256, "test") == []  # no unfinished job depends on it
    assert [counted(database, table) for table in (PolicyVersion, PolicyDemonstration, Release)] == [0, 0, 0]
    assert counted(database, Demonstration) == 2
    assert wrong(database) == []


@pytest.mark.parametrize(
    ("leave", "why"),
    [
        (withdraw_demo, "A demonstration was withdrawn while the training used it."),
        (erase_demo, "A demonstration was erased while the training used it."),
    ],
)
def test_one_that_leaves_while_it_is_learnt_from_leaves_no_policy(database: Database, leave, why):
    demos = add_three(database)
    job = cases.ask_training(database, demos=[demo.sha256 for demo in demos])
    request = TrainingRequest.model_validate(job.request)
    with database.reading() as session:
        read = training.lessons(session, [demo.row for demo in demos])
    learnt_meanwhile = training.learn_style(
        training.combined_lesson(read, request.combine), request, Settings(database_url=database.url)
    )
    cases.committed(database, leave, demos[0].sha256, "test")
    with pytest.raises((Conflict, NotFound), match=why), database.writing() as session:
        training.store_style(session, learnt_meanwhile)
    assert counted(database, PolicyVersion) == 0


def test_the_overview_does_not_wait_for_a_training_of_what_is_among_them(database: Database):
    first, last, between = SHIFTS_MM
    demos = [cases.add_demo(database, cases.hand_off(shift)) for shift in (first, between, last)]
    assert train(database, demos, combine="medoid").demonstration_row == demos[1].row  # and that is not the newest
    for waits in (False, True):
        with database.reading() as session:
            (row,) = [styles for surgeon, styles in matrix(session).rows if surgeon.slug == "kestrel"]
            assert [style.waiting for style in row if style.suture == cases.SUTURE] == [waits]
        cases.add_demo(database, cases.hand_off((0.0, 0.0, 2.0)))


def test_erasing_the_surgeon_leaves_nothing(database: Database):
    train(database, add_three(database), release=True)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    assert [counted(database, table) for table in (PolicyVersion, PolicyDemonstration, Demonstration)] == [0, 0, 0]


@HOWS
def test_a_plan_follows_it_and_a_card_tells_of_it(database: Database, how):
    demos = add_three(database)
    version = train(database, demos, combine=how, release=True)
    plan = cases.add_plan(database)
    with database.reading() as session:
        stored = find_by_digest(session, version.sha256)
        followed, card = learnt_from(stored).demo, card_of(session, stored)
        assert np.abs(plan.plan.passes[0].tip_mm[-1] - [5.0, 55.0, -125.0]).max() < 1e-9
        assert dtw(plan.plan.passes[0].tip_mm, followed.tip_mm).differences_mm.sum(axis=1).mean() < 5.0
        asked = requested_motion(plan.plan, learnt(stored), hand_of(stored))
    assert all(one.value <= one.limit for one in compare(asked, trajectory_of(plan.plan)).greatest)
    assert "3 recorded demonstrations" in card.facts.what_it_is[0]
    assert card.facts.combined.kind == how
    links = [(link.what, link.sha256) for link in card.facts.lineage.chain]
    assert [sha256 for what, sha256 in links if what == "demonstration"] == version.manifest.demos
    assert links[-1] == ("policy", version.sha256)


def test_a_style_that_used_its_newest_demo_among_others_is_not_stale(database: Database):
    demos = add_three(database)
    train(database, demos, combine="medoid")
    assert retrain(database, only_stale=True).request["styles"] == 0
    cases.add_demo(database, cases.hand_off((0.0, 0.0, 2.0)))
    assert retrain(database, only_stale=True).request["styles"] == 1


def test_what_cannot_be_combined_is_refused_before_a_job_is_made(database: Database):
    one, two, _ = add_three(database)
    bag = cases.upload(cases.bag("PSM1"), "application/vnd.mcap")
    other_arm = upload_demo(database, bag, DemoIn(surgeon="kestrel", suture=cases.SUTURE), "test").row
    cases.add_surgeon(database, "heron")
    herons = cases.add_demo(database, surgeon="heron")
    for demos, how, why in (
        ([one, one], None, "named twice"),
        ([one, other_arm], None, "one arm"),
        ([one, herons], None, "another style"),
        ([one], "medoid", "is not combined"),
        ([one, two] * 26, None, "At most 50"),
    ):
        with pytest.raises(BadInput, match=why):
            cases.ask_training(database, demos=[demo.sha256 for demo in demos], combine=how)
    cases.committed(database, withdraw_demo, two.sha256, "test")
    with pytest.raises(Conflict, match="withdrawn"):
        cases.ask_training(database, demos=[one.sha256, two.sha256])


def test_one_alone_is_asked_for_and_known_as_it_always_was(database: Database):
    demo, *_ = add_three(database)
    version = cases.train(database, demos=[demo.sha256])
    assert version.manifest.combined is None
    assert version.sha256 == cases.train(database, demos=[demo.sha256]).sha256
    assert "combine" not in cases.ask_training(database, demos=[demo.sha256]).request


def test_others_than_its_own_demonstrations_are_found(database: Database):
    demos = add_three(database)
    version = train(database, demos[:2])
    with database.writing() as session:
        session.add(PolicyDemonstration(policy_row=version.row, demonstration_row=demos[2].row))
    assert [why for _, why in wrong(database)] == [
        "it was learnt from another demonstration",
        "its path differs from that of its demonstration",
    ]
    other = "stored with other demonstrations than its manifest names"
    relearn = Settings(database_url=database.url)
    parts = {part.what: part.left_out for part in inspect_policies(database, parse_recording, relearn)}
    assert parts == {
        "policies learnt again": [("policy_versions 1", f"{other}, not learnt again")],
        "certificates": [("policy_versions 1", f"{other}, its certificate was not computed again")],
    }


@pytest.mark.nightly  # by day other restores
def test_a_combined_policy_is_restored_with_its_demos_on_another_back_end(database: Database, tmp_path: Path):
    demos = add_three(database)
    train(database, demos, release=True)
    back_up(database, tmp_path / "all.zip")
    with backends.opened(backends.blank(backends.OTHER[database.engine.dialect.name], tmp_path)) as other:
        restore(other, tmp_path / "all.zip")
        assert (counted(other, PolicyDemonstration), served(other), wrong(other)) == (2, [1], [])
        with other.writing() as session:
            withdraw_demo(session, demos[0].sha256, "test")
        assert served(other) == []
