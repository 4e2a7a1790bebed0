"""HTTP responses: JSON with ETags, conditional requests, content negotiation and paging.

The ETag of a response is the SHA-256 of its bytes. Conditions follow RFC 9110, section 13. Responses with a policy are
encoded once and cached under the digest of the policy and the identity of its release.
"""

import hashlib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any

import orjson
from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion, Release
from skills.db.service_tables import Job
from skills.errors import PreconditionFailed, UnknownFormat
from skills.formats import BYTES
from skills.library import policies
from skills.library.cache import Kept
from skills.library.integrity import learnt
from skills.library.jobs import job_json
from skills.library.releases import outcomes_of
from skills.settings import MEBIBYTE

Condition = Annotated[str | None, Header(max_length=2000)]


def tag_of(content: bytes) -> str:
    """Return the ETag of some bytes: their SHA-256 in quotes."""
    return f'"{hashlib.sha256(content).hexdigest()}"'


def json_of(said: Any, *, indented: bool = False) -> bytes:
    """Encode plain values, dataclasses and models of `skills.schemas` as JSON; timestamps end in Z, NaN is null."""
    indent = orjson.OPT_INDENT_2 if indented else 0
    return orjson.dumps(said, default=_fields, option=orjson.OPT_UTC_Z | indent)


def _fields(said: Any) -> dict[str, Any]:
    if isinstance(said, BaseModel):
        return said.model_dump()
    raise TypeError(f"{type(said)} is no JSON")


def names(header: str, tag: str) -> bool:
    """Return whether a list of ETags, or `*`, contains a tag; weak tags match, since a proxy may weaken ours."""
    return any(one.strip().removeprefix("W/") in (tag, "*") for one in header.split(","))


def refuse_changed(said: Any, if_match: str | None, if_none_match: str | None = None) -> None:
    """Check the conditions of a request that changes a resource.

    Args:
        said: The current JSON of the resource, as a GET returns it; None if it does not exist.
        if_match: Header of which one ETag must match.
        if_none_match: Header of which no ETag may match; `*` means that the resource must not exist.

    Raises:
        PreconditionFailed: A condition does not hold.
    """
    tag = None if said is None else tag_of(json_of(said))
    if if_match is not None and (tag is None or not names(if_match, tag)):
        raise PreconditionFailed(
            "The object no longer has the ETag in If-Match; read it again, then repeat the request."
        )
    if if_none_match is not None and tag is not None and names(if_none_match, tag):
        raise PreconditionFailed(
            "An object that matches If-None-Match exists already; read it, then repeat the request."
        )


JSON, NPZ = "application/json", "application/x-npz"
GIVEN_FOR = {NPZ: NPZ, JSON: JSON, "application/*": JSON, "*/*": JSON}
WEIGHT = re.compile(r";\s*q=(0(?:\.\d{0,3})?|1(?:\.0{0,3})?)\s*$")
KEPT_BYTES = 64 * MEBIBYTE  # capacity of the cache; a policy's JSON is about 50 kB, with a million actions 3 MB

RawHeaders = list[tuple[bytes, bytes]]


@dataclass(frozen=True)
class Body:
    """A response body with its media type and ETag."""

    content: bytes
    media_type: str
    etag: str

    @cached_property
    def validators(self) -> RawHeaders:
        """Return the headers that a 304 has as well."""
        return [(b"etag", self.etag.encode()), (b"vary", b"Accept"), (b"cache-control", b"no-cache")]

    @cached_property
    def headers(self) -> RawHeaders:
        """Return all headers."""
        length = b"content-length", str(len(self.content)).encode()
        return [length, (b"content-type", self.media_type.encode()), *self.validators]


class EncodedResponse(Response):
    """A response with headers that were encoded before, which saves Starlette's work for each response."""

    def __init__(self, status_code: int, headers: RawHeaders, content: bytes) -> None:
        self.status_code = status_code
        self.raw_headers = headers.copy()  # middleware adds further headers to this list
        self.body = content
        self.background = None


