"""Atlases: the demonstrations of a suture type, compared."""

from skills.api.schemas.given import Atlas
from skills.client.calls import at, call
from skills.client.connection import Connection


class Atlases(Connection):
    """The calls."""

    @call
    async def atlas(
        self, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
    ) -> Atlas:
        """Get the atlas of a suture type.

        Args:
            suture: The suture type.
            scaled: Whether size is taken out too; distances are then in lengths of start to goal.
            clusters: How many; left out, as many as are found.
            demo: The digest of a demonstration in it, to be told whose style it is.
        """
        return await self._get(Atlas, at("styles", suture, "atlas"), scaled=scaled, clusters=clusters, demo=demo)
