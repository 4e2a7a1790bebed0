"""Cutting the user's own LeRobot datasets into zips of one episode each, without pictures.

    path --find_dataset--> Dataset --choose_episodes--> Episode --cut_episode--> zip

The zip has the layout of v2.1: `meta/info.json`, reduced to this episode, its line of `meta/episodes.jsonl`, its tasks,
and its Parquet file: of v2.1 the very bytes of the dataset's file, unless that contains pictures; of v3.0 the rows of
the episode. The same dataset and statements give the same zip, and so the same recording.
"""

import io
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any, BinaryIO

from skills.errors import BadInput, UnreadableRecording
from skills.formats.archive import HEAD_BYTES, MAGIC, Archive, check_pointer, pack, refusing
from skills.formats.lerobot import (
    EPISODE_LINES,
    EPISODES,
    INFO,
    STATEMENTS,
    TASK_LINES,
    Dataset,
    Json,
    read_dataset,
    root_of,
)
from skills.formats.lerobot.episode import several_episodes
from skills.formats.lerobot.parquet import open_parquet, read_rows

_EPISODE_FILE = re.compile(r"episode_(\d{1,9})\.parquet$")
_DATA_FILE = re.compile(r"chunk-(\d{1,9})/file-(\d{1,9})\.parquet$")
_KEPT = ("codebase_version", "robot_type", "fps", "splits", "features")  # of info.json; other keys may name people
_EPISODE = "data/chunk-000/episode_{:06d}.parquet"


@dataclass(frozen=True)
class Folder:
    """The metadata and data of a dataset in a folder."""

    path: Path

    @cached_property
    def names(self) -> list[str]:
        """The names of its files, without videos and pictures."""
        found = (file for part in ("meta", "data") for file in (self.path / part).rglob("*") if file.is_file())
        return sorted(file.relative_to(self.path).as_posix() for file in found)

    def text(self, name: str) -> str:
        """Return a file as text."""
        try:
            text = (self.path / name).read_text(encoding="utf-8-sig")
            check_pointer(text[:HEAD_BYTES].encode())
            return text
        except UnicodeDecodeError as error:
            raise UnreadableRecording(f"{name} of the dataset is not UTF-8 text. Copy it again.") from error

    @contextmanager
    def unpacked(self, name: str) -> Iterator[BinaryIO]:
        """Open a file."""
        with (self.path / name).open("rb") as file:
            check_pointer(file.read(HEAD_BYTES))
            file.seek(0)
            yield file


@dataclass(frozen=True)
class Episode:
    """The place of an episode: the file, its first row in it and its number of rows; None: the whole file."""

    number: int
    file: str
    first: int = 0
    rows: int | None = None


@contextmanager
def find_dataset(path: Path) -> Iterator[Dataset | None]:
    """Yield the LeRobot dataset at a path: a folder with meta/info.json, or a zip of one; None if there is none.

    Raises:
        UnreadableRecording: It is damaged, or of a version that is not read.
    """
    if (path / INFO).is_file():
        yield read_dataset(Folder(path), "")
        return
    if not path.is_file():
        yield None
        return
    with path.open("rb") as file:
        archive = Archive(file) if file.read(len(MAGIC)) == MAGIC else None
        root = None if archive is None else root_of(archive.names)
        yield None if archive is None or root is None else read_dataset(archive, root)


def episodes_of(dataset: Dataset) -> dict[int, Episode]:
    """Return the episodes of a dataset by number.

    Raises:
        UnreadableRecording: There are none, two of one number, or a file of one is missing.
    """
    found = list(_episodes_in_files(dataset) if dataset.version == "v3.0" else _files_of_episodes(dataset))
    episodes = {one.number: one for one in found}
    if not found or len(episodes) < len(found):
        raise UnreadableRecording("The dataset has no episodes, or two of one number; copy it again.")
    return dict(sorted(episodes.items()))


