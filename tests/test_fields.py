"""Dataclasses as the schemas of their JSON: required fields, descriptions from docstrings, properties that are sent."""

from dataclasses import dataclass
from importlib import import_module
from pkgutil import iter_modules

import pytest
from pydantic import Field, TypeAdapter

import skills.schemas
from skills.fields import Count, Documented, Point, as_json, computed_field, documented, percent, schema


@schema
@dataclass(frozen=True)
class Stitch:
    """A stitch.

    Attributes:
        entry_mm: Where the needle goes in.
        bites: Number of bites; None if
            they were not counted.
    """

    entry_mm: Point
    bites: Count | None = None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def counted(self) -> bool:
        """Whether the bites were counted."""
        return self.bites is not None


@schema
@dataclass(frozen=True, kw_only=True)
class Knot(Stitch):
    """A stitch with a knot.

    Attributes:
        throws: Number of throws.
    """

    throws: int


def described(kind: type) -> dict:
    return TypeAdapter(kind).json_schema(mode="serialization")


def test_every_field_and_sent_property_is_required_whatever_its_default():
    assert set(described(Stitch)["required"]) == {"entry_mm", "bites", "counted"}
    assert not any({"default", "readOnly"} & {*one} for one in described(Stitch)["properties"].values())


def test_fields_are_described_by_the_docstrings_of_the_class_and_its_bases():
    found = described(Knot)
    assert found["description"] == "A stitch with a knot."
    said = {name: one.get("description") for name, one in found["properties"].items()}
    assert said == {
        "entry_mm": "Where the needle goes in.",
        "bites": "Number of bites; null if they were not counted.",
        "counted": "Whether the bites were counted.",
        "throws": "Number of throws.",
    }


def test_a_value_as_json_has_lists_and_its_sent_properties():
    said = as_json(Knot(entry_mm=(1.0, 2.5, 0), bites=2, throws=3))
    assert repr(said) == "{'entry_mm': [1.0, 2.5, 0], 'bites': 2, 'throws': 3, 'counted': True}"


class Needle(Documented):
    """A needle.

    Attributes:
        length_mm: Along
            its arc.
    """

    length_mm: float = Field(gt=0)
    name: str = Field(default="", description="Its maker's name.")


class Curved(Needle):
    """A curved needle."""

    turn_deg: float


def test_fields_of_models_and_of_their_bases_are_described():
    found = Curved.model_json_schema()
    assert found["description"] == "A curved needle."
    assert Needle.model_json_schema()["description"] == "A needle."
    assert found["properties"]["length_mm"]["description"] == "Along its arc."
    assert found["properties"]["length_mm"]["exclusiveMinimum"] == 0
    assert found["properties"]["name"]["description"] == "Its maker's name."
    assert "description" not in found["properties"]["turn_deg"]


def is_made(kind: type) -> bool:
    """Return whether a model was made from a settings class, whose docstring describes class variables too."""
    return getattr(import_module(kind.__module__), kind.__name__, None) is not kind


def test_docstrings_of_models_describe_only_fields_that_there_are():
    for module in iter_modules(skills.schemas.__path__, "skills.schemas."):
        import_module(module.name)
    kinds, seen = [Documented], set()
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        seen.add(kind.__name__)
        if kind.__module__.startswith("skills.schemas") and kind.__doc__ and not is_made(kind):
            assert documented(kind)[1].keys() <= kind.model_fields.keys(), kind
    assert {"TrainingIn", "PolicyManifest"} <= seen


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [
        (1.0, 0, "100"),
        (0.996, 0, "> 99"),
        (0.0, 0, "0"),
        (0.004, 0, "< 1"),
        (0.9996, 1, "> 99.9"),
        (0.12345, 1, "12.3"),
    ],
)
def test_less_than_all_is_not_100_percent_and_some_are_not_0(share: float, digits: int, text: str):
    assert percent(share, digits) == text
