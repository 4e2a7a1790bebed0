"""Policies: what is served, its history, and what it does from a place."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from skills.api.schemas.given import NextStep, Policy, PolicyCard, PolicySummary, Rollout, Version
from skills.client.calls import at, call
from skills.client.connection import Connection
from skills.client.files import keep
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.style.policy import Policy as LearntPolicy

Position = Sequence[float]

JSON, NPZ = "application/json", "application/x-npz"


class Policies(Connection):
    """The calls."""

    @call
    async def policies(self, surgeon: str | None = None, suture: str | None = None) -> list[PolicySummary]:
        """List what is served."""
        return await self._all(PolicySummary, at("policies"), surgeon=surgeon, suture=suture)

    @call
    async def policy(self, surgeon: str, suture: str, version: int | None = None) -> Policy:
        """Get the released policy of a style, or one of its versions."""
        return await self._get(Policy, _path(surgeon, suture, version))

    @call
    async def policy_version(self, policy: str) -> Policy:
        """Get a policy version by its digest, as it is cited."""
        return await self._get(Policy, at("policy-versions", policy))

    @call
    async def learnt(self, surgeon: str, suture: str, version: int | None = None) -> "LearntPolicy":
        """Fetch a policy with its Q values, to be followed here, and check all of it against its digest.

            policy = client.learnt("kestrel", "simple-running")
            skills.rollout(policy, (-30, 25, -140)).tip_mm

        Raises:
            Corrupt: The numbers, or anything that is said of them, are not what the digest was taken of.
        """
        _, _, policy = await self._verified(surgeon, suture, version)
        return policy

    @call
    async def save_policy(self, surgeon: str, suture: str, to: Path, version: int | None = None) -> Path:
        """Write a policy to a file that ends in .json, or in .npz with its Q values, once it is checked as by `learnt`.

        Raises:
            BadInput: The file ends in neither.
            Corrupt: It is not what its digest was taken of; nothing was kept.
        """
        if to.suffix not in (".json", ".npz"):
            raise BadInput("A policy is written to a file that ends in .json or .npz.")
        said, arrays, _ = await self._verified(surgeon, suture, version)
        await self._transport.aside(lambda: keep(said if to.suffix == ".json" else arrays, to))
        return to

    @call
    async def policy_arrays(self, policy: str) -> bytes:
        """Get a policy version's arrays, an .npz with the Q values, by its digest."""
        return await self._bytes(at("policy-versions", policy), NPZ)

    @call
    async def versions(self, surgeon: str, suture: str) -> list[Version]:
        """List the versions of a style, the newest first."""
        return await self._all(Version, at("policies", surgeon, suture, "versions"))

    @call
    async def policy_card(self, surgeon: str, suture: str, version: int) -> PolicyCard:
        """Get the card of a version: its data, learner, figures, limits, and the digests of what it rests on."""
        return await self._get(PolicyCard, at("policies", surgeon, suture, "versions", version, "card"))

    @call
    async def save_policy_card(self, surgeon: str, suture: str, version: int, to: Path) -> Path:
        """Write the card of a version to a file that ends in .json, or in .html for people.

        Raises:
            BadInput: The file ends in neither.
        """
        if to.suffix not in (".json", ".html"):
            raise BadInput("A policy card is written to a file that ends in .json or .html.")
        path = at("policies", surgeon, suture, "versions", version, "card")
        return await self._save(path, to, None, accept=JSON if to.suffix == ".json" else "text/html")

    @call
    async def release(self, surgeon: str, suture: str, version: int) -> Version:
        """Release a version, or an older one again.

        It is not repeated where the line breaks: somebody may have released another one meanwhile.
        """
        path = at("policies", surgeon, suture, "versions", version, "release")
        return await self._ask(Version, "POST", path, harmless=False)

    @call
    async def withdraw(self, surgeon: str, suture: str) -> None:
        """Withdraw what is released; as `release`, it is not repeated where the line breaks."""
        await self._send("DELETE", at("policies", surgeon, suture, "release"), harmless=False)

    @call
    async def rollout(self, surgeon: str, suture: str, start_mm: Position, version: int | None = None) -> Rollout:
        """Follow a policy from a place."""
        body = {"start_mm": list(start_mm), "version": version}
        return await self._ask(Rollout, "POST", at("policies", surgeon, suture, "rollouts"), body)

    @call
    async def next(self, surgeon: str, suture: str, position_mm: Position, phase: int | None = None) -> NextStep:
        """Ask what the released policy would do at a place; nothing moves."""
        body = {"position_mm": list(position_mm), "phase": phase}
        return await self._ask(NextStep, "POST", at("policies", surgeon, suture, "next"), body)

    async def _verified(self, surgeon: str, suture: str, version: int | None) -> tuple[bytes, bytes, "LearntPolicy"]:
        """Fetch what is said of a policy and its arrays, and put it together."""
        from skills.client.verifying import rebuilt  # the learning core, slow to import

        said = await self._bytes(_path(surgeon, suture, version), JSON)
        about = json.loads(said)
        arrays = await self._bytes(at("policy-versions", about["sha256"]), NPZ)
        demo = await self._json("GET", at("demos", about["demos"][0]))
        return said, arrays, await self._transport.aside(lambda: rebuilt(about, arrays, demo))


def _path(surgeon: str, suture: str, version: int | None) -> str:
    which = () if version is None else ("versions", version)
    return at("policies", surgeon, suture, *which)
