"""Decoding by columns, compared with the library that decodes message by message."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from skills.errors import UnreadableRecording
from skills.formats import topics
from skills.formats.mcap import _WANTED, cdr
from skills.formats.mcap.cdr import SHAPES_LIMIT, SLACK_BYTES, Decoder, Wanted, fields_of
from tests.by_day import examples
from tests.formats import records
from tests.formats.definitions import DEFINITIONS

NUMBERS = st.floats(allow_nan=False, width=64)
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
STAMPS = st.fixed_dictionaries({"sec": st.integers(-(2**31), 2**31 - 1), "nanosec": st.integers(0, 2**32 - 1)})
HEADERS = st.fixed_dictionaries({"stamp": STAMPS, "frame_id": TEXTS})
POINTS = st.fixed_dictionaries(dict.fromkeys("xyz", NUMBERS))
TURNS = st.fixed_dictionaries(dict.fromkeys("xyzw", NUMBERS))
LISTS = st.lists(NUMBERS, max_size=5)
MESSAGES = {
    topics.POSE: st.fixed_dictionaries(
        {"header": HEADERS, "pose": st.fixed_dictionaries({"position": POINTS, "orientation": TURNS})}
    ),
    topics.TRANSFORM: st.fixed_dictionaries(
        {
            "header": HEADERS,
            "child_frame_id": TEXTS,
            "transform": st.fixed_dictionaries({"translation": POINTS, "rotation": TURNS}),
        }
    ),
    topics.JOINT_STATE: st.fixed_dictionaries(
        {
            "header": HEADERS,
            "name": st.lists(TEXTS, max_size=4),
            "position": st.lists(NUMBERS, min_size=3, max_size=3),
            "velocity": LISTS,
            "effort": LISTS,
        }
    ),
    topics.JOY: st.fixed_dictionaries(
        {
            "header": HEADERS,
            "axes": st.lists(st.floats(width=32, allow_nan=False), max_size=3),
            "buttons": st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=4),
        }
    ),
    topics.BOOL: st.fixed_dictionaries({"data": st.booleans()}),
    topics.FLOAT64: st.fixed_dictionaries({"data": NUMBERS}),
    topics.STRING: st.fixed_dictionaries({"data": TEXTS}),
}


def columns_of(messages, name, wanted, definition=None):
    """Decode messages by columns, as they would lie in a file."""
    lengths = np.array([len(message) for message in messages], dtype=np.int64)
    head = records.message(0, 5, b"")
    begin = np.cumsum(lengths) - lengths + len(head) * np.arange(1, len(messages) + 1)
    data = b"".join(head + message for message in messages) + bytes(SLACK_BYTES)
    decoder = Decoder("/a", fields_of(name, definition or DEFINITIONS[name]), wanted)
    return decoder.decode(np.frombuffer(data, np.uint8), begin, lengths)


def theirs(messages, name, definition=None):
    schema = Schema(id=1, name=name, encoding="ros2msg", data=(definition or DEFINITIONS[name]).encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    return [decode(message) for message in messages]


def value_at(message, path):
    for name in path.split("."):
        message = getattr(message, name)
    return message


def encoded(messages, name):
    encode = serialize_dynamic(name, DEFINITIONS[name])[name]
    return [encode(message) for message in messages]


@pytest.mark.parametrize("name", MESSAGES)
@examples(40)
@given(data=st.data())
def test_every_message_says_what_the_library_says_it_says(name, data):
    messages = encoded(data.draw(st.lists(MESSAGES[name], min_size=1, max_size=12)), name)
    wanted = _WANTED[name]
    got, expected = columns_of(messages, name, wanted), theirs(messages, name)
    for row, message in zip(got.values, expected, strict=True):
        said = [value_at(message, path) for path in wanted.numbers]
        numbers = [float(number) for one in said for number in (one if isinstance(one, list) else [one])]
        assert row.tolist() == (numbers[:1] if wanted.first else numbers)
    if got.stamps_ns is not None:
        stamps = [message.header.stamp for message in expected]
        assert got.stamps_ns.tolist() == [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]
    if wanted.text:
        assert [got.labels[k] for k in got.label_of] == [value_at(message, wanted.text) for message in expected]


@examples(30)
@given(st.lists(MESSAGES[topics.POSE], min_size=1, max_size=6), st.data())
def test_big_endian_messages_say_the_same(poses, data):
    store = get_typestore(Stores.ROS2_JAZZY)
    little = encoded(poses, topics.POSE)
    sent = [
        bytes(store.serialize_cdr(store.deserialize_cdr(message, topics.POSE), topics.POSE, little_endian=little_end))
        for message, little_end in zip(little, data.draw(st.lists(st.booleans(), min_size=6, max_size=6)), strict=False)
    ]
    one, other = (columns_of(messages, topics.POSE, _WANTED[topics.POSE]) for messages in (little, sent))
    np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    assert [one.labels[k] for k in one.label_of] == [other.labels[k] for k in other.label_of]


# ---- random definitions -----------------------------------------------------------------------------------------

VALUES = {
    "bool": st.booleans(),
    "uint8": st.integers(0, 255),
    "int8": st.integers(-128, 127),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "int64": st.integers(-(2**53), 2**53),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": NUMBERS,
    "string": TEXTS,
}


@st.composite
def defined(draw, outer="a/T"):
    """Draw a definition as lines, its nested definitions, and a strategy for its messages."""
    lines, others, fields = [], {}, {}
    for number in range(draw(st.integers(1, 4))):
        field, inside = f"f{number}", len(outer) < len("a/T") + 2 and draw(st.integers(0, 3)) == 0
        if inside:
            name = f"{outer}{number}"
            inner, more, values = draw(defined(name))
            others |= {name: inner, **more}
            lines.append(f"{name} {field}  # inner")
            fields[field] = values
            continue
        kind = draw(st.sampled_from(sorted(VALUES)))
        array = draw(st.sampled_from(["", "", "[]", "[3]", "[<=4]"]))
        lines.append(f"{kind}{array} {field}")
        fields[field] = VALUES[kind] if not array else st.lists(VALUES[kind], min_size=3, max_size=3)
    if draw(st.booleans()):
        lines.append("uint8 CONSTANT=7")
    return lines, others, st.fixed_dictionaries(fields)


@examples(60)
@given(defined(), st.data())
def test_any_definition_is_read_as_the_library_reads_it(one, data):
    lines, others, values = one
    definition = "\n".join(lines) + "\n"
    for name, inner in others.items():
        definition += "=" * 80 + f"\nMSG: {name}\n" + "\n".join(inner) + "\n"
    encode = serialize_dynamic("a/msg/Top", definition)["a/msg/Top"]
    messages = [encode(message) for message in data.draw(st.lists(values, min_size=1, max_size=5))]
    numbers = [field.path for field in fields_of("a/msg/Top", definition) if field.code]
    decode = generate_dynamic("a/msg/Top", definition)["a/msg/Top"]
    for path in numbers:
        got = columns_of(messages, "a/msg/Top", Wanted((path,)), definition).values
        expected = [value_at(decode(message), path) for message in messages]
        flat = [list(value) if isinstance(value, list | tuple | bytes) else [value] for value in expected]
        assert got.tolist() == [[float(number) for number in row] for row in flat], path


def test_comments_constants_defaults_and_bounds_are_no_fields():
    definition = """# a pose of its own
