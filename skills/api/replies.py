"""Answers in JSON, as bytes of which the ETag is the digest."""

from collections.abc import Sequence
from typing import Annotated, Any

import orjson
from fastapi import Depends, Request, Response

from skills.api.answers import JSON
from skills.api.conditions import Condition, names, tag_of
from skills.api.schemas.written import job_out
from skills.db.books import Job


class Give:
    """What a GET answers with: 304 where the client has exactly these bytes already."""

    def __init__(self, request: Request, have: str | None) -> None:
        self._request = request
        self._have = have

    def __call__(self, said: Any) -> Response:
        """Give one thing."""
        return self.bytes(orjson.dumps(said), JSON)

    def bytes(self, content: bytes, media_type: str) -> Response:
        """Give bytes as they are."""
        tag = tag_of(content)
        headers = {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}
        if self._have is not None and names(self._have, tag):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type=media_type)

    def page(self, items: Sequence[Any], limit: int, cursor: Any, **more: Any) -> Response:
        """Give one page of a list, and where the next one starts, if there may be one (a `Link` of RFC 8288 too)."""
        following = cursor if len(items) == limit else None
        answer = self({**more, "items": items, "next": following})
        if following is not None:
            query = self._request.url.include_query_params(cursor=following).query
            answer.headers["Link"] = f'<?{query}>; rel="next"'  # a proxy may have put this path elsewhere
        return answer


async def _give(request: Request, if_none_match: Condition = None) -> Give:
    return Give(request, if_none_match)


Giving = Annotated[Give, Depends(_give)]


def stored(said: Any, new: bool, location: str | None = None) -> Response:
    """Answer a PUT or POST with the thing: 201 where it is new, else 200."""
    headers = {} if location is None else {"Location": location}
    return say(said, 201 if new else 200, headers)


def accepted(job: Job) -> Response:
    """Answer with a job: 202 while it is to be done, 200 once it is."""
    return say(job_out(job), 200 if job.state == "succeeded" else 202, {"Location": f"/jobs/{job.id}"})


def say(said: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """Answer with a model's JSON."""
    return Response(orjson.dumps(said), status, headers=headers, media_type=JSON)
