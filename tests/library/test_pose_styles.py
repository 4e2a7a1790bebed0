"""Pose styles stored with policy versions: made at training, verified, erased, backed up, and refused with a reason."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from sqlalchemy import delete, func, select, text

from skills.db.models import Demonstration, ParsedChunk, ParsedRecording, PolicyVersion, StoredPoses
from skills.db.session import Database
from skills.demonstration.motion import Motion, Signal
from skills.demonstration.partner import PartnerMotion
from skills.demonstration.recording import Recording
from skills.errors import Busy, Corrupt, NotFound
from skills.formats.bag_writer import write_mcap
from skills.formats.parsed import parse_recording
from skills.learning.pose_style import PHASES
from skills.library.operation.backup import back_up, restore
from skills.library.operation.inspection import HISTORY
from skills.library.operation.jobs import PartRequest
from skills.library.people.erasure import erase_demo
from skills.library.people.surgeons import put_surgeon
from skills.library.policies import learning, training
from skills.library.policies.batches import retrain_part
from skills.library.policies.pose_styles import poses_of
from skills.library.recordings.demos import withdraw_demo
from skills.remedies import Remedy
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from tests import backends
from tests.library import cases
from tests.library.cases import wrong
from tests.library.styles import NO_CONSENT, ask_retraining, parts_of, retrain, states_of

MCAP = "application/vnd.mcap"


# PSM_M goes straight to 12 mm beside where PSM_A ends; PSM_A's base stands at BASE_MM in the camera's frame.
AWAY_MM, BESIDE_MM, BASE_MM = (45.0, 55.0, -125.0), (17.0, 55.0, -125.0), np.array([30.0, -40.0, 180.0])
OPEN_RAD = 0.8  # of the jaw of the other arm as it begins


def turning(
    shift_mm: float = 0.0,
    *,
    tip: np.ndarray | None = None,
    detour_deg: float = 0.0,
    other: str | None = None,
    other_s: float = 0.0,
) -> bytes:
    """Return a hand-off of PSM2 that turns by 60 degrees about the shaft on its way, and aside and back by a detour.

    Args:
        shift_mm: Where it lies, along x.
        tip: The positions; default: those of `cases`.
        detour_deg: The detour.
        other: The other arm, which goes from `AWAY_MM` to `BESIDE_MM`; None: it was not recorded.
        other_s: It was recorded from so long after the start on.
    """
    tip = cases.points_mm((shift_mm, 0.0, 0.0)) if tip is None else tip
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    spin = Rotation.from_rotvec(np.radians(np.linspace(0.0, 60.0, len(tip)))[:, None] * [0.0, 0.0, 1.0])
    aside = Rotation.from_rotvec(np.radians(detour_deg) * np.sin(np.linspace(0, np.pi, len(tip)))[:, None] * [1, 0, 0])
    turned = (Rotation.from_quat([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]) * spin * aside).as_quat()
    motions = [Motion("PSM2", "/PSM2/local/measured_cp", "PSM2_base", stamps_ns, tip, turned)]
    jaws: tuple[tuple[str, Signal], ...] = ()
    if other is not None:
        there = np.linspace(AWAY_MM, BESIDE_MM, len(tip)) + np.array([shift_mm, 0.0, 0.0])
        since = stamps_ns >= stamps_ns[0] + round(1e9 * other_s)
        seen = stamps_ns[since], there[since] + BASE_MM, np.tile([0.0, 1.0, 0.0, 0.0], (int(since.sum()), 1))
        motions.append(Motion("PSM2", "/PSM2/measured_cp", "ECM", stamps_ns, tip + BASE_MM, turned))
        motions.append(Motion(other, f"/{other}/measured_cp", "ECM", *seen))
        angles = np.linspace(OPEN_RAD, 0.0, len(tip))  # of its jaw, which closes
        jaws = ((other, Signal(stamps_ns, angles, f"/{other}/jaw/measured_js")),)
    return write_mcap(Recording(format="mcap", integrity="full", motions=tuple(motions), jaws=jaws))


def add(database: Database, data: bytes, **cut: Any) -> Demonstration:
    return cases.store(database, cases.upload(data, MCAP), **cut)


def both_arms(shift_mm: float = 0.0) -> bytes:
    """Return a hand-off of PSM2 to PSM1, which was recorded all along."""
    return turning(shift_mm, other="PSM1")


def add_both(database: Database, shift_mm: float = 0.0) -> Demonstration:
    """Store a demonstration of PSM2 whose recording has the other arm too."""
    return add(database, both_arms(shift_mm), arm="PSM2", segment="whole")


def beside(database: Database, version: PolicyVersion) -> PartnerMotion | None:
    """Return the other arm's motion in the pose style of a version."""
    with database.reading() as session:
        return poses_of(session.get_one(PolicyVersion, version.row)).path.partner


