"""Types of fields that cross HTTP, and `schema`, which makes a value's dataclass the schema of its JSON.

A value of the domain that is part of a response is declared once, as a dataclass: pydantic reads its fields, and the
OpenAPI document takes its descriptions from the docstring. Lengths are mm; a position's frame is in a field of its own.
"""

import re
from base64 import b64decode, b64encode
from functools import cache
from inspect import cleandoc
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    WithJsonSchema,
)
from pydantic import computed_field as computed_field  # a property that is part of the JSON
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

Slug = Annotated[str, Field(description="Lower-case letters, digits, - and _.")]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="SHA-256, in hex.")]
Point = tuple[float, float, float]
Quaternion = Annotated[tuple[float, float, float, float], Field(description="x, y, z, w; of length 1.")]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
# A number for each joint of an arm.
Six = Annotated[tuple[float, ...], Field(min_length=6, max_length=6)]
# NaN where it could not be measured, which is null in JSON.
Figure = float | None


def percent(share: float, digits: int = 0) -> str:
    """Return a share as a number of percent: less than all is never rounded to 100, nor more than nothing to 0."""
    text, least = f"{100 * share:.{digits}f}", 10**-digits
    if share < 1 and float(text) >= 100:
        return f"> {100 - least:.{digits}f}"
    if share > 0 and float(text) <= 0:
        return f"< {least:.{digits}f}"
    return text


if TYPE_CHECKING:
    from numpy import float32
    from numpy.typing import NDArray

    Numbers = NDArray[float32]
else:
    Numbers = Any  # numpy is imported at the first use: few answers have columns


def _column(given: Any) -> Numbers:
    import numpy as np

    if isinstance(given, str):
        return np.frombuffer(b64decode(given, validate=True), "<f4").astype(np.float32)
    return np.asarray(given, np.float32)


# Many numbers in one field of JSON, a sixth of the bytes and of the time of a list of them. NaN where there is none.
Column = Annotated[
    Numbers,
    PlainValidator(_column),
    PlainSerializer(lambda column: b64encode(column.astype("<f4").tobytes()).decode()),
    WithJsonSchema({"type": "string", "contentEncoding": "base64", "contentMediaType": "application/octet-stream"}),
]

T = TypeVar("T")
_ATTRIBUTE = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)


def schema(cls: type[T]) -> type[T]:
    """Make a dataclass the schema of its JSON: every field is required, and described as in the docstring."""
    cls.__pydantic_config__ = ConfigDict(  # type: ignore[attr-defined]
        json_schema_serialization_defaults_required=True,
        json_schema_extra=lambda json: _describe(json, cls),
    )
    return cls


def exact(cls: type[T]) -> type[T]:
    """Refuse JSON of a schema with names that are no fields: a mistyped one must not leave a default in force."""
    cls.__pydantic_config__["extra"] = "forbid"  # type: ignore[attr-defined]
    return cls


def _describe(json: dict[str, Any], cls: type) -> None:
    """Add the docstring's text, and the sections Attributes of the class and its bases, to a JSON schema."""
    for field in json["properties"].values():
        field.pop("default", None)  # of a constructor's argument, not of the JSON
        field.pop("readOnly", None)  # of a property: no request has these classes
    for base in reversed(cls.__mro__):  # from the most general on, so that a subclass may describe a field anew
        json["description"], attributes = documented(base)
        for name, description in attributes.items():
            if name in json["properties"]:
                json["properties"][name]["description"] = description


def documented(cls: type) -> tuple[str, dict[str, str]]:
    """Return the text of a class's docstring, and the descriptions in its section Attributes."""
    text, _, attributes = cleandoc(cls.__doc__ or "").partition("\nAttributes:\n")
    found = {name: " ".join(description.split()) for name, description in _ATTRIBUTE.findall(attributes)}
    return text.strip(), {name: re.sub(r"\bNone\b", "null", description) for name, description in found.items()}


class Documented(BaseModel):
    """A model whose fields are described in the section Attributes of its docstring, as those of a `schema` are."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Give each field the description that the docstring has for it, before pydantic reads the annotations."""
        super().__init_subclass__(**options)
        own = cls.__annotations__
        for name, description in documented(cls)[1].items():
            if name in own:
                own[name] = Annotated[own[name], Field(description=description)]

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema, described by the text of the docstring alone."""
        json = handler(core_schema)
        if (text := documented(cls)[0]) and "$ref" not in json:
            json["description"] = text
        return json


_adapter = cache(TypeAdapter[Any])  # built once for each class


def as_json(value: Any) -> Any:
    """Return a schema's value as plain JSON: tuples as lists, with the properties that are part of its JSON."""
    # Not in pydantic's mode "json", which would write a sum of nothing, 0, as 0.0: the numbers stay as they are.
    return _with_lists(_adapter(value.__class__).dump_python(value))


def _with_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _with_lists(part) for name, part in value.items()}
    return [_with_lists(part) for part in value] if isinstance(value, tuple | list) else value


def parse_json(cls: type[T], json: Any) -> T:
    """Return a value of a schema, or of another dataclass, from its plain JSON.

    Raises:
        ValueError: It is not the JSON of such a value.
    """
    parsed: T = _adapter(cls).validate_python(json)  # type: ignore[arg-type]
    return parsed
