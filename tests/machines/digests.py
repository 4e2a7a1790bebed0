"""Digests of one value of every kind, made anew from files: to be compared with those that another machine makes.

python -m tests.machines.digests write FOLDER         the files, once, so that all machines begin with the same bytes
python -m tests.machines.digests day|night FOLDER     the digests as JSON, by name, and the figures of the playbacks
"""

import hashlib
import json
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, is_dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from sqlalchemy import select

from skills.comparison.combining import COMBININGS
from skills.db.models import Demonstration, Plan, PolicyVersion, StoredPlayback, StoredRewardMap
from skills.db.packed import digest
from skills.db.session import Database
from skills.demonstration.identification import identify
from skills.dynamics import Servo, predict
from skills.fields import as_json
from skills.formats.parsed import parse_recording
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.max_ent_irl import MaxEntIRL
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.library.operation.integrity import learnt, planned, posed, scene_digest
from skills.library.plans.plans import trajectory_of
from skills.library.plans.playbacks import request_playback
from skills.packing import sha256
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings
from tests.demonstration import arms
from tests.formats import trials
from tests.library import cases
from tests.library.test_pose_styles import both_arms, turning
from tests.library.test_scenes import SCENE, SLIPPING

MCAP, CSV = "application/vnd.mcap", "text/csv"
LEARNERS = {
    "phase": PhaseQLearning(),
    "values": ValueIteration(),
    "values that slip": ValueIteration(gamma=0.95, slip=0.1),
    "joining": PhaseQLearning(join_share=0.5),
    "phase that slips": PhaseQLearning(alpha=0.1, slip=0.1, max_sweeps=20),
    "cell": CellQLearning(),
    "published": cases.PUBLISHED,
    "faint values": ValueIteration(gamma=0.013),
    "maximum entropy": MaxEntIRL(iterations=20),
}
BY_DAY = 3  # of the learners, and of the samples one
BESIDE = {"position_mm": (160.0, 20.0, 20.0), "rotation_xyzw": (0.0, 0.0, 0.38268343236508984, 0.9238795325112867)}
PSM_M = {"approach": (-0.94, 0.10, -0.33), "base": BESIDE}


def write(folder: Path) -> None:
    """Write the recordings, and the joints of an arm beside its poses."""
    for number, shift in enumerate(((0.0, 0.0, 0.0), (0.4, 0.2, 0.1), (0.9, 0.2, 0.3))):
        (folder / f"table {number}.csv").write_bytes(cases.hand_off(shift))
    for number, detour_deg in enumerate((15.0, -20.0, 0.5)):
        (folder / f"turning {number}.mcap").write_bytes(turning(number, detour_deg=detour_deg))
    for number, shift_mm in enumerate((0.0, 1.5)):
        (folder / f"both {number}.mcap").write_bytes(both_arms(shift_mm))
    for sample in sample_recordings():
        (folder / f"{sample.surgeon} {len(sample.segments)}.mcap").write_bytes(sample.data)
    rng = np.random.default_rng(7)
    for name, head in (("rpy", "roll_rad,pitch_rad,yaw_rad"), ("vector", "rx_rad,ry_rad,rz_rad")):
        turns = np.cumsum(rng.normal(0.0, 0.02, (60, 3)), axis=0)
        rows = np.hstack([np.arange(60)[:, None] / 50, cases.points_mm(), turns]).round(6).tolist()
        text = "\n".join([f"t_s,x_mm,y_mm,z_mm,{head}", *(",".join(map(str, row)) for row in rows), ""])
        (folder / f"{name}.csv").write_text(text)
    (folder / "jigsaws.txt").write_bytes(trials.text(trials.kinematics()))
    drawn = arms.drawn(3)
    speeds = np.gradient(drawn.joints, 1.0 / arms.RATE_HZ, axis=0)
    np.savez(folder / "arm.npz", joints=drawn.joints, tip=drawn.tip_mm, rotation=drawn.rotation, speeds=speeds)


