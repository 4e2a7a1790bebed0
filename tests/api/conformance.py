"""Conformance of responses to the OpenAPI document: status, content type, and JSON without undescribed fields."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import httpx2 as httpx
import jsonschema_rs

from skills.api.app import create_app
from skills.settings import Settings
from tests.leftovers import shared

PARAMETER = re.compile(r"\{\w+\}")


@cache
def conformance() -> "Conformance":
    """Return the judge that all tests share: the OpenAPI document is the same for all applications.

    It is made once in a run: that takes a second.
    """

    def make(folder: Path) -> None:
        app = create_app(Settings(database_url=f"sqlite:///{folder}/nothing.sqlite"))
        (folder / "openapi.json").write_text(json.dumps(app.openapi()))

    return Conformance(json.loads((shared("openapi", make) / "openapi.json").read_text()))


class Conformance:
    """The OpenAPI document, and the check of responses against it."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
        self.exact = _exact(self.document)
        self._paths = {
            path: re.compile(PARAMETER.sub("[^/]+", re.escape(path).replace(r"\{", "{").replace(r"\}", "}")))
            for path in sorted(self.document["paths"], key=lambda path: path.count("{"))
        }
        self._validator = cache(self._make_validator)

    def check(self, answer: httpx.Response) -> None:
        """Refuse a response that is not in the document; requests outside of our API are not checked."""
        path = self._path_of(answer.request.url.path)
        method = answer.request.method.lower()
        if path is None or method not in self.document["paths"][path]:
            return
        described = self.document["paths"][path][method]["responses"].get(str(answer.status_code))
        what = f"{method.upper()} {path} {answer.status_code}"
        assert described is not None, f"{what} is not documented: {_start(answer)}"
        missing = [name for name in described.get("headers", {}) if _due(name, answer)]
        assert not missing, f"{what} has no {missing}"
        media_type = answer.headers.get("content-type", "").partition(";")[0]
        kinds = described.get("content", {})
        if not kinds:
            answer.read()
            assert not answer.content, f"{what} should have no body"
            return
        assert media_type in kinds, f"{what} is documented as {[*kinds]}, not {media_type}"
        if "json" in media_type:
            answer.read()
            self.check_json(kinds[media_type]["schema"], answer.json(), what)

    def check_json(self, schema: dict[str, Any], said: Any, what: str) -> None:
        """Refuse JSON that does not conform to a schema of the document."""
        wrong = next(self._validator(json.dumps(schema)).iter_errors(said), None)
        assert wrong is None, f"{what}: {wrong.message[:300]} at {wrong.instance_path}"

    def _make_validator(self, schema: str) -> Any:
        whole = _exact(json.loads(schema)) | {"components": self.exact["components"]}
        return jsonschema_rs.Draft202012Validator(whole, validate_formats=True)

    def _path_of(self, path: str) -> str | None:
        return next((known for known, pattern in self._paths.items() if pattern.fullmatch(path)), None)


def _due(name: str, answer: httpx.Response) -> bool:
    """Return whether a documented header is missing; two of them come with some responses only."""
    return name not in ("Link", "Retry-After") and name not in answer.headers


def _exact(part: Any) -> Any:
    """Forbid every field that is not described."""
    if isinstance(part, list):
        return [_exact(one) for one in part]
    if not isinstance(part, dict):
        return part
    made = {name: _exact(value) for name, value in part.items()}
    if isinstance(made.get("properties"), dict) and made.get("type") == "object":
        made.setdefault("additionalProperties", False)
    return made


def _start(answer: httpx.Response) -> str:
    return answer.text[:200] if answer.is_closed else "a stream"
