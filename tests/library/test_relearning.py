"""`skills verify --relearn`: certificates and policies computed again agree, and consistent changes are named."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select, text, update

from skills.cli.operation import state_of
from skills.db.models import Demonstration, PolicyVersion, StoredPoses
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import NotFound
from skills.formats.parsed import parse_recording
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.networks import Network
from skills.learning.policy import LEARNER_VERSION, Policy
from skills.learning.q_learning import PhaseQLearning
from skills.library.operation import inspection
from skills.library.operation.inspection import Checked, inspect_policies
from skills.library.operation.integrity import demo_identity, poses_identity_of
from skills.library.policies.gate import GATE_VERSION
from skills.library.policies.learning import certified, lessons
from skills.library.policies.relearning import compute_again, decoded
from skills.library.policies.requests import request_of
from skills.library.recordings.demos import mark_demo
from skills.schemas.policies import PolicyManifest
from skills.settings import Settings
from tests import backends
from tests.library import cases
from tests.library.attacks import tampering
from tests.library.test_pose_styles import add_both
from tests.library.test_scenes import SCENE, SLIPPING

CERTIFICATES, RELEARNT = "certificates", "policies learnt again"
RELEARN = Settings(learning_timeout_s=60.0)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database with a version of each way to learn, in which nothing is wrong."""
    folder = tmp_path_factory.mktemp("filled")
    database = Database(backends.fresh("sqlite", folder))
    cases.add_surgeon(database)
    bag = cases.upload(cases.bag("PSM1", "PSM2"), "application/vnd.mcap")
    demos = [
        cases.store(database, bag, arm="PSM2"),
        *(cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0)), hysteresis=0.1) for shift in (0.4, 0.9)),
    ]
    two = {"demos": [one.sha256 for one in demos[1:]]}
    cases.train(database, demos=[demos[0].sha256], release=True)
    cases.train(database, seed=2**40 + 1, learner=PhaseQLearning(join_share=0.5))
    cases.train(database, learner=cases.PUBLISHED)
    cases.train(database, scene=SCENE.as_json(), learner=SLIPPING)
    cases.train(database, learner=ValueIteration(), combine="corridor", **two)
    cases.committed(database, mark_demo, demos[1].sha256, "recovery", None, "test")
    cases.train(database, outcomes="any", combine="corridor", **two)
    with database.writing() as session:  # not as when it was learnt from
        mark_demo(session, demos[2].sha256, "failure", None, "test")
    database.close()
    return Path(database.url.removeprefix("sqlite:///"))


@pytest.fixture
def database(filled: Path, tmp_path: Path) -> Iterator[Database]:
    """Yield a copy of that database."""
    copy = tmp_path / "copy.sqlite"
    copy.write_bytes(filled.read_bytes())
    database = Database(f"sqlite:///{copy}")
    yield database
    database.close()


def parts(database: Database, **how: Any) -> dict[str, Checked]:
    """Return the parts, as they are at the end."""
    return {part.what: part for part in inspect_policies(database, parse_recording, **({"relearn": RELEARN} | how))}


def test_versions_of_every_kind_are_learnt_again_as_they_are(database):
    assert {name: vars(part) for name, part in parts(database).items()} == {
        RELEARNT: vars(Checked(RELEARNT, count=6, of=6)),
        CERTIFICATES: vars(Checked(CERTIFICATES, count=0, of=0)),  # of those that were not learnt again
    }


def test_without_being_asked_nothing_is_learnt_again(database):
    assert {name: vars(part) for name, part in parts(database, relearn=None).items()} == {
        CERTIFICATES: vars(Checked(CERTIFICATES, count=6, of=6)),
    }


def test_with_a_limit_some_are_learnt_again_and_the_others_certified(database):
    found = parts(database, limit=2)
    assert {name: (part.count, part.wrong) for name, part in found.items()} == {
        RELEARNT: (2, []),
        CERTIFICATES: (4, []),
    }


def stored(database: Database, row: int = 1) -> tuple[Policy, PolicyManifest]:
    """Return a stored policy and its manifest."""
    with database.reading() as session:
        version = session.get_one(PolicyVersion, row)
        return version.learnt, version.manifest


def rewritten(database: Database, row: int, policy: Any, manifest: PolicyManifest) -> None:
    """Write a policy and a manifest with the digest of both, past the triggers."""
    value = {"learnt": policy, "manifest": manifest, "sha256": manifest.identity(digest(policy))}
    with tampering(database) as connection:
        connection.execute(update(PolicyVersion).where(PolicyVersion.row == row).values(**value))
        connection.commit()


def test_a_certificate_with_better_figures_and_its_digest_is_named(database):
    policy, manifest = stored(database, 2)
    metrics = replace(manifest.metrics, dtw_total_mm=1.5, rmse_mm=(0.5, 0.5, 0.5))
    rewritten(database, 2, policy, manifest.model_copy(update={"metrics": metrics}))
    for how in (RELEARN, None):
        ((name, why),) = [one for part in parts(database, relearn=how).values() for one in part.wrong]
        assert name == "policy_versions 2"
        assert "metrics." in why
        assert "values" not in why


