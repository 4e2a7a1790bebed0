"""LeRobot datasets as recorders and LeRobot write them, in v2.1 and v3.0, and Parquet files that are hostile."""

import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from skills.kinematics import POINTING_DOWN, inverse
from tests.formats.others import zipped

FPS = 30
PARTS = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
STATE = [f"psm{arm}_{part}" for arm in (1, 2) for part in (*(f"pose.{one}" for one in PARTS), "jaw")]
ACTION = [name.replace("_pose", "_sp").replace("_jaw", "_jaw_sp") for name in STATE]
TASKS = ("suture throw", "needle pass")
NEEDLE_DRIVER = "LARGE_NEEDLE_DRIVER:400006"


def poses(count: int, seed: int = 0) -> np.ndarray:
    """Return poses and jaws of both arms in m and rad, single precision, shape (count, 16)."""
    at = np.arange(count)[:, None] / FPS + seed
    turn = np.concatenate([0.1 * np.sin(at), np.full((count, 1), 0.2), 0.05 * np.cos(at), np.ones((count, 1))], axis=1)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    arms = [
        np.concatenate(
            [0.02 * np.sin(at) + side, 0.01 * np.cos(at), -0.1 - 0.01 * np.sin(at / 7), turn, 0.3 + 0.1 * np.sin(at)],
            axis=1,
        )
        for side in (0.03, -0.03)
    ]
    return np.concatenate(arms, axis=1).astype(np.float32)


def commands(count: int = 40, seed: int = 0) -> np.ndarray:
    """Return setpoints near the poses, and of the jaws, single precision, shape (count, 16)."""
    numbers = poses(count, seed)
    numbers[:, [0, 1, 2, 8, 9, 10]] += np.float32(0.002)
    numbers[:, [7, 15]] -= np.float32(0.05)
    return numbers


def joints(count: int) -> np.ndarray:
    """Return the joints of a PSM along a straight line, rad and m, shape (count, 6)."""
    tip_mm = np.linspace([-10.0, 40.0, -120.0], [20.0, 60.0, -110.0], count)
    q = inverse(tip_mm, POINTING_DOWN)
    q[:, 2] /= 1000.0
    return q


def joint_columns(names: Sequence[str]) -> tuple[dict[str, Any], dict[str, Sequence[str]]]:
    """Return the columns of an episode whose state is six joints and a jaw, and these names."""
    state = np.concatenate([joints(40), np.full((40, 1), 0.2)], axis=1).astype(np.float32)
    return columns_of(40, **{"observation.state": state}), {"observation.state": names}


def numbers(names: Sequence[str] | None, width: int, dtype: str = "float32") -> dict[str, Any]:
    """Describe a feature of numbers; names may be an object with lists of them, as some writers have it."""
    listed = names if names is None or isinstance(names, dict) else list(names)
    return {"dtype": dtype, "shape": [width], "names": listed}


def text() -> dict[str, Any]:
    """Describe a feature of one text."""
    return {"dtype": "string", "shape": [1], "names": ["value"]}


def columns_of(count: int, episode: int = 0, **more: Any) -> dict[str, Any]:
    """Return the columns of an episode; those of `more` replace or add some, None leaves one out."""
    columns = {
        "observation.state": poses(count, episode),
        "action": poses(count, episode + 1),
        "observation.meta.tool.psm1": [NEEDLE_DRIVER] * count,
        "observation.meta.tool.psm2": ["Debakey Forceps"] * count,
        "timestamp": (np.arange(count) / FPS).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, episode),
        "index": np.arange(count),
        "task_index": np.full(count, episode % 2),
    }
    return {name: column for name, column in (columns | more).items() if column is not None}


def table(columns: Mapping[str, Any], *, fixed: bool = True) -> pa.Table:
    """Return columns as a table; those of several numbers as lists of fixed length, or not."""
    arrays = {}
    for name, column in columns.items():
        if isinstance(column, np.ndarray) and column.ndim == 2:
            flat = pa.array(column.ravel())
            width = column.shape[1]
            lists = pa.FixedSizeListArray.from_arrays(flat, width)
            offsets = pa.array(np.arange(len(column) + 1) * width, pa.int32())
            arrays[name] = lists if fixed else pa.ListArray.from_arrays(offsets, flat)
        else:
            arrays[name] = column if isinstance(column, pa.Array) else pa.array(column)
    return pa.table(arrays)


