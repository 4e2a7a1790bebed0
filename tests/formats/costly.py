"""Files below 1 MB that are valid in their format and cost a naive reader much processor time, by name."""

import io
import json
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

from skills.formats import bag_writer, topics
from skills.formats.bag_writer import write_messages
from tests.formats import bags, hostile, records

RULE = "=" * 80
TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
    "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
)
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
ONE_TOPIC = f"INSERT INTO topics VALUES (1, '{hostile.LOCAL}', '{topics.POSE}', 'cdr', '')"
ENDLESS = (
    "WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) SELECT x AS schema_version FROM r WHERE x < 0"
)


def foreign_databases() -> dict[str, bytes]:
    """Return .db3 files with content that rosbag2 never writes, by that content."""
    bag = (TOPICS, ONE_TOPIC, MESSAGES)
    return {
        "view": database(*bag, f"CREATE VIEW schema AS {ENDLESS}"),
        "trigger": database(*bag, "CREATE TRIGGER t AFTER INSERT ON messages BEGIN SELECT 1; END"),
        "virtual table": database(*bag, "CREATE VIRTUAL TABLE schema USING fts5(schema_version)"),
        "table": database(*bag, "CREATE TABLE patients(name TEXT)"),
        "index": database(*bag, "CREATE INDEX slow ON messages(topic_id)"),
        "computed index": database(*bag, "CREATE INDEX timestamp_idx ON messages(hex(data))"),
        "computed column": database(
            TOPICS, ONE_TOPIC, MESSAGES.replace("data BLOB", "data BLOB AS (hex(zeroblob(100000000)))")
        ),
    }


def costly_databases() -> dict[str, bytes]:
    """Return .db3 files of the right tables that are expensive to query or to parse."""
    numbers = "WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r LIMIT 20000) SELECT"
    return {
        "a join of 20,000 rows with 20,000": database(
            "CREATE TABLE topics(id, name, type, serialization_format, offered_qos_profiles)",
            f"INSERT INTO topics {numbers} 1, '/PSM2/a', 't', 'cdr', '' FROM r",
            MESSAGES,
            f"INSERT INTO messages {numbers} x, 1, x, '' FROM r",
        ),
        "900 kB of quality-of-service profiles": database(
            TOPICS, ONE_TOPIC.replace("'')", "'- a: 1\n" + "  b: 1\n" * 120_000 + "')"), MESSAGES
        ),
        "20,000 topics": database(
            TOPICS, f"INSERT INTO topics {numbers} x, '/PSM'||x||'/measured_cp', 't', 'cdr', '' FROM r", MESSAGES
        ),
    }