def answer(body: Body, if_none_match: str | None, if_match: str | None = None) -> EncodedResponse:
    """Return a response with a body, or 304 if the client has exactly these bytes.

    Raises:
        PreconditionFailed: If-Match names other bytes than these.
    """
    if if_match is not None and not {body.etag, "*"} & {tag.strip() for tag in if_match.split(",")}:
        raise PreconditionFailed("The object no longer has the ETag in If-Match; request it without If-Match.")
    if if_none_match is not None and (if_none_match == body.etag or names(if_none_match, body.etag)):
        return EncodedResponse(304, body.validators, b"")
    return EncodedResponse(200, body.headers, body.content)


@lru_cache(256)
def negotiate(accept: str) -> str:
    """Choose between JSON and arrays: the media type with the highest weight, and of equal weights the first.

    Raises:
        UnknownFormat: The client accepts neither.
    """
    chosen, most = None, 0.0
    for part in accept.lower().split(","):
        given = GIVEN_FOR.get(part.partition(";")[0].strip())
        weight = WEIGHT.search(part)
        weighs = float(weight[1]) if weight else 1.0
        if given is not None and weighs > most:
            chosen, most = given, weighs
    if chosen is None:
        raise UnknownFormat(f"A policy is available as {JSON} or {NPZ}; name one of them in Accept.")
    return chosen


class Encoded:
    """LRU cache of encoded policy responses, keyed by everything that their content depends on."""

    def __init__(self) -> None:
        self._kept: Kept[tuple[object, ...], Body] = Kept(KEPT_BYTES, lambda body: len(body.content))

    def policy(self, policy: PolicyVersion, release: Release | None, accept: str) -> Body:
        """Return the encoded response of a policy version and its release, from the cache if it is there."""
        media_type = negotiate(accept)
        # With their times, because row and version numbers are used again after an erasure.
        released = (release.row, release.released_at) if release else None
        key = (policy.sha256, policy.version, policy.created_at, released, media_type)
        body = self._kept.get(key)
        if body is None:
            body = _encode(policy, release, media_type)
            self._kept.put(key, body)
        return body

    def policies(self) -> set[str]:
        """Return the digests of the policies with cached responses."""
        return {str(key[0]) for key, _ in self._kept.items()}

    def forget(self, policies: Collection[str]) -> None:
        """Remove the cached responses of these policies."""
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


class Give:
    """Builder of the response to a GET: 304 if the client has exactly these bytes already."""

    def __init__(self, request: Request, have: str | None) -> None:
        self._request = request
        self._have = have

    def __call__(self, said: Any) -> Response:
        """Return one resource as JSON."""
        return self.bytes(json_of(said), JSON)

    def bytes(self, content: bytes, media_type: str) -> Response:
        """Return bytes with their media type."""
        tag = tag_of(content)
        headers = {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}
        if self._have is not None and names(self._have, tag):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type=media_type)

    def page(self, items: Sequence[Any], limit: int, cursor: Any, **more: Any) -> Response:
        """Return one page of a list, with the cursor of the next page in `next` and in a `Link` header (RFC 8288).

        A full page has a cursor even if no item follows it.
        """
        following = cursor if len(items) == limit else None
        answer = self({**more, "items": items, "next": following})
        if following is not None:
            query = self._request.url.include_query_params(cursor=following).query
            # a relative URL, because a proxy may serve this path under a prefix
            answer.headers["Link"] = f'<?{query}>; rel="next"'
        return answer


async def _give(request: Request, if_none_match: Condition = None) -> Give:
    return Give(request, if_none_match)


Giving = Annotated[Give, Depends(_give)]


def as_asked(accept: str, kind: str) -> str:
    """Return the media type of a file: its own, unless `Accept` names plain bytes first."""
    return BYTES if accept.partition(";")[0].strip().lower() == BYTES else kind


def stored(said: Any, new: bool, location: str | None = None) -> Response:
    """Return the response to a PUT or POST that stores a resource: 201 if it is new, else 200."""
    headers = {} if location is None else {"Location": location}
    return say(said, 201 if new else 200, headers)


def accepted(session: Session, job: Job, did: str) -> Response:
    """Return the response to a request for a job: 200 once it succeeded, else 202; `did` is the request's effect."""
    said = job_json(job, outcomes_of(session, [job])[job.row], did)
    return say(said, 200 if job.state == "succeeded" else 202, {"Location": f"/jobs/{job.id}"})


def say(said: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """Return a response with JSON."""
    return Response(json_of(said), status, headers=headers, media_type=JSON)
