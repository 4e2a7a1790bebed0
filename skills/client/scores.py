"""Scores of demonstrations, and of parts of recordings, against a style."""

from skills.api.schemas.given import Score
from skills.client.calls import at, call
from skills.client.connection import Connection, given


class Scores(Connection):
    """The calls."""

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
            surgeon: Whose style it is scored against.
            suture: The suture type.
            demo: The digest of a demonstration; or else
            recording: that of a recording, of which
            arm: this arm's motion,
            topic: on this topic,
            start_s: from here
            end_s: to here is scored.
            reference: The demonstration of the style to compare with; left out, its released policy's, else its newest.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "demo": demo, "recording": recording, "reference": reference},
            **{"arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
        }
        return await self._ask(Score, "POST", at("scores"), given(body))