def made(folder: Path, *, night: bool) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the digests of all values by name, and the figures of the playbacks, which an engine computes."""
    digests, figures = {"scene": scene_digest(SCENE)}, {}
    for name in ("rpy.csv", "vector.csv", "jigsaws.txt", "both 0.mcap", "kestrel 5.mcap"):
        with (folder / name).open("rb") as file:
            told = parse_recording(file)
        digests[f"recording {name}"] = bits(told)
    with np.load(folder / "arm.npz") as arm:
        digests["instrument of joints"] = bits(
            identify(arm["joints"], arm["tip"], arm["rotation"], speeds=arm["speeds"], in_base=False, stated=None)
        )
        digests["executed motion"] = bits(predict(arm["joints"], np.arange(len(arm["joints"])) / arms.RATE_HZ, Servo()))
    with TemporaryDirectory() as place, closing(Database(f"sqlite:///{place}/machine.sqlite")) as database:
        database.migrate()
        cases.add_surgeon(database)
        digests |= of_demonstrations(database, folder)
        versions = train(database, folder, night=night)
        plans = {"without a hand-off": cases.add_plan(database)}
        plans["with a hand-off"] = cases.add_plan(database, psm_m=PSM_M, version=versions["two arms"].version)
        for surgeon in ("heron", "kestrel", "plover", "wren")[: 4 if night else 1]:
            cases.add_surgeon(database, surgeon)
            store(database, folder / f"{surgeon} 1.mcap", surgeon)
            versions[surgeon] = cases.train(database, surgeon, release=True)
            plans[surgeon] = cases.add_plan(database, surgeon)
        digests |= dict(of_versions(database, versions))
        digests |= dict(of_plans(database, plans))
        for name, plan in plans.items() if night else ():
            figures[name] = played(database, plan)
    return digests, figures


def bits(value: Any) -> str:
    """Return the SHA-256 of any value: of the types, names, and every bit of every number in it."""
    seen = hashlib.sha256()
    for part in _parts(value):
        seen.update(part)
    return seen.hexdigest()


def _parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode() + value.tobytes()
    elif is_dataclass(value):
        for field in fields(value):
            yield field.name.encode()
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, dict):
        yield from _parts(tuple(value.items()))
    elif isinstance(value, tuple | list):
        yield b"("
        for one in value:
            yield from _parts(one)
    else:
        yield repr(value).encode()


def store(database: Database, file: Path, surgeon: str = "kestrel", **cut: Any) -> Demonstration:
    return cases.store(
        database, cases.upload(file.read_bytes(), CSV if file.suffix == ".csv" else MCAP), surgeon, **cut
    )


def of_demonstrations(database: Database, folder: Path) -> dict[str, str]:
    """Store the demonstrations; return the digests of their samples, their paths and their reward maps."""
    found = {}
    for file in sorted(folder.glob("t* ?.*")):
        hysteresis = 0.1 if file.stem == "table 1" else 0.0
        row = store(database, file, hysteresis=hysteresis)
        with database.reading() as session:
            kept = session.get_one(Demonstration, row.row)
            reward = select(StoredRewardMap.sha256).where(StoredRewardMap.demonstration_row == row.row)
            found[f"demonstration {file.stem}"] = kept.sha256
            found[f"samples and path {file.stem}"] = bits([kept.demo, kept.path])
            found[f"reward map {file.stem}"] = session.scalars(reward).one()
    return found


def train(database: Database, folder: Path, *, night: bool) -> dict[str, PolicyVersion]:
    """Train with every learner, in a scene, from several demonstrations, and with pose styles."""
    with database.reading() as session:
        rows = session.scalars(select(Demonstration.sha256).order_by(Demonstration.row)).all()
    tables, turns = [*rows[:3]], [*rows[3:6]]
    versions = {
        name: cases.train(database, demos=tables[:1], learner=learner)
        for name, learner in list(LEARNERS.items())[: len(LEARNERS) if night else BY_DAY]
    }
    versions["scene"] = cases.train(database, demos=tables[:1], scene=SCENE.as_json(), learner=SLIPPING)
    for name in COMBININGS if night else ():
        versions[name] = cases.train(database, demos=tables, combine=name)
    versions["several poses"] = cases.train(database, demos=turns, combine="corridor")
    both = [store(database, folder / f"both {number}.mcap", arm="PSM2", segment="whole") for number in (0, 1)]
    versions["two arms"] = cases.train(database, demos=[one.sha256 for one in both], release=True)
    return versions


def of_versions(database: Database, versions: dict[str, PolicyVersion]) -> Iterator[tuple[str, str]]:
    with database.reading() as session:
        for name, version in versions.items():
            row = session.get_one(PolicyVersion, version.row)
            yield f"policy {name}", row.sha256
            yield f"values of policy {name}", digest(learnt(row))
            yield f"coverage of policy {name}", digest(row.covered)
            if row.poses is not None:
                yield f"pose style {name}", row.poses.sha256
                yield f"poses and tube {name}", bits(posed(row.poses))


def of_plans(database: Database, plans: dict[str, Plan]) -> Iterator[tuple[str, str]]:
    with database.reading() as session:
        for name, plan in plans.items():
            row = session.get_one(Plan, plan.row)
            yield f"plan {name}", row.sha256
            yield f"description of plan {name}", sha256(row.about.model_dump_json().encode())
            yield f"trajectory of plan {name}", bits(trajectory_of(planned(row)))


def played(database: Database, plan: Plan) -> dict[str, Any]:
    """Play a plan, and return the report."""
    with database.writing() as session:
        job = request_playback(session, plan.sha256, "test", Settings())[0]
    ended = cases.work(database, job)
    assert ended.state == "succeeded", ended.error
    with database.reading() as session:
        wanted = select(StoredPlayback).where(StoredPlayback.sha256 == (ended.result or {})["playback"])
        return as_json(session.scalars(wanted).one().report)


if __name__ == "__main__":
    part, where = sys.argv[1], Path(sys.argv[2])
    if part == "write":
        write(where)
    else:
        print(json.dumps(made(where, night=part == "night")))
