"""The gate before the bag, and the bag's content, on both back ends."""

import io
import json
import math
import zipfile
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic_core import to_jsonable_python
from sqlalchemy import select, update

from skills.db.leaves import newest_checkpoint
from skills.db.models import Plan, StoredPlayback
from skills.db.packed import digest as digest_of
from skills.db.session import Database
from skills.errors import BadPlan, Conflict, Corrupt, NotFound
from skills.formats.replay_bag import arms_of
from skills.formats.verify import verify_bag
from skills.library.operation.history import sign_history
from skills.library.operation.integrity import planned
from skills.library.people.surgeons import find_surgeon
from skills.library.plans import plans, replay
from skills.library.plans.description import describe_motion
from skills.library.plans.headline import CHECK_VERSION
from skills.library.plans.plans import find_plan, plan_sutures, trajectory_of
from skills.library.plans.replay import describe_segments, replay_bag
from skills.library.plans.replay_gate import ReplayConditions, check_probability, cleared
from skills.library.policies import releases
from skills.library.policies.versions import find_version
from skills.library.recordings.demos import withdraw_demo
from skills.planning.plan import SuturePlan
from skills.planning.trajectory import Trajectory
from skills.schemas.plans import PlanIn
from skills.transparency.notes import read_notes
from skills.transparency.signing_keys import PublicKey
from skills.verification.arm_errors import CALIBRATED, UNCALIBRATED
from skills.verification.clearance import psm_m_poses
from skills.verification.probabilities import JUDGE_VERSION
from tests.independent_history import check_envelope
from tests.library import cases
from tests.library.attacks import tampering
from tests.library.verdicts import doubt_of, verdict_on
from tests.planning.motions import ideal_playback

ASKED: dict[str, Any] = {"errors": UNCALIBRATED, "lower_bound": 0.9}
OF_A1_ALONE = ReplayConditions(**ASKED, handoff="none")


def judged(database: Database, plan: Plan, *, feasible: bool = True, digest: str | None = None, **more: Any) -> str:
    """Store a verdict on a plan as a playback does."""
    words = None if feasible else "Pass 0, A1, sample 3 (0.015 s): clearance to the pad is -2 mm, the limit is 1."
    with database.reading() as session:
        trajectory = trajectory_of(find_plan(session, plan.sha256).plan)
    measured = ideal_playback(trajectory)
    if trajectory.psm_m is not None:
        tip_mm, apart_mm = psm_m_poses(trajectory, measured.looked_at)[0], np.full((len(trajectory), 24), 5.0)
        measured = replace(measured, psm_m_tip_mm=tip_mm, clearances_mm=apart_mm)
    chosen = {"feasible": feasible, "failure_sentence": words, "trajectory": digest_of(trajectory)} | more
    report = verdict_on(plan.sha256, trajectory, measured, **chosen)
    identity = digest or report.identity
    with database.writing() as session:
        row = find_plan(session, plan.sha256)
        session.add(StoredPlayback(sha256=identity, plan=row, feasible=feasible, report=report, measured=measured))
    return identity


def gate(database: Database, plan: Plan, **asked: Any) -> str:
    with database.reading() as session:
        row = find_plan(session, plan.sha256)
        return cleared(session, row, planned(row), replace(OF_A1_ALONE, **asked)).sha256


def refused(database: Database, plan: Plan, words: str, **asked: Any) -> None:
    """Check that the gate refuses a plan in these words."""
    with pytest.raises(Conflict, match=words):
        gate(database, plan, **asked)


@pytest.fixture
def plan(database: Database) -> Plan:
    """Return a plan of the released policy, not played yet."""
    cases.trained(database, release=True)
    return cases.add_plan(database)


# ---- the gate


def test_a_plan_is_cleared_by_its_own_newest_feasible_playback(database: Database, plan: Plan):
    refused(database, plan, r"not played in the simulator yet. Play it: client.play\(")
    other = cases.add_plan(database, speed_mm_s=10.0)
    judged(database, other)
    refused(database, plan, "not played")
    first = judged(database, plan)
    assert gate(database, plan) == first
    newer = judged(database, plan, samples=7)
    assert gate(database, plan) == newer
    judged(database, plan, estimate=doubt_of(0.5))
    refused(database, plan, r"only 0.500, and 0.9 is required")
    gate(database, plan, lower_bound=0.5)
    judged(database, plan, feasible=False)
    refused(database, plan, "infeasible: Pass 0, A1, sample 3")
    judged(database, plan, digest="1" * 64)
    with pytest.raises(Corrupt, match="verdict"):
        gate(database, plan)