def test_other_actions_with_certificate_and_digests_are_named(database):
    """The forged policy is certified by the service's own code, so only learning again can find it."""
    with database.reading() as session:
        version = session.get_one(PolicyVersion, 1)
        (lesson,) = lessons(session, [version.demonstration_row])
        policy, manifest = version.learnt, version.manifest
        demo = version.demonstrations[0].demo
    q = policy.q.copy()
    q[policy.domain.certified] *= 1.0 + 1e-12
    forged = replace(policy, q=q)
    made = certified(lesson, request_of(manifest), demo, forged)
    rewritten(database, 1, forged, made.manifest)
    with tampering(database) as connection:
        connection.execute(
            text("UPDATE policy_versions SET covered = :covered WHERE row = 1"), {"covered": made.coverage}
        )
        connection.commit()
    assert parts(database, relearn=None)[CERTIFICATES].wrong == []
    ((name, why),) = parts(database)[RELEARNT].wrong
    assert name == "policy_versions 1"
    assert why.startswith("computed again, it has other results: its values")


def test_another_motion_of_the_other_arm_with_its_digest_is_named(tmp_path: Path):
    """It was rewritten with the digest of its row, so only reading the recording again can find it."""
    database = Database(backends.fresh("sqlite", tmp_path))
    cases.add_surgeon(database)
    for shift_mm in (0.0, 2.5):
        add_both(database, shift_mm)
    with database.reading() as session:
        demos = [one.sha256 for one in session.scalars(select(Demonstration).order_by(Demonstration.row))]
    cases.train(database, demos=demos, combine="corridor")
    cases.train(database, demos=demos[:1])
    assert [part.wrong for part in parts(database).values()] == [[], []]
    with database.reading() as session:
        row = session.get_one(StoredPoses, 1)
        poses, policy = row.poses, row.policy.sha256
    other = poses.path.partner
    assert other is not None
    moved = replace(other, tip_mm=other.tip_mm + 1e-3)
    changed = replace(poses, path=replace(poses.path, partner=moved))
    with tampering(database) as connection:
        value = {"poses": changed, "sha256": poses_identity_of(policy, digest(changed))}
        connection.execute(update(StoredPoses).where(StoredPoses.row == 1).values(**value))
        connection.commit()
    assert parts(database, relearn=None)[CERTIFICATES].wrong == []
    ((name, why),) = parts(database)[RELEARNT].wrong
    assert name == "policy_versions 1" and why.endswith("the other arm's motion in its pose style")
    database.close()


def test_a_demonstration_other_than_its_recording_is_named(database):
    """Moved by a micrometre, which changes no cell, with the digest of its stored form."""
    with database.reading() as session:
        row = session.get_one(Demonstration, 1)
        demo = replace(row.demo, tip_mm=row.demo.tip_mm + 1e-3)
        assert demo_identity(row.recording.sha256, row.surgeon.slug, row.suture, demo, row.path) == row.sha256
    with tampering(database) as connection:
        connection.execute(update(Demonstration).where(Demonstration.row == 1).values(demo=demo))
        connection.commit()
    assert f"its demonstration {row.sha256[:12]}, cut out of its recording again" in str(
        parts(database)[RELEARNT].wrong
    )


def test_a_version_of_an_older_learner_is_never_called_whole(database):
    policy, manifest = stored(database)
    rewritten(database, 1, policy, manifest.model_copy(update={"learner_version": LEARNER_VERSION - 1}))
    made = f"made by an older learner (version {LEARNER_VERSION - 1}, now {LEARNER_VERSION})"
    found = parts(database)
    assert found[CERTIFICATES].left_out == [("policy_versions 1", f"{made}, its certificate was not computed again")]
    assert found[RELEARNT].left_out == [("policy_versions 1", f"{made}, not learnt again")]
    assert state_of(found[RELEARNT]) == "5 whole, 1 not compared"


def test_of_an_older_gate_only_the_values_are_compared(database):
    policy, manifest = stored(database)
    older = {"grid_certificate": replace(manifest.grid_certificate, gate=GATE_VERSION - 1)}
    rewritten(database, 1, policy, manifest.model_copy(update=older))
    part = parts(database)[RELEARNT]
    assert part.wrong == []
    ((_, why),) = part.left_out
    assert why.endswith("only its values were compared")
    rewritten(database, 1, replace(policy, q=policy.q * 2.0), manifest.model_copy(update=older))
    assert "its values" in str(parts(database)[RELEARNT].wrong)


def test_a_policy_of_a_network_is_certified_again_and_not_learnt_again(database):
    policy, manifest = stored(database)
    rewritten(database, 1, replace(policy, network=Network.of([(np.zeros((27, 3)), np.zeros(27))])), manifest)
    found = parts(database)
    assert found[RELEARNT].left_out == [
        ("policy_versions 1", "learnt by a network, whose values depend on the machine, not learnt again")
    ]
    assert (found[CERTIFICATES].count, found[CERTIFICATES].wrong, found[RELEARNT].wrong) == (1, [], [])


def test_what_was_erased_meanwhile_is_not_called_wrong(database, monkeypatch):
    with pytest.raises(NotFound):
        compute_again(database, 99)
    with pytest.raises(NotFound):
        decoded(database, 99, parse_recording)
    monkeypatch.setattr(inspection, "compute_again", lambda database, row: compute_again(database, 99))
    assert parts(database, relearn=None)[CERTIFICATES].wrong == []


def test_without_consent_nothing_is_learnt_again(database):
    cases.committed(database, cases.agree, {"uses": []})
    part = parts(database)[RELEARNT]
    assert part.wrong == []
    assert len(part.left_out) == 6
    assert "does not cover training" in part.left_out[0][1]
