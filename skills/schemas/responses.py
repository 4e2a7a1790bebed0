"""Responses of the service itself: errors, liveness and readiness, the history, and its proofs."""

from datetime import datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field

from skills.fields import Count, Sha256, Slug
from skills.schemas import Given


class WrongField(Given):
    """One field of a request that is refused."""

    where: str
    why: str


class Problem(Given):
    """An error response, after RFC 9457; some kinds have additional fields.

    Attributes:
        type: The kind, which never changes.
        detail: What is wrong, and what to do next.
        reason: What is wrong, alone.
        remedies: What to do next as data: sentences, and actions with their values.
        errors: The fields of the request that are refused.
        numbers: The numbers of the sentence, to compute with.
        case: Of a mistake of ours: report it.
    """

    # Unlike other responses: some kinds of errors have fields of their own, which a client must see.
    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int = Field(ge=400, le=599)
    detail: str
    reason: str | None = None
    remedies: list[str | dict[str, str | int]] | None = None
    errors: list[WrongField] | None = None
    numbers: dict[str, Any] | None = None
    case: str | None = None


class Alive(Given):
    """The liveness of the process."""

    status: Literal["ok"]
    use: str


class SignedCheckpoint(Given):
    """The newest head of the history, signed.

    Attributes:
        note: A C2SP signed note of a tlog-checkpoint: origin, size, root, signatures.
        verifier: The public key of the note: its name, number and Ed25519 key.
    """

    note: str
    verifier: str


class LeafProof(Given):
    """The proof that a row was logged as it is disclosed.

    SHA-256 of salt, name, a zero byte and the disclosed text of a column begins with the digest of that name. SHA-256
    of the digests in canonical JSON is the commitment in the entry. The entry is the leaf `number` of the tree.

    Attributes:
        entry: JSON; the leaf's hash is SHA-256 of a zero byte and this text.
        salt: 32 bytes in hex.
        disclosed: Columns as they are digested: `json` and the value, and so on.
        digests: Of all logged columns, 16 bytes each in hex.
        hashes: Hashes beside the path from the leaf to the root (RFC 6962), in hex.
    """

    table: str
    number: Count
    entry: str
    salt: str
    disclosed: dict[str, str]
    digests: dict[str, str]
    hashes: list[str]


class ServedAt(Given):
    """The version of a style that was served at a time, with proofs of its release and of its digest."""

    surgeon: Slug
    suture: Slug
    at: datetime
    policy: Sha256
    released_at: datetime
    withdrawn_at: datetime | None
    proofs: list[LeafProof]
    checkpoint: SignedCheckpoint


class Ready(Given):
    """The readiness of the installation for work.

    Attributes:
        containment: Layers that contain readers, simulators and learners, and whether each holds.
    """

    status: Literal["ready"]
    workers: Count
    containment: dict[str, bool] = Field(default_factory=dict)