@pytest.mark.parametrize("other", [CHECK_VERSION - 1, CHECK_VERSION + 1])
def test_a_verdict_of_another_version_of_the_checks_opens_no_bag(database: Database, plan: Plan, other: int):
    judged(database, plan, check_version=other)
    refused(database, plan, "judged by another version of the checks; play it again")
    judged(database, plan)
    gate(database, plan)


def test_a_bag_without_a_hand_off_is_given_only_on_request(database: Database, plan: Plan):
    judged(database, plan)
    refused(database, plan, "has no hand-off: no PSM_M, no A2", handoff=None)
    both = cases.add_plan(database, psm_m={"approach": (-0.94, 0.1, -0.33)})
    judged(database, both)
    gate(database, both, handoff=None)


def test_a_motion_that_was_compared_with_no_tissue_is_not_exported(database: Database, plan: Plan):
    without = cases.add_plan(database, tissue_mm=None)
    judged(database, without)
    refused(database, without, r"tissue: not given. Plan again with tissue_mm")
    assert "Tissue: not given" in describe_motion(without.about)
    box = {"frame": "PSM_base", "boxes": [{"low_mm": (90.0, 0.0, 0.0), "high_mm": (95.0, 1.0, 1.0)}]}
    obstacles = cases.add_plan(database, tissue_mm=None, scene=box)
    judged(database, obstacles)
    refused(database, obstacles, "tissue: not given")
    level = cases.add_plan(database, scene=box)
    assert level.plan.scene is not None
    assert (len(level.plan.scene.boxes), level.plan.scene.tissue.at_mm) == (1, (0.0, 0.0, -170.0))
    judged(database, level)
    gate(database, level)


def test_tissue_is_stated_once_and_in_millimetres(database: Database, plan: Plan):
    level = {"at_mm": (0.0, 0.0, -160.0), "normal": (0.0, 0.0, 1.0), "along": (1.0, 0.0, 0.0)}
    with pytest.raises(BadPlan, match="has tissue_mm, and its scene has tissue"):
        cases.add_plan(database, scene={"frame": "PSM_base", "tissue": level})
    with pytest.raises(BadPlan, match=r"seems to be in metres. Give -170 mm"):
        cases.add_plan(database, tissue_mm=-0.17)


def test_only_a_plan_that_follows_the_released_policy_is_replayed(database: Database, plan: Plan):
    judged(database, plan)
    with database.writing() as session:
        releases.withdraw(session, find_surgeon(session, "kestrel"), cases.SUTURE, "test")
    refused(database, plan, "follows version 1 of the policy, and none is released")
    with database.writing() as session:
        releases.release(session, find_version(session, "kestrel", cases.SUTURE, 1), "test")
    gate(database, plan)
    cases.train(database, seed=1, release=True)
    refused(database, plan, "follows version 1 of the policy, and version 2 is released")
    newer = cases.add_plan(database)
    judged(database, newer)
    gate(database, newer)


def test_consent_and_the_demonstration_have_to_stand(database: Database, plan: Plan):
    judged(database, plan)
    for consent, words in (
        ({"uses": ["training"]}, "does not cover export"),
        ({"uses": ["export"]}, "does not cover training"),
        ({"uses": ["training", "export"], "until": "2001-01-01"}, "expired on 2001-01-01"),
    ):
        cases.committed(database, cases.agree, consent)
        refused(database, plan, words)
    with database.writing() as session:
        cases.agree(session, {"uses": ["training", "export"]})
        with pytest.raises(Conflict, match="none is released"):  # because consent to training had ended
            cleared(session, row := find_plan(session, plan.sha256), planned(row), OF_A1_ALONE)
        releases.release(session, find_version(session, "kestrel", cases.SUTURE, 1), "test")
    gate(database, plan)
    with database.writing() as session:
        withdraw_demo(session, find_plan(session, plan.sha256).policy.demonstration.sha256, "test")
    refused(database, plan, "demonstration that this plan depends on was withdrawn")


def test_consent_that_is_withdrawn_while_a_bag_is_composed_is_seen(
    database: Database, plan: Plan, monkeypatch: pytest.MonkeyPatch
):
    judged(database, plan)
    composed = replay.seal

    def withdrawn(members: dict[str, bytes]) -> bytes:
        cases.committed(database, cases.agree, {"uses": ["training"], "until": None})
        return composed(members)

    assert replay_bag(database, plan.sha256, OF_A1_ALONE)
    monkeypatch.setattr(replay, "seal", withdrawn)
    with pytest.raises(Conflict, match="does not cover export"):
        replay_bag(database, plan.sha256, OF_A1_ALONE)


