"""Dataclasses as the schemas of their JSON: required fields, descriptions from docstrings, properties that are sent."""

from dataclasses import dataclass

from pydantic import TypeAdapter

from skills.fields import Count, Point, as_json, computed_field, schema


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
