"""Read what a message type is made of from the definition that a file carries.

    definition --fields_of--> fields

Fields are found by their names; what a message is called decides nothing.
"""

import re
from dataclasses import dataclass

from skills.errors import UnreadableRecording

FIELDS_LIMIT = 1000
DEPTH_LIMIT = 20

_CODES = {
    **{"bool": "b1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_TIME = ["int32 sec", "uint32 nanosec"]
_BUILT_IN = {f"builtin_interfaces/{name}": _TIME for name in ("Time", "Duration")}  # some writers leave them out
_RULE = re.compile(r"^={3,}\s*$", re.MULTILINE)
_NAME = re.compile(r"^MSG:\s+(\S+)$")
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)")


@dataclass(frozen=True)
class Field:
    """One field of a message, those of the messages in it included.

    Attributes:
        path: Its name, such as "pose.position.x".
        code: numpy's code of the number, such as "f8"; "" for a text.
        count: How many there are; None for a sequence, whose length stands before it.
    """

    path: str
    code: str
    count: int | None = 1


def fields_of(name: str, definition: str) -> tuple[Field, ...]:
    """Read a ros2msg definition: the message's own part, then those of the messages in it, each below a rule of `=`.

    Raises:
        UnreadableRecording: It is incomplete, holds arrays of messages or wide text, or is larger than any message.
    """
    first, *others = _RULE.split(definition)
    parts = _BUILT_IN | {_short(name): _lines(first)}
    for other in others:
        head, *lines = _lines(other) or [""]
        if (said := _NAME.match(head)) is None:
            raise UnreadableRecording(f"The definition of {name} has a part without a name.")
        parts[_short(said[1])] = lines
    return tuple(_flat(parts, _short(name)))


def _lines(part: str) -> list[str]:
    """Return the lines that say something, without comments."""
    lines = (line.split("#", 1)[0].strip() for line in part.splitlines())
    return [line for line in lines if line]


def _short(name: str) -> str:
    """Write "geometry_msgs/msg/Pose" and "geometry_msgs/Pose" as the second."""
    package, *_, own = name.split("/") if "/" in name else ("", name)
    return f"{package}/{own}"


def _flat(parts: dict[str, list[str]], name: str) -> list[Field]:
    """List the fields of a message in their order, those of messages within it in their place."""
    fields: list[Field] = []
    _add_fields(fields, parts, name, prefix="", depth=0)
    return fields


def _add_fields(fields: list[Field], parts: dict[str, list[str]], name: str, *, prefix: str, depth: int) -> None:
    if name not in parts or depth > DEPTH_LIMIT:
        raise UnreadableRecording(f"{name} is not defined in the file, or holds itself.")
    declared = [match for match in map(_FIELD.match, parts[name]) if match is None or not match[4]]
    for match in declared:
        if match is None:
            raise UnreadableRecording(f"The definition of {name} has a line that is no field.")
        kind, array, path = match[1], match[2], prefix + match[3]
        if kind in _CODES or kind == "string":
            fields.append(Field(path, _CODES.get(kind, ""), _count(array)))
        elif array or kind in ("wstring", "time", "duration"):
            raise UnreadableRecording(f"{name} has a field of type {kind}{array or ''}, which is not read here.")
        else:
            inner = _short(kind if "/" in kind else f"{name.split('/')[0]}/{kind}")
            _add_fields(fields, parts, inner, prefix=f"{path}.", depth=depth + 1)
        if len(fields) > FIELDS_LIMIT:
            raise UnreadableRecording(f"{name} has more than {FIELDS_LIMIT} fields.")
    if not declared:
        fields.append(Field(f"{prefix}structure_needs_at_least_one_member", "u1"))  # ROS 2 design, "IDL mapping"


def _count(array: str | None) -> int | None:
    """Read "[3]" as 3; a sequence, bounded or not, as None; nothing as 1."""
    if array is None:
        return 1
    inside = array[1:-1]
    return int(inside) if inside.isdigit() else None