@pytest.mark.parametrize(
    ("stored", "asked", "words"),
    [
        ({"estimate": doubt_of(0.95)}, {}, None),
        ({"estimate": doubt_of(0.9)}, {}, None),
        ({"estimate": doubt_of(0.95, 0.91)}, {}, None),
        ({"estimate": doubt_of(0.95, 0.89)}, {}, "only 0.890, and 0.9 is required"),
        ({"estimate": doubt_of(0.0)}, {"lower_bound": 0.0}, None),
        ({"estimate": doubt_of(math.nan)}, {}, "only nan"),
        ({"estimate": doubt_of(0.95, math.nan)}, {}, "only nan"),
        ({"estimate": doubt_of(0.95)}, {"lower_bound": math.nan}, "nan is required"),
        (
            {"estimate": doubt_of(0.85)},
            {},
            "the errors of an uncalibrated arm a pass .* Most is lost by the offset of PSM_M's base: wi",
        ),
        (
            {"estimate": doubt_of(0.95)},
            {"errors": CALIBRATED},
            "of an uncalibrated arm, which .* states the errors of a calibrated arm",
        ),
        ({"estimate": doubt_of(0.95), "stated_by": "request"}, {"errors": CALIBRATED}, None),
        (
            {"estimate": doubt_of(0.85, errors=CALIBRATED), "stated_by": "request"},
            {},
            "With the errors of a calibrated arm a pass",
        ),
        ({"estimate": doubt_of()}, {}, "only nan"),
        (
            {"estimate": doubt_of(0.99, version=JUDGE_VERSION - 1)},
            {},
            "judged by another version of the checks; play it again",
        ),
        ({"estimate": doubt_of(0.99, version=JUDGE_VERSION + 1)}, {}, "judged by another version"),
        ({"estimate": doubt_of(0.99), "check_version": CHECK_VERSION - 1}, {}, "judged by another version"),
    ],
)
def test_the_least_certain_pass_has_to_reach_the_lower_bound(stored, asked, words):
    report: Any = SimpleNamespace(**{"check_version": CHECK_VERSION, "stated_by": "installation"} | stored)
    if words is None:
        check_probability(report, **(ASKED | asked))
    else:
        with pytest.raises(Conflict, match=words):
            check_probability(report, **(ASKED | asked))


# ---- the bag


def test_the_bag_is_complete_deterministic_and_holds_the_plans_samples(database: Database, plan: Plan):
    playback = judged(database, plan)
    with pytest.raises(NotFound):
        replay_bag(database, "0" * 64, OF_A1_ALONE)
    data = replay_bag(database, plan.sha256, OF_A1_ALONE)
    assert data == replay_bag(database, plan.sha256, OF_A1_ALONE)
    lines = verify_bag(io.BytesIO(data))
    assert playback[:12] in lines[1]
    with database.reading() as session:
        trajectory = trajectory_of(find_plan(session, plan.sha256).plan)
    [arm] = arms_of(trajectory, arm="PSM", frame="PSM_base")
    assert f"PSM1 (PSM_A, 400006): {len(trajectory)} samples" in lines[3]
    assert np.array_equal(arm.joints[:, [0, 1, 3, 4, 5]], trajectory.joints[:, [0, 1, 3, 4, 5]])
    papers_say_whose_it_is_and_how_far_it_goes(data, plan)
    judged(database, plan, trajectory="1" * 64)
    with pytest.raises(Corrupt, match="not the one that its verdict judged"):
        replay_bag(database, plan.sha256, OF_A1_ALONE)


def test_the_bag_has_the_judged_motion_where_another_is_computed(
    database: Database, plan: Plan, monkeypatch: pytest.MonkeyPatch
):
    judged(database, plan)
    data = replay_bag(database, plan.sha256, OF_A1_ALONE)

    def elsewhere(plan: SuturePlan) -> Trajectory:
        here = trajectory_of(plan)
        return replace(here, joints=np.nextafter(here.joints, np.inf))

    monkeypatch.setattr(plans, "trajectory_of", elsewhere)  # as by another version of the law of motion
    assert replay_bag(database, plan.sha256, OF_A1_ALONE) == data