def choose_episodes(dataset: Dataset, which: str | None) -> list[Episode]:
    """Return the requested episodes of a dataset.

    Args:
        dataset: From `find_dataset`.
        which: A number as in the dataset, "all", or None for its only episode.

    Raises:
        BadInput: There is no such episode.
        UnreadableRecording: There are several and none was requested.
    """
    episodes = episodes_of(dataset)
    if which is None and len(episodes) > 1:
        raise several_episodes(len(episodes))
    if which is None or which == "all":
        return list(episodes.values())
    if not (which.isdecimal() and len(which) <= 9 and int(which) in episodes):  # of more digits none is a number
        raise BadInput(f"The dataset has no episode {which[:80]!r}; it has {_listed(episodes)}.")
    return [episodes[int(which)]]


def cut_episode(
    dataset: Dataset,
    episode: Episode,
    out: IO[bytes],
    *,
    columns: Mapping[str, str] | None = None,
    tools: Mapping[str, str] | None = None,
) -> None:
    """Write one episode of a dataset as a zip.

    Args:
        dataset: From `find_dataset`.
        episode: From `episodes_of` or `choose_episodes`.
        out: The zip.
        columns: Our names of columns and the dataset's, such as psm1_pose.position.x and observation.state[0].
        tools: Arms and the numbers of their instruments, such as PSM1 and 400006.

    Raises:
        UnreadableRecording: Its file is damaged, has other episodes, or not the frames that the dataset claims.
    """
    from pyarrow import Table, parquet

    number = episode.number
    pictures = {one.name for one in dataset.features if one.is_picture}
    with dataset.files.unpacked(episode.file) as file:
        rows: Table = _rows_of(file, episode)
        if "episode_index" in rows.column_names and set(rows["episode_index"].unique().to_pylist()) != {number}:
            raise UnreadableRecording(f"The data of episode {number} are of other episodes; copy the dataset again.")
        dataset.check_length(number, rows.num_rows)
        if episode.rows is None and not pictures & {*rows.column_names}:
            file.seek(0)
            data = file.read()
        else:
            kept = rows.drop_columns(sorted(pictures & {*rows.column_names})).replace_schema_metadata(None)
            with io.BytesIO() as packed:
                parquet.write_table(kept, packed)
                data = packed.getvalue()
    members = {INFO: _json(_info(dataset, rows.num_rows, pictures)), _EPISODE.format(number): data}
    tasks = sorted(set(rows["task_index"].to_pylist())) if "task_index" in rows.column_names else []
    named = [{"task_index": task, "task": dataset.tasks[task]} for task in tasks if task in dataset.tasks]
    members[TASK_LINES] = b"\n".join(map(_json, named))
    about = {"episode_index": number, "tasks": [one["task"] for one in named], "length": rows.num_rows}
    members[EPISODE_LINES] = _json(about)
    before = dataset.statements
    changes = {"columns": {**before.columns, **columns}} if columns else {}
    changes |= {"tools": {**before.tools, **tools}} if tools else {}
    version = {"cut_from": dataset.version} if dataset.version == "v3.0" else {}
    if statements := before.model_dump(exclude_unset=True) | changes | version:
        members[STATEMENTS] = _json(statements)
    pack({name: io.BytesIO(data) for name, data in sorted(members.items())}, out)


def _files_of_episodes(dataset: Dataset) -> Iterator[Episode]:
    """Yield the episodes of v2.1, one per file."""
    for name in dataset.data:
        if found := _EPISODE_FILE.search(name):
            yield Episode(int(found[1]), name)


