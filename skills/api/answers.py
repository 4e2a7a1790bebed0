"""Answers that are encoded once and known by the digest of their bytes."""

import hashlib
from dataclasses import dataclass

import orjson
from fastapi import Response

from skills.db.models import PolicyVersion, Release
from skills.errors import UnknownFormat
from skills.library import policies
from skills.library.kept import Kept
from skills.library.verified import learnt

JSON, NPZ = "application/json", "application/x-npz"
KEPT = 256  # answers; a policy's JSON is about 100 KB


@dataclass(frozen=True)
class Body:
    """Bytes to send, their type, and the digest that names them."""

    content: bytes
    media_type: str
    etag: str


def answer(body: Body, if_none_match: str | None) -> Response:
    """Send a body, or 304 where the client has exactly these bytes."""
    headers = {"ETag": body.etag, "Vary": "Accept", "Cache-Control": "no-cache"}
    if if_none_match is not None and body.etag in (tag.strip() for tag in if_none_match.split(",")):
        return Response(status_code=304, headers=headers)
    return Response(body.content, headers=headers, media_type=body.media_type)


def negotiate(accept: str) -> str:
    """Choose between JSON and the arrays.

    Raises:
        UnknownFormat: The client takes neither.
    """
    wanted = [part.partition(";")[0].strip().lower() for part in accept.split(",")]
    for one in wanted:
        if one == NPZ:
            return NPZ
        if one in (JSON, "application/*", "*/*"):
            return JSON
    raise UnknownFormat(f"A policy is given as {JSON} or {NPZ}.")


class Encoded:
    """The answers encoded lately, by the digest of what they say; nothing is ever kept under another's name."""

    def __init__(self) -> None:
        self._kept: Kept[tuple[str, int | None, str], Body] = Kept(KEPT)

    def policy(self, policy: PolicyVersion, release: Release | None, accept: str) -> Body:
        """Encode a policy version and its release, or take what was encoded before."""
        media_type = negotiate(accept)
        key = (policy.sha256, release.row if release else None, media_type)
        body = self._kept.get(key)
        if body is None:
            body = _encode(policy, release, media_type)
            self._kept.put(key, body)
        return body


def _encode(policy: PolicyVersion, release: Release | None, media_type: str) -> Body:
    if media_type == NPZ:
        content = policies.arrays_of(policy)
    else:
        about = policies.about_policy(policy, release)
        about["actions"] = policies.actions_of(learnt(policy))
        about["arrays"] = f"/policy-versions/{policy.sha256} with Accept: {NPZ}"
        content = orjson.dumps(about)
    return Body(content, media_type, f'"{hashlib.sha256(content).hexdigest()}"')