def parquet(columns: Mapping[str, Any] | pa.Table, **how: Any) -> bytes:
    """Return columns as a Parquet file."""
    with io.BytesIO() as out:
        pq.write_table(columns if isinstance(columns, pa.Table) else table(columns), out, **how)
        return out.getvalue()


def features_of(columns: Mapping[str, Any], names: Mapping[str, Sequence[str]] | None = None) -> dict[str, Any]:
    """Describe the features of columns; names are nested in one more list, as Open-H's converter writes them."""
    known = {"observation.state": [STATE], "action": [ACTION]} | dict(names or {})
    described = {}
    for name, column in columns.items():
        if isinstance(column, list):
            described[name] = text()
        else:
            width = column.shape[1] if column.ndim == 2 else 1
            described[name] = numbers(known.get(name), width, str(column.dtype))
    return described


def info_of(features: Mapping[str, Any], episodes: int, frames: int, version: str = "v2.1", **more: Any) -> bytes:
    """Return an info.json."""
    return json.dumps(
        {
            "codebase_version": version,
            "robot_type": "dvrk",
            "fps": FPS,
            "total_episodes": episodes,
            "total_frames": frames,
            "splits": {"train": f"0:{episodes}", "recovery": "1:2"},
            "data_path": "../../../etc/{episode_chunk.__class__}/{episode_index:999999999d}.parquet",
            "features": features,
        }
        | more
    ).encode()


def episode(
    columns: Mapping[str, Any] | None = None,
    *,
    names: Mapping[str, Sequence[str]] | None = None,
    said: Mapping[str, Any] | None = None,
    data: bytes | None = None,
    count: int = 40,
    **info: Any,
) -> dict[str, bytes]:
    """Return the files of a dataset of one episode."""
    columns = columns_of(count) if columns is None else columns
    rows = len(next(iter(columns.values())))
    files = {
        "meta/info.json": info_of(**{"features": features_of(columns, names), "episodes": 1, "frames": rows} | info),
        "meta/tasks.jsonl": b"\n".join(json.dumps({"task_index": k, "task": t}).encode() for k, t in enumerate(TASKS)),
        "data/chunk-000/episode_000000.parquet": parquet(columns) if data is None else data,
    }
    return files | ({} if said is None else {"meta/suture-skills.json": json.dumps(said).encode()})


def packed(files: Mapping[str, bytes]) -> io.BytesIO:
    """Return files as a zip."""
    return io.BytesIO(zipped(dict(files)))


COUNTS = (40, 50, 60)


def dataset(version: str, *, groups: int | None = None) -> dict[str, bytes]:
    """Return the files of a dataset of three episodes.

    Args:
        version: "v2.1" or "v3.0".
        groups: Rows per row group of v3.0; None: one row group per episode.
    """
    episodes = [columns_of(count, k) for k, count in enumerate(COUNTS)]
    files = {"meta/info.json": info_of(features_of(episodes[0]), 3, sum(COUNTS), version)}
    if version == "v2.1":
        files["meta/tasks.jsonl"] = episode()["meta/tasks.jsonl"]
        return files | {f"data/chunk-000/episode_{k:06d}.parquet": parquet(one) for k, one in enumerate(episodes)}
    first = [int(sum(COUNTS[:k])) for k in range(3)]
    places = {
        "episode_index": [0, 1, 2],
        "tasks": [[TASKS[k % 2]] for k in range(3)],
        "length": list(COUNTS),
        "data/chunk_index": [0, 0, 0],
        "data/file_index": [0, 0, 1],
        "dataset_from_index": first,
        "dataset_to_index": [one + count for one, count in zip(first, COUNTS, strict=True)],
    }
    files["meta/tasks.parquet"] = parquet(pa.table({"task_index": [0, 1], "task": list(TASKS)}))
    files["meta/episodes/chunk-000/file-000.parquet"] = parquet(pa.table(places))
    for number, part in ((0, episodes[:2]), (1, episodes[2:])):
        with io.BytesIO() as out:
            tables = [table(one, fixed=False) for one in part]
            with pq.ParquetWriter(out, tables[0].schema) as writer:
                for one in tables if groups is None else [pa.concat_tables(tables)]:
                    writer.write_table(one, row_group_size=groups)
            files[f"data/chunk-000/file-{number:03d}.parquet"] = out.getvalue()
    return files


