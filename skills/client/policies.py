"""Calls of trainings and tries, and of policies: versions, releases, cards, signatures, rollouts and next steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

from skills import schemas
from skills.client.connection import Connection, parse_text
from skills.client.files import write_file
from skills.client.waiting import in_thread
from skills.errors import BadInput
from skills.keywords import RetrainingKeywords, TrainingKeywords, TryKeywords

if TYPE_CHECKING:
    from skills.learning.policy import Policy as LearntPolicy
    from skills.schemas.cards import PolicyCard
    from skills.schemas.operation import Job
    from skills.schemas.policies import NextStep, Policy, PolicySummary, Rollout, Version
    from skills.schemas.pose_styles import NextPose, PoseStyle
    from skills.schemas.training import RetrainedStyle, Retraining
    from skills.transparency.statements import SignedEnvelope

Combining = Literal["medoid", "barycentre", "corridor"]
Position = Sequence[float]

JSON, NPZ = "application/json", "application/x-npz"
STYLE = "/policies/{surgeon}/{suture}"
VERSION = STYLE + "/versions/{version}"


class Policies(Connection):
    """Calls of trainings, tries and policies."""

    async def train(
        self, surgeon: str, suture: str, *, combine: Combining | None = None, **options: Unpack[TrainingKeywords]
    ) -> Job:
        """Request the training of a style; an equal request returns the same job.

        The job's `did` states the effect of the request, and its result is a `TrainingResult`. With `release`, the
        request is not retried after a lost connection, because somebody may have decided otherwise in between.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            combine: Method that combines several demonstrations into one path; default: a corridor.
            **options: The demonstrations, the learner, the scene, and whether to release the version.
        """
        combining = None if combine is None else {"kind": combine}
        body = {"surgeon": surgeon, "suture": suture, "combine": combining, **options}
        return await self._ask(schemas.operation.Job, "POST", "/trainings", body, idempotent=not options.get("release"))

    async def try_recording(self, recording: str, surgeon: str, suture: str, **options: Unpack[TryKeywords]) -> Job:
        """Request a stored recording's way to a verdict: cut, learnt, certified, planned, played, released if wanted.

        The job's result is a `TryResult` with the steps so far, also while it runs. The job ends with a question where
        one is open: send it again with one of the step's choices, whose `change` has keywords of this call.
        """
        body = {"recording": recording, "surgeon": surgeon, "suture": suture, **options}
        return await self._ask(schemas.operation.Job, "POST", "/tries", body, idempotent=not options.get("release"))

    async def retrain(self, **options: Unpack[RetrainingKeywords]) -> Job:
        """Request the training of styles again, as one job: all, or those of a surgeon or of a suture type.

        With `release`, the request is not retried after a lost connection, as with `train`.
        """
        return await self._ask(
            schemas.operation.Job, "POST", "/retrainings", options, idempotent=not options.get("release")
        )

    async def retraining(self, job: str) -> Retraining:
        """Return a batch: its job, and in `styles` the number of styles in each state."""
        return await self._get(schemas.training.Retraining, "/retrainings/{job}", job=job, limit=1)

    async def retrained(
        self, job: str, state: Literal["queued", "done", "failed", "cancelled"] | None = None
    ) -> list[RetrainedStyle]:
        """List the styles of a batch, all or those of one state."""
        return await self._all(schemas.training.RetrainedStyle, "/retrainings/{job}", job=job, state=state)

    async def policies(self, surgeon: str | None = None, suture: str | None = None) -> list[PolicySummary]:
        """List the released policies."""
        return await self._all(schemas.policies.PolicySummary, "/policies", surgeon=surgeon, suture=suture)

    async def policy(self, surgeon: str, suture: str, version: int | None = None) -> Policy:
        """Return the released policy of a style, or one of its versions."""
        return await self._get(schemas.policies.Policy, _path(version), surgeon=surgeon, suture=suture, version=version)

    async def policy_version(self, policy: str) -> Policy:
        """Return a policy version by the digest under which it is cited."""
        return await self._get(schemas.policies.Policy, "/policy-versions/{policy}", policy=policy)

    async def learnt(self, surgeon: str, suture: str, version: int | None = None) -> LearntPolicy:
        """Download a policy with its Q values, to be followed locally, and verify all of it against its digest.

            policy = client.learnt("kestrel", "simple-running")
            skills.rollout(policy, (-30, 25, -140)).tip_mm

        Raises:
            Corrupt: The arrays or the metadata do not match the digest.
        """
        _, _, policy = await self._verified(surgeon, suture, version)
        return policy

    async def save_policy(self, surgeon: str, suture: str, to: Path, version: int | None = None) -> Path:
        """Write a policy to a .json file, or to an .npz file with its Q values, after verifying it as `learnt` does.

        Raises:
            BadInput: The file name has neither suffix.
            Corrupt: The policy does not match its digest; no file is written.
        """
        if to.suffix not in (".json", ".npz"):
            raise BadInput(
                f"{to.name} ends in neither .json nor .npz.", "Name a .json file, or a .npz for its Q values."
            )
        document, arrays, _ = await self._verified(surgeon, suture, version)
        await in_thread(lambda: write_file(document if to.suffix == ".json" else arrays, to))
        return to

    async def policy_arrays(self, policy: str) -> bytes:
        """Return a policy version's arrays by its digest: an .npz with the Q values."""
        return await self._bytes("/policy-versions/{policy}", NPZ, policy=policy)

    async def versions(self, surgeon: str, suture: str) -> list[Version]:
        """List the versions of a style, the newest first."""
        return await self._all(schemas.policies.Version, STYLE + "/versions", surgeon=surgeon, suture=suture)

    async def policy_card(self, surgeon: str, suture: str, version: int) -> PolicyCard:
        """Return the card of a version: data, learner, figures, limits, and the digests of all that it rests on."""
        return await self._get(
            schemas.cards.PolicyCard, VERSION + "/card", surgeon=surgeon, suture=suture, version=version
        )

    async def policy_signature(self, surgeon: str, suture: str) -> SignedEnvelope:
        """Return the service's signature of the files of the released policy: its JSON, arrays and pose style."""
        from skills.transparency.statements import SignedEnvelope  # here and below, because of numpy

        return await self._get(SignedEnvelope, STYLE + "/signature", surgeon=surgeon, suture=suture)

    async def policy_card_signature(self, surgeon: str, suture: str, version: int) -> SignedEnvelope:
        """Return the service's signature of the card of a version as it is now, as JSON and as a page."""
        from skills.transparency.statements import SignedEnvelope

        path = VERSION + "/card/signature"
        return await self._get(SignedEnvelope, path, surgeon=surgeon, suture=suture, version=version)

    async def save_signature(self, surgeon: str, suture: str, to: Path, card_of: int | None = None) -> Path:
        """Write the service's signature of the released policy to a file, or that of the card of a version."""
        path = STYLE + "/signature" if card_of is None else VERSION + "/card/signature"
        return await self._save(path, to, accept=JSON, surgeon=surgeon, suture=suture, version=card_of)

    async def save_policy_card(self, surgeon: str, suture: str, version: int, to: Path) -> Path:
        """Write the card of a version to a .json file, or to an .html file for people.

        Raises:
            BadInput: The file name has neither suffix.
        """
        if to.suffix not in (".json", ".html"):
            raise BadInput(f"{to.name} ends in neither .json nor .html.", "Name a .html for people, or a .json.")
        accept = JSON if to.suffix == ".json" else "text/html"
        return await self._save(VERSION + "/card", to, accept=accept, surgeon=surgeon, suture=suture, version=version)

    async def release(self, surgeon: str, suture: str, version: int) -> Version:
        """Release a version, or an older one again.

        The request is not retried after a lost connection, because somebody may have released another version
        meanwhile.
        """
        path = VERSION + "/release"
        return await self._ask(
            schemas.policies.Version, "POST", path, idempotent=False, surgeon=surgeon, suture=suture, version=version
        )

    async def withdraw(self, surgeon: str, suture: str) -> None:
        """Withdraw the released policy; like `release`, the request is not retried after a lost connection."""
        style = {"surgeon": surgeon, "suture": suture}
        await self._request("DELETE", STYLE + "/release", style, idempotent=False)

    async def rollout(self, surgeon: str, suture: str, start_mm: Position, version: int | None = None) -> Rollout:
        """Follow a policy from a position to the goal."""
        body = {"start_mm": start_mm, "version": version}
        return await self._ask(
            schemas.policies.Rollout, "POST", STYLE + "/rollouts", body, surgeon=surgeon, suture=suture
        )

    async def next(self, surgeon: str, suture: str, position_mm: Position, phase: int | None = None) -> NextStep:
        """Return the next action of the released policy at a position; nothing moves."""
        body = {"position_mm": position_mm, "phase": phase}
        return await self._ask(schemas.policies.NextStep, "POST", STYLE + "/next", body, surgeon=surgeon, suture=suture)

    async def pose_style(self, surgeon: str, suture: str) -> PoseStyle:
        """Return the pose style of the released policy: the poses of the hand along one phase, and the tube's proof."""
        return await self._get(schemas.pose_styles.PoseStyle, STYLE + "/pose-style", surgeon=surgeon, suture=suture)

    async def next_pose(
        self, surgeon: str, suture: str, position_mm: Position, rotation_xyzw: Sequence[float], phase: int | None = None
    ) -> NextPose:
        """Return the next pose of the released pose style at a pose; nothing moves.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            position_mm: Position of the tip in the frame of the pose style.
            rotation_xyzw: Its orientation, a unit quaternion.
            phase: The phase of the last answer; default: by the version's joining rule.
        """
        body = {"position_mm": position_mm, "rotation_xyzw": rotation_xyzw, "phase": phase}
        return await self._ask(
            schemas.pose_styles.NextPose, "POST", STYLE + "/next", body, surgeon=surgeon, suture=suture
        )

    async def _verified(self, surgeon: str, suture: str, version: int | None) -> tuple[bytes, bytes, LearntPolicy]:
        """Return a policy's JSON, its arrays, and the policy rebuilt from them and verified."""
        from skills.client.verifying import rebuild_policy  # slow to import

        document = await self._bytes(_path(version), JSON, surgeon=surgeon, suture=suture, version=version)
        policy = parse_text(schemas.policies.Policy, document)
        arrays = await self._bytes("/policy-versions/{policy}", NPZ, policy=policy.sha256)
        demo = await self._bytes("/demos/{demo}", JSON, demo=policy.demos[0])
        return document, arrays, await in_thread(lambda: rebuild_policy(document, arrays, demo))


def _path(version: int | None) -> str:
    return STYLE if version is None else VERSION