def _episodes_in_files(dataset: Dataset) -> Iterator[Episode]:
    """Yield the episodes of v3.0, from the table that says in which rows of which file each one is."""
    ends = ["dataset_from_index", "dataset_to_index"]
    names = ["episode_index", "length", "data/chunk_index", "data/file_index", *ends]
    places = []
    for table in dataset.parquets("meta/episodes/"):
        with dataset.files.unpacked(table) as file:
            places += read_rows(file, names, most_rows=EPISODES)
    if not all(isinstance(place[name], int) for place in places for name in names):
        raise UnreadableRecording("A number in meta/episodes of the dataset is missing; copy the dataset again.")
    wrong = next((one for one in places if one["dataset_to_index"] - one["dataset_from_index"] != one["length"]), None)
    if wrong is not None:
        raise UnreadableRecording(
            f"meta/episodes of the dataset gives episode {wrong['episode_index']} {wrong['length']} frames, from "
            f"{wrong['dataset_from_index']} to {wrong['dataset_to_index']}; copy the dataset again."
        )
    files = {(int(found[1]), int(found[2])): name for name in dataset.data if (found := _DATA_FILE.search(name))}
    places.sort(key=lambda place: int(place["dataset_from_index"]))
    last = {(one["data/chunk_index"], one["data/file_index"]): one["dataset_to_index"] for one in places}
    known = {where: _first_index(dataset, files[where], end) for where, end in last.items() if where in files}
    first = {where: index for where, index in known.items() if index is not None}
    for place in places:
        where = place["data/chunk_index"], place["data/file_index"]
        if where not in files:
            raise UnreadableRecording(f"The dataset has no file {where[1]} in chunk {where[0]}, which has episodes.")
        row = place["dataset_from_index"] - first.setdefault(where, place["dataset_from_index"])
        yield Episode(place["episode_index"], files[where], row, place["length"])


def _first_index(dataset: Dataset, name: str, end: int) -> int | None:
    """Return the number of a file's first row in the whole dataset, by which row `end` - 1 must be in the file.

    Without it, as in datasets that number the rows of each episode, the first known episode begins with the file.
    """
    with dataset.files.unpacked(name) as file, refusing("A Parquet file of the dataset", "Copy the dataset again."):
        opened = open_parquet(file)
        rows = opened.metadata.num_rows
        if not rows or "index" not in opened.schema_arrow.names:
            return None
        index = next(opened.iter_batches(1, columns=["index"], use_threads=False)).column("index")[0].as_py()
    return index if isinstance(index, int) and end - index <= rows else None


def _rows_of(file: BinaryIO, episode: Episode) -> Any:
    """Return the rows of an episode as pyarrow's table, from the row groups in which they are."""
    opened = open_parquet(file)
    with refusing("A Parquet file of the dataset", "Copy the dataset again."):
        if episode.rows is None:
            return opened.read()
        end, start, groups, before = episode.first + episode.rows, 0, [], 0
        for group in range(opened.metadata.num_row_groups):
            stop = start + opened.metadata.row_group(group).num_rows
            if start < end and stop > episode.first:
                groups.append(group)
            before = start if groups == [group] else before
            start = stop
        rows = opened.read_row_groups(groups).slice(episode.first - before, episode.rows)
    if rows.num_rows != episode.rows:
        raise UnreadableRecording(
            f"Episode {episode.number} has {rows.num_rows} of {episode.rows} rows; copy it again."
        )
    return rows


def _info(dataset: Dataset, rows: int, pictures: set[str]) -> Json:
    """Return the metadata of one episode: those of the dataset, reduced to it."""
    info = {name: dataset.info[name] for name in _KEPT if name in dataset.info}
    info["features"] = {name: one for name, one in info["features"].items() if name not in pictures}
    for one in dataset.features:
        if one.names and isinstance(info["features"][one.name]["names"], dict):  # its order would be lost
            info["features"][one.name] = info["features"][one.name] | {"names": list(one.names)}
    return info | {"codebase_version": "v2.1", "total_episodes": 1, "total_frames": rows}


def _json(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, ensure_ascii=False).encode()


def _listed(episodes: Mapping[int, Episode]) -> str:
    """Return the numbers of the episodes in words."""
    numbers = list(episodes)
    whole = numbers == list(range(numbers[0], numbers[-1] + 1))
    return f"{numbers[0]} to {numbers[-1]}" if whole else ", ".join(map(str, numbers[:50]))