def stored(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(StoredPoses)) or 0


def rows_of(database: Database) -> list[Any]:
    with database.reading() as session:
        return [tuple(row) for row in session.execute(text("SELECT sha256, policy_row, poses FROM pose_styles"))]


def test_a_training_stores_the_poses_of_its_demonstration(database: Database):
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
    demos = [add(database, turning(shift)) for shift in (0.0, 2.5, 1.0)]
    version = cases.train(database, demos=[one.sha256 for one in demos])
    with database.reading() as session:
        version = session.get_one(PolicyVersion, version.row)
        poses, at = poses_of(version), version.manifest.combined.at
        (place,) = [one.demo for one in version.demonstrations if one.sha256 == at]
    assert np.abs(poses.path.tip_mm[[0, -1]] - place.tip_mm[[0, -1]]).max() < 1e-9
    assert poses.path.spread_mm.max() > 0.0
    assert wrong(database) == []


def test_a_batch_stores_pose_styles_too(database: Database):
    add(database, turning())
    assert retrain(database, release=True).state == "succeeded"
    assert stored(database) == 1


def test_a_demonstration_without_orientation_has_no_pose_style(database: Database):
    version = cases.trained(database, release=True)
    with database.reading() as session, pytest.raises(NotFound, match="has no orientation") as refused:
        poses_of(session.get_one(PolicyVersion, version.row))
    assert not any(isinstance(one, Remedy) for one in refused.value.remedies)
    assert wrong(database) == []


def test_a_motion_too_quick_for_its_tube_is_not_served(database: Database):
    tip = cases.points_mm()
    add(database, turning(tip=np.concatenate([tip[:20], tip[57:]])))  # across the grid between two samples
    version = cases.train(database, release=True)
    with database.reading() as session, pytest.raises(NotFound, match="is not as long as the disturbance of 1 mm"):
        poses_of(session.get_one(PolicyVersion, version.row))
    assert (stored(database), wrong(database)) == (1, [])


def test_a_pose_style_is_erased_with_its_demonstration(database: Database):
    demo = add(database, turning())
    cases.train(database)
    assert stored(database) == 1
    cases.committed(database, erase_demo, demo.sha256, "test")
    assert stored(database) == 0


# ---- the other arm -----------------------------------------------------------------------------------------------


def test_the_other_arm_is_stored_as_it_was_demonstrated(database: Database):
    """By hand: phase k of 100 is k hundredths of the straight way from 45 to 17 mm along x."""
    add_both(database)
    other = beside(database, cases.train(database))
    assert other is not None and other.arm == "PSM1"
    assert np.abs(other.tip_mm - np.linspace(AWAY_MM, BESIDE_MM, PHASES)).max() < 1e-6
    assert other.tip_mm[50] == pytest.approx((31.0, 55.0, -125.0), abs=1e-6)
    assert np.abs(np.abs(other.rotation_xyzw) - (0.0, 1.0, 0.0, 0.0)).max() < 1e-6
    assert wrong(database) == []


def test_a_demonstration_moved_as_a_whole_moves_the_other_arm(database: Database):
    demos = [add_both(database, shift) for shift in (0.0, 3.5)]
    here, there = (beside(database, cases.train(database, demos=[demo.sha256])) for demo in demos)
    assert here is not None and there is not None
    assert np.abs(there.tip_mm - here.tip_mm - (3.5, 0.0, 0.0)).max() < 1e-6
    assert np.abs(there.rotation_xyzw - here.rotation_xyzw).max() < 1e-6


