"""Answers that are encoded once and known by the digest of their bytes."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property, lru_cache

import orjson
from fastapi import Response

from skills.api.conditions import names, tag_of
from skills.db.models import PolicyVersion, Release
from skills.errors import PreconditionFailed, UnknownFormat
from skills.library import policies
from skills.library.kept import Kept
from skills.library.verified import learnt
from skills.settings import MEBIBYTE

JSON, NPZ = "application/json", "application/x-npz"
GIVEN_FOR = {NPZ: NPZ, JSON: JSON, "application/*": JSON, "*/*": JSON}
WEIGHT = re.compile(r";\s*q=(0(?:\.\d{0,3})?|1(?:\.0{0,3})?)\s*$")
KEPT_BYTES = 64 * MEBIBYTE  # of answers; a policy's JSON is about 50 kB, with a million actions 3 MB

RawHeaders = list[tuple[bytes, bytes]]


@dataclass(frozen=True)
class Body:
    """Bytes to send, their type, and the digest that names them."""

    content: bytes
    media_type: str
    etag: str

    @cached_property
    def validators(self) -> RawHeaders:
        """Write the headers that a 304 has too."""
        return [(b"etag", self.etag.encode()), (b"vary", b"Accept"), (b"cache-control", b"no-cache")]

    @cached_property
    def headers(self) -> RawHeaders:
        """Write all headers."""
        length = b"content-length", str(len(self.content)).encode()
        return [length, (b"content-type", self.media_type.encode()), *self.validators]


class Ready(Response):
    """A response whose headers were written before."""

    def __init__(self, status_code: int, headers: RawHeaders, content: bytes) -> None:
        self.status_code = status_code
        self.raw_headers = headers.copy()  # what is around the application adds to them
        self.body = content
        self.background = None


def answer(body: Body, if_none_match: str | None, if_match: str | None = None) -> Ready:
    """Send a body, or 304 where the client has exactly these bytes.

    Raises:
        PreconditionFailed: The client wants other bytes than these, or nothing.
    """
    if if_match is not None and not {body.etag, "*"} & {tag.strip() for tag in if_match.split(",")}:
        raise PreconditionFailed("It is not what If-Match names any more; look at it without, then decide again.")
    if if_none_match is not None and (if_none_match == body.etag or names(if_none_match, body.etag)):
        return Ready(304, body.validators, b"")
    return Ready(200, body.headers, body.content)


@lru_cache(256)
def negotiate(accept: str) -> str:
    """Choose between JSON and the arrays: what the client weighs most, and of equals names first.

    Raises:
        UnknownFormat: The client takes neither.
    """
    chosen, most = None, 0.0
    for part in accept.lower().split(","):
        given = GIVEN_FOR.get(part.partition(";")[0].strip())
        weight = WEIGHT.search(part)
        weighs = float(weight[1]) if weight else 1.0
        if given is not None and weighs > most:
            chosen, most = given, weighs
    if chosen is None:
        raise UnknownFormat(f"A policy is given as {JSON} or {NPZ}.")
    return chosen


class Encoded:
    """The answers encoded lately, by what they say; nothing is ever kept under another's name."""

    def __init__(self) -> None:
        self._kept: Kept[tuple[object, ...], Body] = Kept(KEPT_BYTES, lambda body: len(body.content))

    def policy(self, policy: PolicyVersion, release: Release | None, accept: str) -> Body:
        """Encode a policy version and its release, or take what was encoded before."""
        media_type = negotiate(accept)
        # With their moments, for after an erasure a row's number and a version's are given once more.
        released = (release.row, release.released_at) if release else None
        key = (policy.sha256, policy.version, policy.created_at, released, media_type)
        body = self._kept.get(key)
        if body is None:
            body = _encode(policy, release, media_type)
            self._kept.put(key, body)
        return body

    def policies(self) -> set[str]:
        """List the policies of which answers are kept, by digest."""
        return {str(key[0]) for key, _ in self._kept.items()}

    def forget(self, policies: Collection[str]) -> None:
        """Keep no answer about these policies."""
        self._kept.forget([key for key, _ in self._kept.items() if key[0] in policies])


def _encode(policy: PolicyVersion, release: Release | None, media_type: str) -> Body:
    if media_type == NPZ:
        content = policies.arrays_of(policy)
    else:
        about = policies.about_policy(policy, release)
        about["actions"] = policies.actions_of(learnt(policy))
        about["arrays"] = f"/policy-versions/{policy.sha256} with Accept: {NPZ}"
        content = orjson.dumps(about)
    return Body(content, media_type, tag_of(content))
