"""Signed bags: consistent changes with right checksums, and flipped bits, refused by whoever has the key.

Somebody who knows the code rewrites the motion, its kinematics, its velocities, the papers and all checksums. These
bags have nothing wrong in themselves, so that only the signature distinguishes them from the exported one.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import radians
from typing import Any

import numpy as np
import pytest

from skills.errors import BadBag, BadSignature, SkillsError
from skills.formats.replay_bag import arms_of, seal, segment_index, segment_motions
from skills.formats.verify import SIGNATURE, verify_bag
from skills.kinematics import forward, quaternion_of
from skills.packing import canonical, sha256
from skills.planning.trajectory import A1, A2, Trajectory
from skills.transparency.merkle import Checkpoint, Tree
from skills.transparency.signing_keys import PublicKey, SigningKey
from skills.transparency.statements import attest, read_envelope
from tests.formats.replays import FRAME, folders, judged, members, papers
from tests.formats.replays import trajectory as short
from tests.independent_history import check_envelope

KEY, ORIGIN = SigningKey(bytes(range(32))), "suture-skills/0123456789abcdef"
PUBLIC = PublicKey.read(KEY.verifier(ORIGIN))
PLAN, MOTION = "1" * 64, "5" * 64
Files = dict[str, bytes]


def bend(samples: int) -> Any:
    """Return a smooth bump of height 1, flat at both ends."""
    return np.sin(np.linspace(0.0, np.pi, samples)) ** 2


def moved(joints: Any, beside: Any = None, **changes: Any) -> Trajectory:
    """Return two slow passes with other joints, and whatever follows from them."""
    tip_mm, rotation = forward(joints, changes.get("instrument", "400006"))
    other = replace(BESIDE, joints=PSM_M if beside is None else beside)
    made = replace(
        short(), rate_hz=RATE_HZ, stamps_s=STAMPS_S, tip_mm=tip_mm, rotation_xyzw=quaternion_of(rotation),
        joints=joints, pass_index=PASSES, phase=PHASES, psm_m=other, jaw_rad=np.full(len(joints), 0.1),
    )  # fmt: skip
    return replace(made, **changes)


RATE_HZ, EACH = 50.0, 150
_U = np.linspace(0, 1, EACH)[:, None]
_HERE = np.array([-0.07, -0.4, 153.0, 0.01, 0.4, 0.07])
_THERE = _HERE + np.array([0.1, 0.02, -9.0, 0.3, 0.1, -0.2])
_SMOOTH = 10 * _U**3 - 15 * _U**4 + 6 * _U**5
JOINTS = np.concatenate([_HERE + _SMOOTH * (_THERE - _HERE), _THERE + _SMOOTH * (_HERE - _THERE)])
PSM_M = JOINTS[::-1] * [1, 1, 1.1, 1, 1, 1]
PASSES = np.repeat([0, 1], EACH)
PHASES = np.tile(np.repeat([A1, A2], [EACH - 50, 50]), 2)
STAMPS_S = np.arange(2 * EACH) / RATE_HZ + PASSES * 1.0
BESIDE: Any = short().psm_m


def bag_of(made: Trajectory, arm: str = "PSM2", **changes: Any) -> Files:
    """Return the files of a bag without signature, in which everything agrees."""
    arms = arms_of(made, arm=arm, frame=FRAME, other="PSM1" if arm == "PSM2" else "PSM2")
    index = segment_index(segment_motions(made, arms), PLAN).model_dump(mode="json")
    said = papers(made, **({"report": {"trajectory": MOTION, "arms": judged(made)}, "index": index} | changes))
    return said | folders(made, arms)


def digests(files: Files) -> dict[str, str]:
    return {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}


def signed(files: Files, key: SigningKey = KEY, head_key: SigningKey = KEY, **facts: Any) -> Files:
    """Return the files with a signature of them by a key."""
    plan, verdict = (json.loads(files[name]) for name in ("plan.json", "verdict.json"))
    bound = {"kind": "replay-bag", "plan": plan["sha256"], "verdict": verdict["sha256"], "policy": verdict["policy"]}
    bound |= {"trajectory": verdict["report"].get("trajectory"), **facts}
    note = head_key.sign(Checkpoint(ORIGIN, 0, Tree().root))
    return files | {SIGNATURE: attest(digests(files), {**bound, "checkpoint": note}, key, ORIGIN)}


def checked(files: Files, key: PublicKey | None = PUBLIC) -> list[str]:
    """Seal files with right checksums and check them."""
    return verify_bag(io.BytesIO(seal(files)), key)


@cache
def exported() -> Files:
    return signed(bag_of(moved(JOINTS)))


# ---- consistent changes


def bent(joint: int, by: float, passes: int = 2) -> Trajectory:
    joints = JOINTS.copy()
    joints[: passes * EACH, joint] += by * np.tile(bend(EACH), passes)
    return moved(joints)


def without_a2() -> Trajectory:
    joints = JOINTS.copy()
    for first in (0, EACH):
        joints[first + EACH - 50 : first + EACH] = joints[first + EACH - 51]
    joints[EACH : EACH + 60] += (joints[EACH - 1] - joints[EACH]) * np.linspace(1, 0, 60)[:, None]
    return moved(joints)


def stepped() -> Trajectory:
    joints = JOINTS.copy()
    joints[70:, 0] += 0.015  # 0.75 rad/s in one tick, within the limit of a joint's speed
    return moved(joints)


def shaken() -> Trajectory:
    joints = JOINTS.copy()
    joints[:, 2] += 0.45 * np.sin(np.arange(len(joints)) * np.pi / 4)
    return moved(joints)


def opened() -> Trajectory:
    return moved(JOINTS, jaw_rad=0.1 + 0.6 * np.tile(bend(EACH), 2))


def dropped() -> Trajectory:
    jaw = np.full(len(JOINTS), 0.1)
    jaw[60:] = 0.8
    return moved(JOINTS, jaw_rad=jaw)


def stalled() -> Trajectory:
    later = STAMPS_S + np.where(np.arange(len(STAMPS_S)) >= 40, 0.5, 0.0)
    return moved(JOINTS, stamps_s=later)


def with_other(change: Callable[[Any], Any]) -> Trajectory:
    return moved(JOINTS, change(PSM_M.copy()))


def another_base() -> Files:
    psm_m = {"base_mm": [160.0, 30.0, 20.0], "instrument": "420006"}
    return bag_of(moved(JOINTS), plan={"psm_m": psm_m})


def without_psm_m() -> Files:
    return bag_of(replace(moved(JOINTS), psm_m=None))


def edited(name: str, **changes: Any) -> Files:
    """Return the files with some fields of a paper changed, and the digest of the verdict computed again."""
    files = {one: data for one, data in exported().items() if one != SIGNATURE}
    paper = json.loads(files[name])
    paper |= changes
    if name == "verdict.json":
        paper["sha256"] = sha256(canonical([paper["plan"], paper["report"]]))
    return files | {name: json.dumps(paper).encode()}


SHIFT = np.array([0, 0, 10.0, 0, 0, 0])
ROLL = np.array([0, 0, 0, radians(90), 0, 0])
CHANGES: dict[str, Callable[[], Files]] = {
    "the path bent by 40 mm": lambda: bag_of(bent(0, 0.305)),
    "the path bent by 40 mm in the first pass alone": lambda: bag_of(bent(1, 0.27, 1)),
    "the jaw opened and closed again": lambda: bag_of(opened()),
    "the needle dropped": lambda: bag_of(dropped()),
    "A2 removed": lambda: bag_of(without_a2()),
    "A2 turned by 90 degrees": lambda: bag_of(moved(JOINTS + ROLL)),
    "PSM_M 10 mm deeper": lambda: bag_of(with_other(lambda joints: joints + SHIFT)),
    "PSM_M's base 10 mm off": another_base,
    "PSM_M removed": without_psm_m,
    "PSM_M still": lambda: bag_of(with_other(lambda joints: joints * 0 + joints[:1])),
    "a step in one tick": lambda: bag_of(stepped()),
    "a shake of 0.45 mm": lambda: bag_of(shaken()),
    "the goal 10 mm deeper": lambda: bag_of(moved(JOINTS + SHIFT)),
    "the motion reversed": lambda: bag_of(moved(JOINTS[::-1].copy())),
    "the arms swapped": lambda: bag_of(moved(JOINTS), arm="PSM1", plan={"arm": "PSM1"}),
    "a stall of 0.5 s": lambda: bag_of(stalled()),
    "half as fast": lambda: bag_of(moved(JOINTS, stamps_s=2 * STAMPS_S)),
    "the passes exchanged": lambda: bag_of(moved(np.roll(JOINTS, EACH, axis=0))),
    "another instrument": lambda: bag_of(moved(JOINTS, instrument="420006")),
    "the verdict swapped": lambda: edited("verdict.json", report=REPORT | {"trajectory": "6" * 64}),
    "the verdict surer": lambda: edited("verdict.json", report=REPORT | {"estimate": {"under": []}}),
    "the policy's limits removed": lambda: edited("policy.json", limits=""),
    "the plan's words changed": lambda: edited("plan.json", description="It is safe near a person."),
    "another plan with its own verdict": lambda: members() | papers(short()),
}  # fmt: skip
REPORT = {"feasible": True, "trajectory": MOTION, "arms": judged(moved(JOINTS))}
IN_THEMSELVES = {  # found without the signature
    "A2 removed": "accelerates beyond its limit",
    "a step in one tick": "accelerates beyond its limit",
    "a shake of 0.45 mm": "is not the index",  # a pass begins elsewhere than the one before ended
    "the passes exchanged": "is not the index",
    "a stall of 0.5 s": "later than 50 Hz has it",
    "half as fast": "later than 50 Hz has it",
    "PSM_M still": "PSM_M is in the bag and not in",
}
FORGERY = SigningKey(bytes(32))


def resigned(files: Files, by: str) -> Files:
    """Return the files with one of the signatures that somebody without the key can give them."""
    old = exported()[SIGNATURE]
    match by:
        case "nobody":
            return {name: data for name, data in files.items() if name != SIGNATURE}
        case "the old signature":
            return files | {SIGNATURE: old}
        case "the old signature around new digests":
            said, new = json.loads(old), json.loads(signed(files)[SIGNATURE])
            return files | {SIGNATURE: json.dumps(new | {"signatures": said["signatures"]}).encode()}
        case "another key":
            return signed(files, FORGERY, FORGERY)
        case _:  # another key under the id of the right one
            new = json.loads(signed(files, FORGERY, FORGERY)[SIGNATURE])
            new["signatures"][0]["keyid"] = PUBLIC.number
            return files | {SIGNATURE: json.dumps(new).encode()}


FORGERIES = (
    "nobody", "the old signature", "the old signature around new digests", "another key", "another key by that id",
)  # fmt: skip


def test_the_exported_bag_is_right_and_its_signature_is_checked_by_others():
    *_, line = checked(exported())
    assert line.startswith(f"Signed with the key {PUBLIC.number}, under the history of 0 leaves")
    *_, line = checked(exported(), None)
    assert line.startswith(f"SIGNATURE NOT VERIFIED, of the key {PUBLIC.number}")
    said = check_envelope(exported()[SIGNATURE], str(PUBLIC))
    files = {name: data for name, data in exported().items() if name != SIGNATURE}
    assert {one["name"]: one["digest"]["sha256"] for one in said["subject"]} == digests(files)
    assert (said["predicate"]["plan"], said["predicate"]["trajectory"]) == (PLAN, MOTION)


def test_the_bent_path_is_bent_by_40_mm():
    off_mm = np.linalg.norm(bent(0, 0.305).tip_mm - moved(JOINTS).tip_mm, axis=1)
    assert 38 < off_mm.max() < 42


def test_an_unsigned_bag_is_readable_and_called_so():
    *_, line = checked(members(), None)
    assert line.startswith("UNSIGNED")
    with pytest.raises(BadBag, match=r"has no signature\.dsse"):
        checked(members())


def test_a_bag_that_says_it_was_signed_is_refused_without_its_signature():
    """Also without a key: the README names the signature that is no longer there, and all checksums are right."""
    said = {
        "README.txt": b"1. `skills verify FILE.zip --key KEY`, with the key of the service that wrote signature.dsse.\n"
    }
    whole = signed(bag_of(moved(JOINTS)) | said)
    assert checked(whole) and checked(whole, None)
    removed = {name: data for name, data in whole.items() if name != SIGNATURE}
    with pytest.raises(BadBag, match=r"no signature\.dsse, which README\.txt or the key demands: it was removed"):
        checked(removed, None)


@pytest.mark.parametrize("name", CHANGES)
def test_a_consistent_change_with_right_checksums_is_refused(name: str):
    assert len(CHANGES) >= 20
    changed = CHANGES[name]()
    assert digests(changed) != digests({one: data for one, data in exported().items() if one != SIGNATURE})
    if name in IN_THEMSELVES:
        with pytest.raises(BadBag, match=IN_THEMSELVES[name]):
            checked(changed, None)
    else:
        assert checked(changed, None)[-1].startswith("UNSIGNED")  # everything agrees
    for by in FORGERIES:
        with pytest.raises((BadBag, BadSignature), match=r"(?i)signature"):
            checked(resigned(changed, by))


@pytest.mark.parametrize("joint", range(6))
def test_another_motion_than_the_judged_one_is_found_without_a_key(joint: int):
    """Somebody has changed the motion, and not computed the verdict's figures again."""
    bag = bag_of(bent(joint, 0.01), report=REPORT)
    with pytest.raises(BadBag, match=r"PSM2 is not the motion that was judged"):
        checked(bag, None)
    beside = bag_of(with_other(lambda joints: joints * np.where(np.arange(6) == joint, 1.001, 1.0)), report=REPORT)
    with pytest.raises(BadBag, match=r"PSM1 is not the motion that was judged"):
        checked(beside, None)