@pytest.mark.parametrize("without", [{"other": None}, {"other_s": 0.5}, {"other": "PSM3"}])
def test_the_other_arm_is_learnt_if_every_recording_has_it_all_along(database: Database, without: dict[str, Any]):
    has = [add_both(database, shift) for shift in (0.0, 2.5)]
    has_not = add(database, turning(1.0, **{"other": "PSM1"} | without), arm="PSM2", segment="whole")
    both = cases.train(database, demos=[one.sha256 for one in has], combine="corridor")
    other = beside(database, both)
    assert other is not None and other.arm == "PSM1"
    mixed = cases.train(database, demos=[one.sha256 for one in (*has, has_not)], combine="corridor")
    assert beside(database, mixed) is None
    assert wrong(database) == []


def test_a_batch_learns_the_other_arm_too(database: Database):
    add_both(database)
    assert retrain(database, release=True).state == "succeeded"
    with database.reading() as session:
        version = session.scalars(select(PolicyVersion)).one()
    assert beside(database, version) is not None


def test_a_batch_tries_a_style_again_whose_recording_cannot_be_read_now(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    add_both(database)
    job = ask_retraining(database)
    (part,) = parts_of(database, job)
    with monkeypatch.context() as now:
        now.setattr(learning, "stored_recording", busy)
        with pytest.raises(Busy):
            retrain_part(database, PartRequest.model_validate(part.request), Settings(database_url=database.url))
    assert states_of(database, job) == ["queued"]
    cases.work(database, part)
    assert states_of(database, job) == ["done"]


def busy(*_: Any) -> None:
    raise Busy("Too many recordings are being read; try again.")


def test_a_recording_that_is_not_cached_is_read_again(database: Database):
    add_both(database)
    cached = beside(database, cases.train(database))
    with database.writing() as session:
        session.execute(delete(ParsedChunk))
        session.execute(delete(ParsedRecording))
    again = beside(database, cases.train(database, seed=2))
    assert cached is not None and again is not None
    assert again.tip_mm.tobytes() == cached.tip_mm.tobytes()


def test_no_recording_is_read_where_the_other_arm_is_not_known(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, turning())
    monkeypatch.setattr(learning, "stored_recording", lambda *_: pytest.fail("it was read"))
    assert beside(database, cases.train(database)) is None


def test_no_recording_is_read_without_consent(database: Database, monkeypatch: pytest.MonkeyPatch):
    add_both(database)
    job = cases.ask_training(database)
    cases.committed(database, put_surgeon, "kestrel", SurgeonIn.model_validate(NO_CONSENT), "test")
    monkeypatch.setattr(learning, "stored_recording", lambda *_: pytest.fail("it was read"))
    ended = cases.work(database, job)
    assert ended.state == "failed" and "consent" in (ended.error or "")


def test_a_recording_that_was_erased_meanwhile_is_named(database: Database):
    demo = add_both(database)
    with database.reading() as session:
        read = training.lessons(session, [demo.row])
    cases.committed(database, erase_demo, demo.sha256, "test")
    with pytest.raises(NotFound, match=r"A demonstration was erased while the training used it\."):
        training.with_partners(database, read, parse_recording)


@pytest.mark.nightly  # by day tests/library/test_backup.py counts every table
def test_a_backup_holds_the_pose_styles(database: Database, tmp_path: Path):
    add(database, turning())
    cases.train(database)
    back_up(database, tmp_path / "all.zip")
    with backends.opened(backends.blank(backends.OTHER[database.engine.dialect.name], tmp_path)) as other:
        restore(other, tmp_path / "all.zip")
        assert (stored(other), wrong(other)) == (1, [])


@pytest.mark.parametrize("changed", ["sha256 = 'e' || substr(sha256, 2)", "policy_row = 1"])
def test_a_changed_pose_style_is_refused_and_found(database: Database, changed: str):
    cases.trained(database)
    demo = add(database, turning(2.5))
    version = cases.train(database, demos=[demo.sha256])
    on = "" if database.engine.dialect.name == "sqlite" else " ON pose_styles"
    with database.writing() as session:
        session.execute(text(f"DROP TRIGGER pose_styles_append_only{on}"))
        session.execute(text(f"UPDATE pose_styles SET {changed}"))
    with database.reading() as session, pytest.raises((Corrupt, NotFound)):
        poses_of(session.get_one(PolicyVersion, version.row))
    ((where, why),) = wrong(database, HISTORY)
    assert where.startswith("pose_styles") and "does not match its digest" in why
    cases.committed(database, withdraw_demo, demo.sha256, "test")
