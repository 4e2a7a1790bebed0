"""Keys, for admins; an installation's first one is made by `skills keys create`."""

from collections.abc import Sequence
from datetime import datetime
from typing import Literal

from skills.api.schemas.given import Key, NewKey, Ready
from skills.client.calls import at, call
from skills.client.connection import Connection, given


class Keys(Connection):
    """The calls."""

    @call
    async def keys(self) -> list[Key]:
        """List all keys, also those that do not count any more."""
        return await self._all(Key, at("keys"))

    @call
    async def make_key(
        self,
        owner: str,
        role: Literal["reader", "uploader", "trainer", "releaser", "admin"] = "reader",
        *,
        expires_at: datetime | None = None,
        surgeons: Sequence[str] | None = None,
    ) -> NewKey:
        """Make a key; its `secret` is never shown again.

        It is not repeated where the line breaks: there would be two.

        Args:
            owner: Whose it is.
            role: Each may do what those before it may.
            expires_at: From when on it counts no more, with its time zone; left out, never.
            surgeons: Whose things alone it may see; left out, everybody's.
        """
        until = None if expires_at is None else expires_at.isoformat()
        body = {"owner": owner, "role": role, "expires_at": until, "surgeons": surgeons}
        return await self._ask(NewKey, "POST", at("keys"), given(body), harmless=False)

    @call
    async def revoke_key(self, key: str) -> Key:
        """Revoke a key, for good; `key` is its id, the eight characters after "skills_"."""
        return await self._ask(Key, "DELETE", at("keys", key))

    @call
    async def ready(self) -> Ready:
        """Ask whether the service can work; one that is starting is waited for, as for all that is busy."""
        return await self._get(Ready, at("readyz"))
