"""HTTP responses: content negotiation, JSON with ETags, conditional requests, paging, and requests for jobs.

The ETag of a response is the SHA-256 of its bytes. Negotiation follows RFC 9110, section 12, conditions section 13.
"""

import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, Generic, TypeVar

import orjson
from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session

from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import PreconditionFailed, UnknownFormat
from skills.formats import BYTES
from skills.jobs import Engine
from skills.library.operation.jobs import RequestedJob
from skills.library.policies.outcomes import describe_job

JSON, HTML = "application/json", "text/html"
WEIGHT = re.compile(r";\s*q=(0(?:\.\d{0,3})?|1(?:\.0{0,3})?)\s*$")
Condition = Annotated[str | None, Header(max_length=2000)]
T = TypeVar("T")


@lru_cache(256)  # the same few headers come with every request, and a policy is served in microseconds
def negotiate(accept: str, resource: str, *offered: str) -> str:
    """Return the media type with the highest weight, and of equal weights the first that the client names.

    Args:
        accept: The header of this name.
        resource: The resource, as the subject of the error's sentence.
        offered: Its media types; a range such as `*/*` or `text/*` stands for the first of them in it.

    Raises:
        UnknownFormat: The client accepts none of them.
    """
    named = {"*/*": offered[0]}
    for kind in reversed(offered):
        named |= {f"{kind.partition('/')[0]}/*": kind, kind: kind}
    chosen, most = None, 0.0
    for part in accept.lower().split(","):
        kind_of_part, weight = named.get(part.partition(";")[0].strip()), WEIGHT.search(part)
        weighs = float(weight[1]) if weight else 1.0
        if kind_of_part is not None and weighs > most:
            chosen, most = kind_of_part, weighs
    if chosen is None:
        listed = f"{', '.join(offered[:-1])} or {offered[-1]}"
        raise UnknownFormat(f"{resource} is available as {listed}; name one of them in Accept.")
    return chosen


def tag_of(content: bytes) -> str:
    """Return the ETag of some bytes: their SHA-256 in quotes."""
    return f'"{hashlib.sha256(content).hexdigest()}"'


def json_of(said: Any, *, indented: bool = False) -> bytes:
    """Encode plain values, dataclasses and models of `skills.schemas` as JSON; timestamps end in Z, NaN is null."""
    indent = orjson.OPT_INDENT_2 if indented else 0
    return orjson.dumps(said, default=_fields, option=orjson.OPT_UTC_Z | indent)


def _fields(said: Any) -> dict[str, object]:
    if isinstance(said, BaseModel):
        return said.model_dump(mode="json", warnings=False)  # lists of arrays stand in place of tuples
    raise TypeError(f"{type(said)} is no JSON")


def names(header: str, tag: str) -> bool:
    """Return whether a list of ETags, or `*`, contains a tag; weak tags match, since a proxy may weaken ours."""
    return any(one.strip().removeprefix("W/") in (tag, "*") for one in header.split(","))


RawHeaders = list[tuple[bytes, bytes]]


@dataclass(frozen=True)
class Body:
    """A response body with its media type and ETag, and a link to what belongs to it (RFC 8288)."""

    content: bytes
    media_type: str
    etag: str
    link: str | None = None

    @cached_property
    def validators(self) -> RawHeaders:
        """Return the headers that a 304 has as well."""
        link = [] if self.link is None else [(b"link", self.link.encode())]
        return [(b"etag", self.etag.encode()), (b"vary", b"Accept"), (b"cache-control", b"no-cache"), *link]

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


class Give:
    """Builder of the response to a GET: 304 if the client has exactly these bytes already."""

    def __init__(self, request: Request, have: str | None) -> None:
        self.request = request
        self._have = have

    def is_known(self, tag: str) -> bool:
        """Return whether the client has the bytes with this ETag already."""
        return self._have is not None and names(self._have, tag)

    def __call__(self, said: Any) -> Response:
        """Return one resource as JSON."""
        return self.bytes(json_of(said), JSON)

    def bytes(self, content: bytes, media_type: str) -> Response:
        """Return bytes with their media type."""
        tag = tag_of(content)
        headers = {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}
        if self.is_known(tag):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type=media_type)

    def page(self, items: Sequence[Any], following: int | str | None, **more: Any) -> Response:
        """Return one page of a list, with the cursor of the next page in `next` and in a `Link` header (RFC 8288)."""
        answer = self({**more, "items": items, "next": following})
        if following is not None:
            query = self.request.url.include_query_params(cursor=following).query
            # a relative URL, because a proxy may serve this path under a prefix
            answer.headers["Link"] = f'<?{query}>; rel="next"'
        return answer