@pytest.mark.parametrize("arms", [3, [], [{"name": "PSM_A"}], [{"name": "PSM_A", "joints": [{}]}, {"name": "PSM_M"}]])
def test_a_verdict_with_unreadable_figures_is_refused(arms: object):
    with pytest.raises(BadBag, match=r"missing or invalid field"):
        checked(bag_of(moved(JOINTS), report=REPORT | {"arms": arms}), None)


def test_a_signature_of_other_facts_or_another_history_is_refused():
    files = {name: data for name, data in exported().items() if name != SIGNATURE}
    for facts in ({"kind": "card"}, {"plan": "2" * 64}, {"verdict": "2" * 64}, {"policy": None}, {"trajectory": "6"}):
        with pytest.raises(BadBag, match=r"about another plan, verdict, policy or motion"):
            checked(signed(files, **facts))
    with pytest.raises(BadBag, match=r"checkpoint in .* is not of the key"):
        checked(signed(files, head_key=FORGERY))
    for envelope in (b"", b"{}", b"\xff", exported()[SIGNATURE][:-9]):
        with pytest.raises(SkillsError):
            checked(files | {SIGNATURE: envelope})


def test_200_flipped_bits_are_refused_with_checksums_rewritten_or_not():
    files, rng = exported(), np.random.default_rng(3)
    names = sorted(files)
    for number in range(200):
        name = names[number % len(names)]
        flipped = bytearray(files[name])
        flipped[int(rng.integers(0, len(flipped)))] ^= 1 << int(rng.integers(0, 8))
        try:
            checked(files | {name: bytes(flipped)})
        except SkillsError:
            continue
        # the base64 of an envelope has bits that mean nothing, and its key id is not signed
        assert name == SIGNATURE
        assert read_envelope(bytes(flipped)).statement_by(PUBLIC) == read_envelope(files[name]).statement_by(PUBLIC)


def test_200_flipped_bits_of_the_archive_are_refused_or_change_no_file():
    whole, rng = seal(exported()), np.random.default_rng(4)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        right = {name: archive.read(name) for name in archive.namelist()}
    for place in rng.integers(0, 8 * len(whole), 200).tolist():
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        try:
            verify_bag(io.BytesIO(bytes(flipped)), PUBLIC)
        except SkillsError:
            continue
        with zipfile.ZipFile(io.BytesIO(bytes(flipped))) as archive:  # a date, or another field that means nothing here
            assert {name: archive.read(name) for name in archive.namelist()} == right
