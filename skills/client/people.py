"""Calls of surgeons and of suture types."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from skills import schemas
from skills.client.connection import Connection
from skills.keywords import SurgeonKeywords, SutureTypeKeywords
from skills.schemas import SkillLevel

if TYPE_CHECKING:
    from skills.schemas.people import Surgeon, SutureType


class People(Connection):
    """Calls of surgeons and suture types."""

    async def put_surgeon(self, surgeon: str, **about: Unpack[SurgeonKeywords]) -> Surgeon:
        """Create or replace a surgeon under a pseudonym; fields that are left out are cleared."""
        return await self._ask(schemas.people.Surgeon, "PUT", "/surgeons/{surgeon}", about, surgeon=surgeon)

    async def surgeon(self, surgeon: str) -> Surgeon:
        """Return a surgeon."""
        return await self._get(schemas.people.Surgeon, "/surgeons/{surgeon}", surgeon=surgeon)

    async def surgeons(self, search: str | None = None, skill_level: SkillLevel | None = None) -> list[Surgeon]:
        """List the surgeons: all, or those whose pseudonym contains `search`."""
        return await self._all(schemas.people.Surgeon, "/surgeons", search=search, skill_level=skill_level)

    async def erase_surgeon(self, surgeon: str) -> None:
        """Erase a surgeon and everything derived from their data, permanently."""
        await self._request("DELETE", "/surgeons/{surgeon}", {"surgeon": surgeon})

    async def put_suture_type(self, suture: str, **about: Unpack[SutureTypeKeywords]) -> SutureType:
        """Create or replace a suture type; fields that are left out are cleared."""
        return await self._ask(schemas.people.SutureType, "PUT", "/suture-types/{suture}", about, suture=suture)

    async def suture_type(self, suture: str) -> SutureType:
        """Return a suture type."""
        return await self._get(schemas.people.SutureType, "/suture-types/{suture}", suture=suture)

    async def suture_types(self, search: str | None = None) -> list[SutureType]:
        """List the suture types: all, or those whose slug, name or family contains `search`."""
        return await self._all(schemas.people.SutureType, "/suture-types", search=search)