def test_the_bag_is_signed_under_the_first_checkpoint_with_its_verdict(database: Database, plan: Plan):
    judged(database, plan)
    data = replay_bag(database, plan.sha256, OF_A1_ALONE)
    with database.reading() as session:
        note = newest_checkpoint(session.connection()) or ""  # the export has signed the history
    head = read_notes(note)[0].checkpoint
    key = PublicKey(head.origin, database.history.key.public)
    line = verify_bag(io.BytesIO(data), key)[-1]
    assert f"the history of {head.size} leaves with the root {head.root.hex()[:12]}" in line
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert f"{head.size} leaves, root {head.root.hex()}" in archive.read("README.txt").decode()
        assert check_envelope(archive.read("signature.dsse"), str(key))["predicate"]["checkpoint"] == note
    cases.add_surgeon(database, "heron")
    sign_history(database)
    assert replay_bag(database, plan.sha256, OF_A1_ALONE) == data


def test_a_verdict_that_was_written_past_the_service_makes_no_bag(database: Database, plan: Plan):
    """Its digest agrees, as of somebody who knows the code; the history does not have it."""
    judged(database, plan, feasible=False)
    with database.reading() as session:
        row = session.scalars(select(StoredPlayback)).one()
    report = replace(row.report, feasible=True)
    with tampering(database) as connection:
        values = {"feasible": True, "report": report, "sha256": report.identity}
        connection.execute(update(StoredPlayback).values(**values))
        connection.commit()
    assert gate(database, plan) == values["sha256"]
    with pytest.raises(Corrupt, match="A row of playbacks is not as the history has it"):
        replay_bag(database, plan.sha256, OF_A1_ALONE)


def papers_say_whose_it_is_and_how_far_it_goes(data: bytes, plan: Plan) -> None:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        papers = {name: json.loads(archive.read(name)) for name in archive.namelist() if name.endswith(".json")}
        readme = archive.read("README.txt").decode()
    assert "Every pass is likely enough to stay within reach and clear with the errors of" in readme
    assert "Not judged: a hand-off, the other arm, how exactly the tip meets its points." in readme
    assert all("Research use only" in paper["use"] for paper in papers.values())
    assert papers["plan.json"]["passes"] == to_jsonable_python(plan.about.passes)
    assert papers["policy.json"]["surgeon"] == papers["plan.json"]["surgeon"] == "kestrel"
    assert {"metrics", "coverage", "grid_certificate", "limits", "demos"} <= set(papers["policy.json"])
    assert "actions" not in papers["policy.json"]
    for words in (
        "skills verify",
        "with the errors of an uncalibrated arm, as the installation stated them:",
        "registration 14.4 mm and 3 degrees, wrist 3 degrees",
        "ASSUMED to point straight down",
        "calls its arm 'PSM'",
        "BY HAND, pass 0: the surgeon teleoperates PSM1, inserts the needle (M1) and grasps it with PSM1 (M2).",
        "dvrk_bag_replay.py -a PSM1 -b 000-A1/PSM1 -m servo_jp -j",
    ):
        assert words in readme


def test_the_bag_of_two_passes_has_their_segments_in_order(database: Database):
    cases.trained(database, release=True)
    half = math.radians(45) / 2
    base = {"position_mm": (160.0, 20.0, 20.0), "rotation_xyzw": (0.0, 0.0, math.sin(half), math.cos(half))}
    beside = {"approach": (-0.94, 0.10, -0.33), "base": base}
    points = [{"position_mm": (5.0, 55.0, -125.0)}, {"position_mm": (8.0, 55.0, -125.0)}]
    asked = {"surgeon": "kestrel", "suture": cases.SUTURE, "suture_points": points, "psm_m": beside}
    asked["tissue_mm"] = -170.0
    plan, _ = plan_sutures(database, PlanIn(**asked, speed_mm_s=60.0, rate_hz=100.0), "test")
    judged(database, plan)
    lines = verify_bag(io.BytesIO(replay_bag(database, plan.sha256, OF_A1_ALONE)))
    names = ["000-A1", "001-A2", "002-hand-over", "003-transfer", "004-A1", "005-A2", "006-hand-over"]
    assert lines[2] == f"7 segments: {', '.join(names)}."
    with database.reading() as session:
        index = describe_segments(session, plan.sha256)
    assert [one.name for one in index.segments] == names
    ticks = round((index.segments[4].from_ns - index.segments[3].to_ns) / 1e7)  # where the surgeon changes the jaws
    psm_a, *_ = (int(line.split()[3]) for line in lines[3:5])
    assert ticks > 1 and psm_a == plan.about.trajectory.samples - (ticks - 1)
