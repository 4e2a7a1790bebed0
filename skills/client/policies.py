"""Calls of policies (versions, releases, cards, rollouts), of atlases of a suture type, and of scores."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from skills.client.connection import Connection, at, call, given
from skills.client.transport import keep
from skills.errors import BadInput
from skills.schemas.given import Atlas, NextStep, Policy, PolicyCard, PolicySummary, Rollout, Score, Version

JSON, NPZ = "application/json", "application/x-npz"


class Atlases(Connection):
    """Calls of atlases."""

    @call
    async def atlas(
        self, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
    ) -> Atlas:
        """Return the atlas of a suture type.

        Args:
            suture: The suture type.
            scaled: Normalise size too; distances are then in units of the distance from start to goal.
            clusters: Number of clusters; default: as many as are found.
            demo: Digest of a demonstration in the atlas; the atlas then says whose style it resembles.
        """
        return await self._get(Atlas, at("styles", suture, "atlas"), scaled=scaled, clusters=clusters, demo=demo)


class Scores(Connection):
    """Calls of scores."""

    @call
    async def score(
        self,
        surgeon: str,
        suture: str,
        *,
        demo: str | None = None,
        recording: str | None = None,
        arm: str | None = None,
        topic: str | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        reference: str | None = None,
    ) -> Score:
        """Score a demonstration, or a part of a recording, against a style; nothing is stored. Not a credential.

        Args:
            surgeon: The surgeon whose style is the reference.
            suture: The suture type.
            demo: Digest of the demonstration to score; give either this or `recording`.
            recording: Digest of the recording of which a part is scored.
            arm: The arm in the recording.
            topic: The topic in the recording.
            start_s: Start of the part in the recording.
            end_s: End of the part.
            reference: The demonstration of the style to compare with; default: that of its released policy, else its
                newest.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "demo": demo, "recording": recording, "reference": reference},
            **{"arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
        }
        return await self._ask(Score, "POST", at("scores"), given(body))


if TYPE_CHECKING:
    from skills.learning.policy import Policy as LearntPolicy

Position = Sequence[float]


class Policies(Connection):
    """Calls of policies."""

    @call
    async def policies(self, surgeon: str | None = None, suture: str | None = None) -> list[PolicySummary]:
        """List the released policies."""
        return await self._all(PolicySummary, at("policies"), surgeon=surgeon, suture=suture)

    @call
    async def policy(self, surgeon: str, suture: str, version: int | None = None) -> Policy:
        """Return the released policy of a style, or one of its versions."""
        return await self._get(Policy, _path(surgeon, suture, version))

    @call
    async def policy_version(self, policy: str) -> Policy:
        """Return a policy version by the digest under which it is cited."""
        return await self._get(Policy, at("policy-versions", policy))

    @call
    async def learnt(self, surgeon: str, suture: str, version: int | None = None) -> "LearntPolicy":
        """Download a policy with its Q values, to be followed locally, and verify all of it against its digest.

            policy = client.learnt("kestrel", "simple-running")
            skills.rollout(policy, (-30, 25, -140)).tip_mm

        Raises:
            Corrupt: The arrays or the metadata do not match the digest.
        """
        _, _, policy = await self._verified(surgeon, suture, version)
        return policy

    @call
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
        said, arrays, _ = await self._verified(surgeon, suture, version)
        await self._transport.aside(lambda: keep(said if to.suffix == ".json" else arrays, to))
        return to

    @call
    async def policy_arrays(self, policy: str) -> bytes:
        """Return a policy version's arrays by its digest: an .npz with the Q values."""
        return await self._bytes(at("policy-versions", policy), NPZ)

    @call
    async def versions(self, surgeon: str, suture: str) -> list[Version]:
        """List the versions of a style, the newest first."""
        return await self._all(Version, at("policies", surgeon, suture, "versions"))

    @call
    async def policy_card(self, surgeon: str, suture: str, version: int) -> PolicyCard:
        """Return the card of a version: data, learner, figures, limits, and the digests of all that it rests on."""
        return await self._get(PolicyCard, at("policies", surgeon, suture, "versions", version, "card"))

    @call
    async def save_policy_card(self, surgeon: str, suture: str, version: int, to: Path) -> Path:
        """Write the card of a version to a .json file, or to an .html file for people.

        Raises:
            BadInput: The file name has neither suffix.
        """
        if to.suffix not in (".json", ".html"):
            raise BadInput(f"{to.name} ends in neither .json nor .html.", "Name a .html for people, or a .json.")
        path = at("policies", surgeon, suture, "versions", version, "card")
        return await self._save(path, to, None, accept=JSON if to.suffix == ".json" else "text/html")

    @call
    async def release(self, surgeon: str, suture: str, version: int) -> Version:
        """Release a version, or an older one again.

        The request is not retried after a lost connection, because somebody may have released another version
        meanwhile.
        """
        path = at("policies", surgeon, suture, "versions", version, "release")
        return await self._ask(Version, "POST", path, harmless=False)

    @call
    async def withdraw(self, surgeon: str, suture: str) -> None:
        """Withdraw the released policy; like `release`, the request is not retried after a lost connection."""
        await self._send("DELETE", at("policies", surgeon, suture, "release"), harmless=False)

    @call
    async def rollout(self, surgeon: str, suture: str, start_mm: Position, version: int | None = None) -> Rollout:
        """Follow a policy from a position to the goal."""
        body = {"start_mm": list(start_mm), "version": version}
        return await self._ask(Rollout, "POST", at("policies", surgeon, suture, "rollouts"), body)

    @call
    async def next(self, surgeon: str, suture: str, position_mm: Position, phase: int | None = None) -> NextStep:
        """Return the next action of the released policy at a position; nothing moves."""
        body = {"position_mm": list(position_mm), "phase": phase}
        return await self._ask(NextStep, "POST", at("policies", surgeon, suture, "next"), body)

    async def _verified(self, surgeon: str, suture: str, version: int | None) -> tuple[bytes, bytes, "LearntPolicy"]:
        """Return a policy's JSON, its arrays, and the policy rebuilt from them and verified."""
        from skills.client.verification import rebuilt  # the learning core, slow to import

        said = await self._bytes(_path(surgeon, suture, version), JSON)
        about = json.loads(said)
        arrays = await self._bytes(at("policy-versions", about["sha256"]), NPZ)
        demo = await self._json("GET", at("demos", about["demos"][0]))
        return said, arrays, await self._transport.aside(lambda: rebuilt(about, arrays, demo))


def _path(surgeon: str, suture: str, version: int | None) -> str:
    which = () if version is None else ("versions", version)
    return at("policies", surgeon, suture, *which)