def costly_definitions() -> dict[str, bytes]:
    """Return files whose message types take rosbags long to parse."""
    fields = "".join(f"float64 x{k}\n" for k in range(50_000))
    idl = "".join(f"double x{k};" for k in range(50_000))
    idl = f"module geometry_msgs {{ module msg {{ struct PoseStamped {{ {idl} }}; }}; }};"
    return {
        ".db3, 50,000 fields": defined(fields, "ros2msg"),
        ".db3, 50,000 fields in IDL": defined(idl, "ros2idl"),
        "MCAP, 50,000 fields in IDL": records.whole(records.schema(1, topics.POSE, idl, "ros2idl") + hostile.ONE_POSE),
        "ROS 1, 25,000 fields": rosbag1(fields[: len(fields) // 2].rpartition("\n")[0].encode()),
    }


def costly_tables() -> dict[str, bytes]:
    """Return CSV files of wide rows and long lines."""
    head = b"t_s,x_mm,y_mm,z_mm\n"
    extract = b"# Topic: /PSM1/local/measured_cp\n# Type: geometry_msgs/msg/PoseStamped\n"
    return {
        "100,000 columns of one name": b",".join([b"x_m"] * 100_000) + b"\n",
        "100,000 columns": b",".join(b"c%d" % k for k in range(100_000)) + b"\n",
        "a row of 450,000 cells": head + b"1," * 450_000,
        "a row of 200,000 lines": head + b'"\n",' * 200_000,
        "a cell of 900,000 characters": head + b"1,1,1," + b"1" * 900_000,
        "an ee_csv of 100,000 columns": b",".join(b"psm%d_pose.position.x" % k for k in range(40_000)) + b"\n",
        "an ee_csv of numpy's brackets": b"timestamp,psm1_pose.position.x\n" + b"np.float64(" * 80_000,
        "a table of tabs": b"t_s" + b"\t" * 900_000,
        "an ee_csv of 16,000 brackets in a line": b"timestamp,psm1_pose.position.x\n" + b"np.float64(" * 1_400 + b"\n",
        "an extract of 100,000 columns": extract + b",".join([b"header.frame_id"] * 60_000) + b"\n",
        "an extract of an endless first line": b"# Topic: " + b"/" * 900_000,
    }


def costly_archives() -> dict[str, bytes]:
    """Return zip archives of JSON, metadata and texts that decompress to a large size."""
    pose = bags.pose_bag(bags.straight(40))
    trial = (" ".join(["0.1 0.1 0.1 1 0 0 0 1 0 0 0 1 0 0 0 0 0 0 0.1"] * 4) + "\n").encode()
    return {
        "JSON with 5,000,000 stages": zipped(
            {"b/x.mcap": pose, "t.json": b'{"stages": [' + b"[]," * 5_000_000 + b"1]}"}
        ),
        "JSON of one long number": zipped({"b/x.mcap": pose, "t.json": b"1" * 15_000_000}),
        "JSON of brackets": zipped({"b/x.mcap": pose, "t.json": b"[" * 15_000_000}),
        "metadata of 16 MB": zipped({"b/x.mcap": pose, "b/metadata.yaml": b"  a:\n" * 3_000_000}),
        "a transcription of 2,000,000 gestures": zipped({"a.txt": trial * 100, "t.txt": b"1 2 G1\n" * 2_000_000}),
        "ten texts of 16 MB": zipped({"a.txt": trial, **{f"{k}.txt": b"a b\n" * 4_000_000 for k in range(9)}}),
    }


def costly_recordings() -> dict[str, bytes]:
    """Return recordings of valid messages with too many items of one kind."""
    return {"1,000 arms": arms(1000, 4)}


def costly_to_tell() -> dict[str, bytes]:
    """Return recordings that are read quickly, and in which the search for hand-offs is expensive."""
    rows = (f"{k * 0.125},{k // 4 % 2 * 8},0,-100,{k % 2 * 0.5}\n" for k in range(30_000))
    at_ns = bags.START_NS
    stages = [{"name": f"hand-off {k}", "start": at_ns + k, "end": at_ns + 1999 * 10**8} for k in range(9_000)]
    tagged = {"b/b.mcap": slow(2000, 0.1), "b/b_tags.json": json.dumps({"stages": stages}).encode()}
    return {
        "a jaw that flickers for an hour": "".join(["t_s,x_mm,y_mm,z_mm,jaw_rad\n", *rows]).encode(),
        "9,000 stages of three minutes at once": zipped(tagged),
    }


def slow(samples: int, step_s: float) -> bytes:
    """Write an MCAP file in which one arm moves back and forth."""

    def said() -> Iterable[bag_writer.Message]:
        for k in range(samples):
            place = (0.01 * (k // 2 % 2), 0.05, -0.12)
            at_ns = bags.START_NS + round(k * step_s * 1e9)
            yield bag_writer.pose("/PSM1/local/measured_cp", at_ns, "PSM1_base", place, (0.0, 0.0, 0.0, 1.0))

    out = io.BytesIO()
    write_messages(said(), out)
    return out.getvalue()


def arms(count: int, samples: int) -> bytes:
    """Write an MCAP file in which many arms move and grip."""

    def said() -> Iterable[bag_writer.Message]:
        for arm in range(count):
            for k in range(samples):
                at_ns = bags.START_NS + k * bags.STEP_NS
                name, place = f"/PSM{arm}", (0.01 * (k % 7), 0.05, -0.12)
                yield bag_writer.pose(f"{name}/local/measured_cp", at_ns, "PSM_base", place, (0.0, 0.0, 0.0, 1.0))
                yield bag_writer.joint_state(f"{name}/jaw/measured_js", at_ns, [0.8 * (k % 2)], ["jaw"])

    out = io.BytesIO()
    write_messages(said(), out)
    return out.getvalue()


def database(*statements: str) -> bytes:
    """Return a SQLite file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "made.db3")
        connection = sqlite3.connect(path)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()
        return path.read_bytes()


def defined(definition: str, encoding: str) -> bytes:
    """Return a .db3 bag of schema 4 with one message type."""
    return database(
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
        "INSERT INTO schema VALUES (4, 'jazzy')",
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL, "
        "encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL)",
        f"INSERT INTO message_definitions VALUES (1, '{topics.POSE}', '{encoding}', '{definition}', '')",
        TOPICS.replace(")", ", type_description_hash TEXT NOT NULL)"),
        ONE_TOPIC.replace("'')", "'', '')"),
        MESSAGES,
    )


def rosbag1(definition: bytes) -> bytes:
    """Return a ROS 1 bag (version 2.0) with one connection and no messages."""

    def fields(**values: bytes) -> bytes:
        named = (name.encode() + b"=" + value for name, value in values.items())
        joined = b"".join(struct.pack("<I", len(one)) + one for one in named)
        return struct.pack("<I", len(joined)) + joined

    def record(head: bytes, data: bytes) -> bytes:
        return head + struct.pack("<I", len(data)) + data

    number, topic = struct.pack("<I", 0), hostile.LOCAL.encode()
    said = fields(topic=topic, type=b"geometry_msgs/PoseStamped", md5sum=b"0" * 32, message_definition=definition)
    connection = record(fields(op=b"\x07", conn=number, topic=topic), said[4:])
    chunk = record(fields(op=b"\x05", compression=b"none", size=struct.pack("<I", len(connection))), connection)
    index = record(fields(op=b"\x04", ver=struct.pack("<I", 1), conn=number, count=number), b"")
    magic, one = b"#ROSBAG V2.0\n", struct.pack("<I", 1)
    begin = len(magic) + 4096
    at = struct.pack("<Q", begin + len(chunk) + len(index))
    header = fields(op=b"\x03", index_pos=at, conn_count=one, chunk_count=one)
    padding = 4096 - len(header) - 4
    times = {"start_time": bytes(8), "end_time": bytes(8)}
    info = fields(op=b"\x06", ver=one, chunk_pos=struct.pack("<Q", begin), **times, count=one)
    padded = header + struct.pack("<I", padding) + b" " * padding
    return magic + padded + chunk + index + connection + record(info, number + number)


def zipped(members: dict[str, bytes]) -> bytes:
    """Compress members as small as deflate can."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()
