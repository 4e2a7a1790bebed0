"""Keys, as an admin sees them."""

from datetime import datetime
from typing import Literal

from pydantic import Field

from skills.api.schemas.shapes import Given, Slug


class Key(Given):
    """A key: whose it is and what it may do; its secret is stored nowhere."""

    key: str = Field(pattern=r"^[0-9a-f]{8}$", description="Its id, the part after `skills_`, which is no secret.")
    owner: str = Field(description="Whose it is; events and releases bear this name.")
    role: Literal["reader", "uploader", "trainer", "releaser", "admin"]
    surgeons: list[Slug] | None = Field(description="The surgeons that it is restricted to; null: all.")
    created_at: datetime
    created_by: str
    expires_at: datetime | None
    revoked_at: datetime | None
    state: Literal["active", "expired", "revoked"]


class NewKey(Key):
    """A key that was just made."""

    secret: str = Field(description="What to show as `X-API-Key`; nobody can show it again.")
