"""A small plan as a bag for replay, complete and as separate files."""

import io
import json
import zipfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from skills.formats.replay_bag import ArmMotion, arms_of, folder_of, seal, segment_index, segment_motions
from skills.formats.verify import JUDGED, verify_bag
from skills.kinematics import forward, quaternion_of
from skills.packing import canonical, sha256
from skills.planning.handoff import OtherArm
from skills.planning.trajectory import A1, A2, Trajectory, joint_ratios

RATE_HZ = 200.0
FRAME = "PSM2_base"
PARTS = ("000-A1", "001-A2", "002-A1", "003-A2")
SHARING = (1, 3)  # those that begin with the last sample of the one before
PSM2 = ("/PSM2/setpoint_js", "/PSM2/setpoint_cp", "/PSM2/jaw/setpoint_js")
PSM1 = ("/PSM1/setpoint_js", "/PSM1/setpoint_cp", "/PSM1/jaw/setpoint_js")


@cache
def trajectory(*, other: bool = True) -> Trajectory:
    """Return two passes of 0.4 s with a second between them, continuous, with PSM_M."""
    u = np.linspace(0, 1, 81)[:, None]
    smooth = 10 * u**3 - 15 * u**4 + 6 * u**5
    here = np.array([-0.07, -0.4, 153.0, 0.01, 0.4, 0.07])
    there = here + 0.3 * np.array([0.1, 0.02, -9.0, 0.3, 0.1, -0.2])  # within the limits of acceleration
    after = here + 0.3 * np.array([0.02, -0.05, 4.0, -0.2, 0.2, 0.1])
    joints = np.concatenate([here + smooth * (there - here), there + smooth * (after - there)])
    number = np.repeat([0, 1], 81)
    tip_mm, rotation = forward(joints)
    beside = OtherArm(
        [160.0, 20.0, 20.0], [0.0, 0.3, 0.0, np.sqrt(1 - 0.09)], "420006", joints[::-1] * [1, 1, 1.1, 1, 1, 1]
    )
    return Trajectory(
        rate_hz=RATE_HZ,
        instrument="400006",
        stamps_s=np.arange(162) / RATE_HZ + number * 1.0,
        tip_mm=tip_mm,
        rotation_xyzw=quaternion_of(rotation),
        joints=joints,
        pass_index=number,
        phase=np.tile(np.repeat([A1, A2], [60, 21]), 2),
        speed_mm_s=20.0,
        turn_rad_s=1.0,
        speed_ratio=0.5,
        acceleration_ratio=0.5,
        deviation_mm=0.0,
        psm_m=beside if other else None,
    )


def judged(made: Trajectory) -> list[dict[str, Any]]:
    """Return the figures of the joints in a verdict on a motion."""
    moving = {"PSM_A": (made.joints, made.instrument)}
    if made.psm_m is not None:
        moving["PSM_M"] = (made.psm_m.joints, made.psm_m.instrument)
    arms = []
    for name, (joints, instrument) in moving.items():
        ratios = joint_ratios(joints, np.zeros(len(joints), int), made.rate_hz, instrument)
        rows = zip(
            *(one.tolist() for one in (joints.min(0), joints.max(0), *(each.max(0) for each in ratios))), strict=True
        )
        arms.append({"name": name, "joints": [dict(zip(JUDGED, row, strict=True)) for row in rows]})
    return arms


def papers(made: Trajectory, **changes: Any) -> dict[str, bytes]:
    """Return the documents of a plan with this trajectory, with no more than is checked."""
    ends = made.tip_mm[made.last_samples].tolist()
    plan = {
        "sha256": "1" * 64,
        "policy": {"version": 3, "sha256": "2" * 64},
        "arm": "PSM2",
        "frame": FRAME,
        "instrument": made.instrument,
        "trajectory": {"rate_hz": made.rate_hz, "samples": len(made)},
        "passes": [{"path_mm": [end]} for end in ends],
        "psm_m": {"base_mm": [160.0, 20.0, 20.0], "instrument": "420006"} if made.psm_m else None,
    } | changes.get("plan", {})
    report = {"feasible": True, "samples": len(made), "arms": judged(made)} | changes.get("report", {})
    verdict = {
        "sha256": sha256(canonical([plan["sha256"], report])),
        "plan": plan["sha256"],
        "policy": "2" * 64,
        "feasible": True,
        "report": report,
    } | changes.get("verdict", {})
    policy = {"version": 3, "sha256": "2" * 64} | changes.get("policy", {})
    index = segment_index(segment_motions(made, arms(made)), "1" * 64).model_dump(mode="json") | changes.get(
        "index", {}
    )
    files = {"plan.json": plan, "verdict.json": verdict, "policy.json": policy, "segments.json": index}
    return {name: json.dumps(paper).encode() for name, paper in files.items()} | {"README.txt": b"Read me.\n"}


@cache
def members() -> dict[str, bytes]:
    """Return the files of a complete bag, without their checksums."""
    return papers(trajectory()) | folders(trajectory(), arms(trajectory()))


def arms(made: Trajectory) -> tuple[ArmMotion, ...]:
    return arms_of(made, arm="PSM2", frame=FRAME, other="PSM1", jaw_rad=0.1)


def folders(made: Trajectory, moving: Sequence[ArmMotion], plan: str = "1" * 64) -> dict[str, bytes]:
    """Return the files of the arms in each segment."""
    moved = (part for _, parts in segment_motions(made, moving) for part in parts if part.moves)
    return {name: data for part in moved for name, data in folder_of(part, plan).items()}


def arm(name: str = "PSM2") -> ArmMotion:
    return next(one for one in arms(trajectory()) if one.name == name)


def checked(files: dict[str, bytes]) -> list[str]:
    """Seal files with correct checksums and check them."""
    return verify_bag(io.BytesIO(seal(files)))


def unpacked(tmp_path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(io.BytesIO(seal(files))) as archive:
        archive.extractall(tmp_path)
    return tmp_path
