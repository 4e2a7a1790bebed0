"""Surgeons and suture types."""

from collections.abc import Mapping
from typing import Any, Literal

from skills.api.schemas.given import Surgeon, SutureType
from skills.client.calls import at, call
from skills.client.connection import Connection

SkillLevel = Literal["novice", "intermediate", "expert"]


class Catalogue(Connection):
    """The calls."""

    @call
    async def put_surgeon(
        self,
        surgeon: str,
        *,
        skill_level: SkillLevel | None = None,
        handedness: Literal["right", "left", "ambidextrous"] | None = None,
        protocol: str | None = None,
        consent: Mapping[str, Any] | None = None,
    ) -> Surgeon:
        """Write a surgeon whole, under a pseudonym; `consent` has `uses` and `until`."""
        about = {"skill_level": skill_level, "handedness": handedness, "protocol": protocol, "consent": consent}
        return await self._ask(Surgeon, "PUT", at("surgeons", surgeon), about)

    @call
    async def surgeon(self, surgeon: str) -> Surgeon:
        """Look a surgeon up."""
        return await self._get(Surgeon, at("surgeons", surgeon))

    @call
    async def surgeons(self, search: str | None = None, skill_level: SkillLevel | None = None) -> list[Surgeon]:
        """List the surgeons, all or those in whose pseudonym `search` is."""
        return await self._all(Surgeon, at("surgeons"), search=search, skill_level=skill_level)

    @call
    async def erase_surgeon(self, surgeon: str) -> None:
        """Erase a surgeon and all that was derived from them, for good."""
        await self._send("DELETE", at("surgeons", surgeon))

    @call
    async def put_suture_type(
        self, suture: str, *, name: str, family: str, also_called: list[str] | None = None, description: str = ""
    ) -> SutureType:
        """Write a suture type whole."""
        about = {"name": name, "family": family, "also_called": also_called or [], "description": description}
        return await self._ask(SutureType, "PUT", at("suture-types", suture), about)

    @call
    async def suture_type(self, suture: str) -> SutureType:
        """Look a suture type up."""
        return await self._get(SutureType, at("suture-types", suture))

    @call
    async def suture_types(self, search: str | None = None) -> list[SutureType]:
        """List the catalogue of suture types, all or those in whose slug, name or family `search` is."""
        return await self._all(SutureType, at("suture-types"), search=search)