int32 LIMIT=3   # a constant
string NAME = "a#b"
float64 x 1.5   # a default
string<=5 name "abc"
float64[<=3] more

float64[2] two
"""
    fields = fields_of("a/msg/B", definition)
    assert [(field.path, field.code, field.count) for field in fields] == [
        ("x", "f8", 1),
        ("name", "", 1),
        ("more", "f8", None),
        ("two", "f8", 2),
    ]


def test_a_definition_may_leave_the_time_out():
    whole = DEFINITIONS[topics.POSE]
    short = whole[: whole.index("=" * 80 + "\nMSG: builtin_interfaces/Time")]
    assert fields_of(topics.POSE, short) == fields_of(topics.POSE, whole)


@pytest.mark.parametrize(
    ("definition", "said"),
    [
        ("a/B b\n", "not defined"),
        ("a/Top b\n", "contains itself"),
        ("b/C[] c\n===\nMSG: b/C\nfloat64 x\n", r"type b/C\[\]"),
        ("wstring x\n", "wstring"),
        ("float64\n", "not a field"),
        ("float64 x\n====\nfloat64 y\n", "without a name"),
        ("\n".join(f"float64 x{k}" for k in range(1001)), "1000 fields"),
    ],
)
def test_a_definition_that_is_not_read_here_says_why(definition, said):
    with pytest.raises(UnreadableRecording, match=said):
        fields_of("a/msg/Top", definition)


# ---- inconsistent messages --------------------------------------------------------------------------------------


def pose_bytes(frame="f", **changes):
    pose = {"position": dict.fromkeys("xyz", 1.0), "orientation": dict.fromkeys("xyzw", 0.5)}
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": frame}
    return encoded([{"header": header, "pose": pose, **changes}], topics.POSE)[0]


@pytest.mark.parametrize("cut", range(0, 76, 7))
def test_a_message_that_ends_within_a_field_is_refused(cut):
    with pytest.raises(UnreadableRecording):
        columns_of([pose_bytes(), pose_bytes()[:cut]], topics.POSE, _WANTED[topics.POSE])


def test_a_length_beyond_the_message_is_refused():
    lying = bytearray(pose_bytes())
    struct.pack_into("<I", lying, 12, 2**32 - 1)
    with pytest.raises(UnreadableRecording, match="ends within a field"):
        columns_of([bytes(lying)], topics.POSE, _WANTED[topics.POSE])


def test_a_message_with_much_behind_it_is_refused_and_padding_is_not():
    columns_of([pose_bytes() + bytes(4)], topics.POSE, _WANTED[topics.POSE])
    with pytest.raises(UnreadableRecording, match="longer than its definition"):
        columns_of([pose_bytes() + bytes(8)], topics.POSE, _WANTED[topics.POSE])


def test_other_encapsulations_are_refused():
    for kind in (2, 3, 6, 7, 0x0100):
        with pytest.raises(UnreadableRecording, match="plain CDR"):
            columns_of([struct.pack(">H", kind) + pose_bytes()[2:]], topics.POSE, _WANTED[topics.POSE])


def test_lengths_behind_what_is_wanted_tell_no_messages_apart(monkeypatch):
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": ""}
    said = {"header": header, "name": [], "position": [1.0, 2.0]}
    split = [{"velocity": 3 * [0.0], "effort": [0.0]}, {"velocity": [0.0], "effort": 3 * [0.0]}]
    messages = encoded([said | rest for rest in split], topics.JOINT_STATE)
    assert len(messages[0]) == len(messages[1])
    monkeypatch.setattr(cdr, "SHAPES_LIMIT", 1)
    assert columns_of(messages, topics.JOINT_STATE, _WANTED[topics.JOINT_STATE]).values.tolist() == 2 * [[1.0, 2.0]]


def test_padding_that_is_not_zero_tells_no_messages_apart():
    dirty = bytearray(pose_bytes("abcde"))
    padding = dirty.index(b"abcde\0") + 6
    dirty[padding : padding + 2] = b"\xaa\xbb"
    one, other = (columns_of([m], topics.POSE, _WANTED[topics.POSE]) for m in (pose_bytes("abcde"), bytes(dirty)))
    np.testing.assert_array_equal(one.values, other.values)


def test_a_topic_with_another_text_in_every_message_is_refused_early():
    messages = [pose_bytes(f"{k:05}") for k in range(SHAPES_LIMIT + 1)]
    with pytest.raises(UnreadableRecording, match="shapes or texts"):
        columns_of(messages, topics.POSE, _WANTED[topics.POSE])


def test_messages_with_other_numbers_of_values_are_refused():
    joints = [
        {"header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": ""}, "name": [], "position": [0.0] * count}
        for count in (6, 7)
    ]
    with pytest.raises(UnreadableRecording, match="with 6 and 7"):
        columns_of(encoded(joints, topics.JOINT_STATE), topics.JOINT_STATE, _WANTED[topics.JOINT_STATE])