def write(files: Mapping[str, bytes], folder: Path) -> Path:
    """Write files below a folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


# ---- hostile files -------------------------------------------------------------------------------------------------


BOMBS: dict[str, Callable[[], bytes]] = {  # each makes a zip of one episode, below 1 MB
    "a million rows of one value": lambda: made({"observation.state": np.zeros((1_000_000, 16), dtype=np.float32)}),
    "ten million rows of one number": lambda: made({"observation.state": poses(4)}, data=_endless("observation.state")),
    "a dictionary of one text of 60 MB": lambda: made(
        columns_of(4), data=parquet(columns_of(4) | {"observation.meta.tool.psm1": ["x" * (60 << 20)] * 4})
    ),
    "lists of a million numbers": lambda: made({"observation.state": poses(4)}, data=_long_lists()),
    "200 levels": lambda: made({"observation.state": poses(4)}, data=_deep_lists(200)),
    "a footer of 2 GiB": lambda: made(columns_of(4), data=b"PAR1" + bytes(100) + b"\xff\xff\xff\x7fPAR1"),
    "a footer of zeros": lambda: made(columns_of(4), data=b"PAR1" + bytes(100) + b"\x40\0\0\0PAR1"),
    "a schema of 5000 levels": lambda: made(columns_of(4), data=_deep_footer(5000)),
    "a schema of 200,000 levels": lambda: made(columns_of(4), data=_deep_footer(200_000)),
    "JSON of brackets": lambda: zipped(episode(count=4) | {"meta/info.json": b"[" * 1_000_000}),
    "a feature of 10^30 numbers": lambda: zipped(
        episode(count=4) | {"meta/info.json": info_of({"observation.state": numbers(None, 10**30)}, 1, 4)}
    ),
    "5000 features of 5000 numbers": lambda: zipped(
        episode(count=4) | {"meta/info.json": info_of({f"x{k}": numbers(None, 5000) for k in range(5000)}, 1, 4)}
    ),
    "a rate of NaN": lambda: zipped(episode(count=4, fps=float("nan"))),
}


def made(columns: Mapping[str, Any], **how: Any) -> bytes:
    """Return an episode as a zip."""
    return zipped(episode(columns, **how))


def _endless(name: str) -> bytes:
    """Return ten million rows of one number, in a few pages."""
    return parquet(pa.table({name: pa.array(np.zeros(10_000_000, dtype=np.float32))}), compression="zstd")


def _long_lists() -> bytes:
    zeros = pa.array(np.zeros(8_000_000, dtype=np.float32))
    lists = pa.ListArray.from_arrays(pa.array([0, 2_000_000, 4_000_000, 6_000_000, 8_000_000], pa.int32()), zeros)
    return parquet(pa.table({"observation.state": lists}), compression="zstd")


def _deep_lists(levels: int) -> bytes:
    deep: Any = pa.array([0.0] * 4)
    for _ in range(levels):
        deep = pa.ListArray.from_arrays(pa.array(range(5), pa.int32()), deep)
    return parquet(pa.table({"observation.state": deep}))


def _deep_footer(levels: int) -> bytes:
    """Return a file whose schema is a chain of groups, as Thrift's compact protocol encodes it."""
    group = b"\x35\x02\x18\x01a\x15\x02\x00"  # repetition: repeated, name: a, children: 1
    leaf = b"\x15\x0a\x25\x02\x18\x01a\x00"  # type: double
    count = varint(levels + 1)
    footer = b"\x15\x02\x19\xfc" + count + b"\x48\x01r\x15\x02\x00" + group * (levels - 1) + leaf
    footer += b"\x16\x00\x19\x0c\x00"  # no rows, no row groups
    return b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def varint(number: int) -> bytes:
    """Return a number in the variable length of Thrift's compact protocol."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])