async def _give(request: Request, if_none_match: Condition = None) -> Give:
    return Give(request, if_none_match)


Giving = Annotated[Give, Depends(_give)]


@dataclass(frozen=True)
class Listing(Generic[T]):
    """The page of a list that a client asks for: the most items on it, and the cursor at which it begins."""

    give: Give
    limit: int
    cursor: T | None

    def page(self, items: Sequence[Any], rows: Sequence[Any], by: str = "row", **more: Any) -> Response:
        """Return the page of some items; the attribute `by` of the last of their rows is the cursor of the next page.

        A full page has a cursor even if no item follows it.
        """
        return self.give.page(items, getattr(rows[-1], by) if len(rows) == self.limit else None, **more)


@dataclass(frozen=True)
class Conditions:
    """The conditions of a request on the ETag of its resource.

    Attributes:
        if_match: Header of which one ETag must match; None: without.
        if_none_match: Header of which no ETag may match; `*` means that the resource must not exist.
    """

    if_match: str | None = None
    if_none_match: str | None = None

    def answer(self, body: Body) -> EncodedResponse:
        """Return a response with a body, or 304 if the client has exactly these bytes.

        Raises:
            PreconditionFailed: If-Match names other bytes than these.
        """
        has = self.if_none_match
        if self.if_match is not None and not {body.etag, "*"} & {tag.strip() for tag in self.if_match.split(",")}:
            raise PreconditionFailed("The object no longer has the ETag in If-Match; request it without If-Match.")
        if has is not None and (has == body.etag or names(has, body.etag)):  # most name one ETag
            return EncodedResponse(304, body.validators, b"")
        return EncodedResponse(200, body.headers, body.content)

    def refuse_changed(self, said: Any) -> None:
        """Check the conditions of a change; an empty header is no condition.

        Args:
            said: The current JSON of the resource, as a GET returns it; None if it does not exist.

        Raises:
            PreconditionFailed: A condition does not hold.
        """
        tag = None if said is None else tag_of(json_of(said))
        if self.if_match and (tag is None or not names(self.if_match, tag)):
            raise PreconditionFailed(
                "The object no longer has the ETag in If-Match; read it again, then repeat the request."
            )
        if self.if_none_match and tag is not None and names(self.if_none_match, tag):
            raise PreconditionFailed(
                "An object that matches If-None-Match exists already; read it, then repeat the request."
            )


async def _conditions(if_match: Condition = None, if_none_match: Condition = None) -> Conditions:
    return Conditions(if_match, if_none_match)


async def _if_match(if_match: Condition = None) -> Conditions:
    return Conditions(if_match)


Conditional = Annotated[Conditions, Depends(_conditions)]
IfMatch = Annotated[Conditions, Depends(_if_match)]


def as_asked(accept: str, kind: str) -> str:
    """Return the media type of a file: its own, unless `Accept` names plain bytes first."""
    return BYTES if accept.partition(";")[0].strip().lower() == BYTES else kind


def stored(said: Any, new: bool, location: str | None = None) -> Response:
    """Return the response to a PUT or POST that stores a resource: 201 if it is new, else 200."""
    headers = {} if location is None else {"Location": location}
    return say(said, 201 if new else 200, headers)


def accepted(session: Session, job: Job, did: str) -> Response:
    """Return the response to a request for a job: 200 once it succeeded, else 202; `did` is the request's effect."""
    said = describe_job(session, job, did)
    return say(said, 200 if job.state == "succeeded" else 202, {"Location": f"/jobs/{job.id}"})


def start_job(
    db: Database, engine: Engine, names: Iterable[str] | None, request: Callable[[Session], RequestedJob]
) -> Response:
    """Request a job in a transaction that locks some names, or all, and return the response to it."""
    with db.writing(names) as session:
        job, _, did = request(session)
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if job.state == "queued":
        engine.submit(job.row, job.attempt, job.kind)
    return answer


def say(said: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """Return a response with JSON."""
    return Response(json_of(said), status, headers=headers, media_type=JSON)
