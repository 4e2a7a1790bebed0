"""Calls of atlases, recognition and scores."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from skills import schemas
from skills.client.connection import Connection
from skills.keywords import ScoreKeywords

if TYPE_CHECKING:
    from skills.schemas.comparison import Atlas, Nearest, RecognisedRecording
    from skills.schemas.scores import Progress, Score


class Comparisons(Connection):
    """Calls that compare demonstrations and surgeons."""

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
        return await self._get(
            schemas.comparison.Atlas,
            "/styles/{suture}/atlas",
            suture=suture,
            scaled=scaled,
            clusters=clusters,
            demo=demo,
        )

    async def nearest(self, demo: str, *, count: int = 10, scaled: bool = False) -> Nearest:
        """Return the demonstrations of the same suture type that are nearest to one, among all of them and exactly.

        Args:
            demo: Digest of the demonstration.
            count: Number of neighbours, at most 100.
            scaled: Normalise size too; distances are then in units of the distance from start to goal.
        """
        return await self._get(
            schemas.comparison.Nearest, "/demos/{demo}/nearest", demo=demo, count=count, scaled=scaled
        )

    async def recognise(self, recording: str, suture: str) -> RecognisedRecording:
        """Recognise the surgeon of a whole recording by all its movements, with its session left out.

        Args:
            recording: Digest of a recording that has a demonstration of the suture type.
            suture: The suture type.
        """
        path = "/styles/{suture}/recognition"
        return await self._get(schemas.comparison.RecognisedRecording, path, suture=suture, recording=recording)

    async def score(self, surgeon: str, suture: str, **options: Unpack[ScoreKeywords]) -> Score:
        """Score a demonstration, or a part of a recording, against a style; nothing is stored. Not a credential.

        Args:
            surgeon: The surgeon whose style is the reference.
            suture: The suture type.
            **options: Either `demo`, or `recording` and the part of it; the reference, and the task of the rating.
        """
        return await self._ask(
            schemas.scores.Score, "POST", "/scores", {"surgeon": surgeon, "suture": suture, **options}
        )

    async def progress(self, surgeon: str, suture: str, *, against: str) -> Progress:
        """Compare a surgeon's demonstrations with a style's reference, session by session. Not a credential.

        Args:
            surgeon: The surgeon whose demonstrations are compared.
            suture: The suture type.
            against: The surgeon whose style is the reference.
        """
        path = "/surgeons/{surgeon}/progress"
        return await self._get(schemas.scores.Progress, path, surgeon=surgeon, suture=suture, against=against)
