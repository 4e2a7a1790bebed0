"""Pose styles stored with policy versions: made at training, verified, erased, backed up, and refused with a reason."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from sqlalchemy import func, select, text

from skills.db.models import Demonstration, PolicyVersion, StoredPoses
from skills.db.session import Database
from skills.demonstration.motion import Motion
from skills.demonstration.recording import Recording
from skills.errors import Corrupt, NotFound
from skills.formats import write_mcap
from skills.learning.pose_style import PHASES
from skills.learning.tube import certified_poses
from skills.library import training
from skills.library.backup import back_up, restore
from skills.library.demos import withdraw_demo
from skills.library.erasure import erase_demo
from skills.library.inspection import HISTORY, inspect_installation
from skills.library.policies import poses_of
from skills.remedies import Action, Remedy
from tests import backends
from tests.library import cases
from tests.library.styles import retrain

MCAP = "application/vnd.mcap"


def turning(shift_mm: float = 0.0, *, tip: np.ndarray | None = None, detour_deg: float = 0.0) -> bytes:
    """Return a hand-off of PSM2 that turns by 60 degrees about the shaft on its way, and aside and back by a detour."""
    tip = cases.points_mm((shift_mm, 0.0, 0.0)) if tip is None else tip
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    spin = Rotation.from_rotvec(np.radians(np.linspace(0.0, 60.0, len(tip)))[:, None] * [0.0, 0.0, 1.0])
    aside = Rotation.from_rotvec(np.radians(detour_deg) * np.sin(np.linspace(0, np.pi, len(tip)))[:, None] * [1, 0, 0])
    turned = (Rotation.from_quat([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]) * spin * aside).as_quat()
    motion = Motion("PSM2", "/PSM2/local/measured_cp", "PSM2_base", stamps_ns, tip, turned)
    return write_mcap(Recording(format="mcap", integrity="full", motions=(motion,)))


def add(database: Database, data: bytes) -> Demonstration:
    return cases.store(database, cases.upload(data, MCAP))


def stored(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(StoredPoses)) or 0


def wrong(database: Database) -> list[tuple[str, str]]:
    return [
        one
        for part in {id(p): p for p in inspect_installation(database)}.values()
        for one in part.wrong
        if part.what != HISTORY
    ]


def test_a_training_stores_the_poses_of_its_demonstration(database: Database):
    cases.add_surgeon(database)
    demo = add(database, turning())
    version = cases.train(database)
    with database.reading() as session:
        poses = poses_of(session.get_one(PolicyVersion, version.row))
        shown = session.get_one(Demonstration, demo.row).demo
    assert (poses.arm, poses.frame, poses.tube.holds) == ("PSM2", "PSM2_base", True)
    at_s = np.linspace(0.0, shown.stamps_s[-1], PHASES)
    assert np.abs(poses.path.elapsed_s - at_s).max() < 1e-9
    for axis in range(3):
        assert np.abs(poses.path.tip_mm[:, axis] - np.interp(at_s, shown.stamps_s, shown.tip_mm[:, axis])).max() < 1e-9
    turned = Slerp(shown.stamps_s, Rotation.from_quat(shown.rotation_xyzw))(at_s)
    assert (turned.inv() * Rotation.from_quat(poses.path.rotation_xyzw)).magnitude().max() < 1e-7
    assert wrong(database) == []


def test_several_demonstrations_give_one_pose_style_at_one_place(database: Database):
    cases.add_surgeon(database)
    demos = [add(database, turning(shift)) for shift in (0.0, 2.5, 1.0)]
    version = cases.train(database, demos=[one.sha256 for one in demos])
    with database.reading() as session:
        version = session.get_one(PolicyVersion, version.row)
        poses, at = poses_of(version), version.manifest["combined"]["at"]
        (place,) = [one.demo for one in version.demonstrations if one.sha256 == at]
    assert np.abs(poses.path.tip_mm[[0, -1]] - place.tip_mm[[0, -1]]).max() < 1e-9
    assert poses.path.spread_mm.max() > 0.0
    assert wrong(database) == []


@pytest.mark.parametrize("older", [True, False])
def test_poses_of_before_keep_the_whole_turn_and_verify(
    database: Database, monkeypatch: pytest.MonkeyPatch, older: bool
):
    cases.add_surgeon(database)
    demos = [add(database, turning(k, detour_deg=aside)) for k, aside in enumerate((15.0, -20.0, 0.5))]
    with monkeypatch.context() as patched:
        if older:
            patched.setattr(training, "certified_poses", partial(certified_poses, turn_share=1.0))
        version = cases.train(database, demos=[one.sha256 for one in demos])
    with database.reading() as session:
        version = session.get_one(PolicyVersion, version.row)
        assert (poses_of(version).path.turn_share == 1.0) == older
    assert wrong(database) == []


def test_a_batch_stores_pose_styles_too(database: Database):
    cases.add_surgeon(database)
    add(database, turning())
    assert retrain(database, release=True).state == "succeeded"
    assert stored(database) == 1


def test_a_demonstration_without_orientation_has_no_pose_style(database: Database):
    cases.add_surgeon(database)
    cases.add_demo(database)
    version = cases.train(database, release=True)
    with database.reading() as session, pytest.raises(NotFound, match="has no orientation") as refused:
        poses_of(session.get_one(PolicyVersion, version.row))
    assert not any(isinstance(one, Remedy) for one in refused.value.remedies)
    assert wrong(database) == []


def test_an_older_version_gets_its_pose_style_by_an_equal_training(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.add_surgeon(database)
    add(database, turning())
    with monkeypatch.context() as older:
        older.setattr(training, "POSES_VERSION", 0)
        older.setattr(training, "certified_poses", lambda *_: None)
        version = cases.train(database, release=True)
    with database.reading() as session, pytest.raises(NotFound, match="before there were any") as refused:
        poses_of(session.get_one(PolicyVersion, version.row))
    assert Remedy(Action.TRAIN, surgeon="kestrel", suture=cases.SUTURE) in refused.value.remedies
    again = cases.train(database, release=True)
    assert (again.row, again.sha256) == (version.row, version.sha256)
    with database.reading() as session:
        assert poses_of(session.get_one(PolicyVersion, version.row)).tube.holds


def test_a_motion_too_quick_for_its_tube_is_not_served(database: Database):
    cases.add_surgeon(database)
    tip = cases.points_mm()
    add(database, turning(tip=np.concatenate([tip[:20], tip[58:]])))  # across the grid between two samples
    version = cases.train(database, release=True)
    with database.reading() as session, pytest.raises(NotFound, match="is not as long as the disturbance of 1 mm"):
        poses_of(session.get_one(PolicyVersion, version.row))
    assert (stored(database), wrong(database)) == (1, [])


def test_a_pose_style_is_erased_with_its_demonstration(database: Database):
    cases.add_surgeon(database)
    demo = add(database, turning())
    cases.train(database)
    assert stored(database) == 1
    with database.writing() as session:
        erase_demo(session, demo.sha256, "test")
    assert stored(database) == 0


@pytest.mark.nightly  # by day tests/library/test_backup.py counts every table
def test_a_backup_holds_the_pose_styles(database: Database, tmp_path: Path):
    cases.add_surgeon(database)
    add(database, turning())
    cases.train(database)
    back_up(database, tmp_path / "all.zip")
    other = Database(backends.blank("postgresql" if database.engine.dialect.name == "sqlite" else "sqlite", tmp_path))
    try:
        restore(other, tmp_path / "all.zip")
        assert (stored(other), wrong(other)) == (1, [])
    finally:
        other.close()
        backends.drop(other.url)


@pytest.mark.parametrize("changed", ["sha256 = 'e' || substr(sha256, 2)", "policy_row = 1"])
def test_a_changed_pose_style_is_refused_and_found(database: Database, changed: str):
    cases.add_surgeon(database)
    cases.add_demo(database)
    cases.train(database)
    demo = add(database, turning(2.5))
    version = cases.train(database, demos=[demo.sha256])
    on = "" if database.engine.dialect.name == "sqlite" else " ON pose_styles"
    with database.writing() as session:
        session.execute(text(f"DROP TRIGGER pose_styles_append_only{on}"))
        session.execute(text(f"UPDATE pose_styles SET {changed}"))
    with database.reading() as session, pytest.raises((Corrupt, NotFound)):
        poses_of(session.get_one(PolicyVersion, version.row))
    ((where, why),) = wrong(database)
    assert where.startswith("pose_styles") and "does not match its digest" in why
    with database.writing() as session:
        withdraw_demo(session, demo.sha256, "test")
