"""LeRobot datasets of a dVRK, v2.1 and v3.0: their metadata, and reading, cutting and writing them.

    folder or zip --find_dataset--> Dataset --cut_episode--> zip of one episode --read_episode--> Recording

One episode is one recording: a reader refuses several, so that the stored bytes of a recording belong to one surgeon.

    meta/info.json           the version, the rate `fps`, and the features: their types, lengths and names of numbers
    meta/episodes.jsonl      v2.1: the number of frames of each episode, which must be that of its rows
    meta/tasks.jsonl         the tasks; in v3.0 `tasks.parquet`
    meta/suture-skills.json  ours, optional: `columns` under other names, and `tools` and `frames` of arms
    data/**/*.parquet        v2.1: one file per episode; v3.0: files of many episodes
    videos/, images          not used

Paths in `info.json` (`data_path`) are never used: files are found by their own names.
"""

import json
import re
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import PurePosixPath
from typing import Annotated, Any, BinaryIO, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from skills.errors import BadColumns, UnreadableRecording
from skills.formats.archive import printable, shown
from skills.formats.lerobot.parquet import ParquetColumn, open_parquet, read_rows

INFO, STATEMENTS, EPISODE_LINES = "meta/info.json", "meta/suture-skills.json", "meta/episodes.jsonl"
TASK_LINES, TASK_TABLE = "meta/tasks.jsonl", "meta/tasks.parquet"
VERSIONS = ("v2.0", "v2.1", "v3.0")
JSON_CHARACTERS = 4 << 20  # the metadata of 100 features have 20,000
NUMBERS = 5000  # of all features together
TASKS, EPISODES = 10_000, 100_000
FASTEST_HZ = 10_000.0

_SPAN = re.compile(r"(\d{1,9}):(\d{1,9})")

Json = dict[str, Any]


class Files(Protocol):
    """Files by name, such as those of an `Archive` or of a folder."""

    @property
    def names(self) -> list[str]:
        """The names, with forward slashes."""

    def text(self, name: str) -> str:
        """Return a file as text."""

    def unpacked(self, name: str) -> AbstractContextManager[BinaryIO]:
        """Open a file."""


class Statements(BaseModel):
    """The contents of our own file, which states what a dataset does not.

    Attributes:
        columns: Our names of columns, and the dataset's.
        tools: Arms, and the numbers of their instruments.
        frames: Arms, and the frames of their poses.
        cut_from: The version of the dataset from which an episode was cut, where it was another one.
    """

    model_config = ConfigDict(extra="allow")

    columns: Annotated[dict[str, str], Field(max_length=NUMBERS)] = {}
    tools: Annotated[dict[str, str], Field(max_length=NUMBERS)] = {}
    frames: dict[str, Annotated[str, Field(pattern=r"^[A-Za-z0-9_./-]{1,64}$")]] = {}
    cut_from: str | None = None


@dataclass(frozen=True)
class Feature:
    """A feature: numbers or texts of every frame.

    Attributes:
        name: Such as "observation.state".
        dtype: The type of its values: "float32", "string", "video".
        width: The number of its values in a frame.
        names: Their names; () where the dataset names none.
    """

    name: str
    dtype: str
    width: int
    names: tuple[str, ...] = ()

    @property
    def is_text(self) -> bool:
        """Whether its values are texts."""
        return self.dtype in ("string", "text")

    @property
    def is_picture(self) -> bool:
        """Whether its values are pictures."""
        return self.dtype in ("image", "video")

    @property
    def column(self) -> ParquetColumn:
        """Its column in the data."""
        return ParquetColumn(self.name, self.width, self.is_text)

    def called(self, index: int) -> list[str]:
        """Return the names by which one of its values can be meant, its own first."""
        own = [self.names[index], f"{self.name}.{self.names[index]}"] if self.names else []
        return [*own, *([self.name] if self.width == 1 else []), f"{self.name}[{index}]"]


@dataclass(frozen=True, eq=False)
class Dataset:
    """The metadata of a dataset, and its files; `root` is the prefix of their names."""

    files: Files
    root: str
    info: Json
    features: tuple[Feature, ...]
    fps: float

    @property
    def version(self) -> str:
        """The version of the format, such as "v2.1"."""
        return str(self.info["codebase_version"])

    @property
    def data(self) -> list[str]:
        """The names of the files with data, sorted."""
        return self.parquets("data/")

    @cached_property
    def statements(self) -> Statements:
        """The contents of our own file; empty without one.

        Raises:
            BadColumns: A statement has another form.
        """
        name = self.root + STATEMENTS
        try:
            return Statements.model_validate(_object(self.files, name) if name in self.files.names else {})
        except ValidationError as error:
            field = printable(".".join(map(str, error.errors()[0]["loc"])))
            raise BadColumns(f"`{field}` in {STATEMENTS} is not an object of our names and the dataset's.") from error

    @cached_property
    def tasks(self) -> dict[int, str]:
        """The tasks by number; empty where the dataset has no file of them."""
        lines, table = self.root + TASK_LINES, self.root + TASK_TABLE
        if lines in self.files.names:
            return {one["task_index"]: one["task"] for one in self.lines(lines) if _is_task(one)}
        if table in self.files.names:
            with self.files.unpacked(table) as file:
                return _tasks_in(file)
        return {}

    def splits_of(self, episode: int) -> list[str]:
        """Return the names of the splits, such as "train" or "recovery", that an episode is in."""
        splits = self.info.get("splits")
        found = [
            name[:20]
            for name, span in (splits.items() if isinstance(splits, dict) else ())
            if isinstance(span, str) and (ends := _SPAN.fullmatch(span)) and int(ends[1]) <= episode < int(ends[2])
        ]
        return found[:10]

    def parquets(self, folder: str) -> list[str]:
        """Return the names of the Parquet files below a folder, sorted."""
        names = (name for name in self.files.names if name.startswith(self.root + folder))
        return sorted(name for name in names if name.endswith(".parquet") and not is_shadow(name))

    def check_length(self, episode: int | None, rows: int) -> None:
        """Compare the rows of an episode with what the metadata claim of it.

        Raises:
            UnreadableRecording: `total_frames` of a dataset of one episode, or its line in v2.1, has another number.
        """
        claims = [(INFO, self.info.get("total_frames"))] if self.info.get("total_episodes") == 1 else []
        if (name := self.root + EPISODE_LINES) in self.files.names:
            lines = self.lines(name, most=EPISODES)
            claims += [(EPISODE_LINES, one.get("length")) for one in lines if one.get("episode_index") == episode]
        for where, claimed in claims:
            if claimed != rows:
                raise UnreadableRecording(
                    f"{where} claims {printable(claimed)} frames, and the episode has {rows}: one of them is "
                    "incomplete. Copy the dataset again.",
                    found=rows,
                )

    def lines(self, name: str, *, most: int = TASKS) -> list[Json]:
        """Return the objects of a file with one per line.

        Raises:
            UnreadableRecording: A line is not JSON, or there are too many.
        """
        lines = [line for line in self.files.text(name).splitlines() if line.strip()]
        if len(lines) > most:
            raise UnreadableRecording(f"{shown(name)} of the dataset has more than {most} lines.")
        return [one for line in lines if isinstance(one := _parsed(line, name), dict)]


def root_of(names: Iterable[str]) -> str | None:
    """Return the folder of the dataset among some files, as a prefix of their names; None if there is none.

    Raises:
        UnreadableRecording: There are several.
    """
    roots = [name.removesuffix(INFO) for name in names if f"/{name}".endswith(f"/{INFO}") and not is_shadow(name)]
    if len(roots) > 1:
        raise UnreadableRecording(f"There are {len(roots)} datasets, each with its {INFO}; send one of them.")
    return roots[0] if roots else None


def read_dataset(files: Files, root: str) -> Dataset:
    """Read the metadata of a dataset.

    Args:
        files: Its files.
        root: From `root_of`.

    Raises:
        UnreadableRecording: They are not those of a LeRobot dataset, or of a version that is not read.
    """
    info = _object(files, root + INFO)
    version, fps, features = info.get("codebase_version"), info.get("fps"), info.get("features")
    if version not in VERSIONS:
        raise UnreadableRecording(
            f"The codebase_version of the dataset is {printable(version)!r}; {', '.join(VERSIONS)} are read. Convert "
            "it with LeRobot."
        )
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps <= FASTEST_HZ:
        raise UnreadableRecording(f"The fps of the dataset is {printable(fps)!r}; give a rate, up to {FASTEST_HZ:g}.")
    if not isinstance(features, dict):
        raise UnreadableRecording(f"{INFO} has no features.")
    read = tuple(_feature(name, one) for name, one in features.items())
    if sum(one.width for one in read) > NUMBERS:
        raise UnreadableRecording(f"The features in {INFO} have more than {NUMBERS} numbers in a frame.")
    return Dataset(files, root, info, read, float(fps))


def _feature(name: str, described: Any) -> Feature:
    """Return a feature from its description in info.json.

    Raises:
        UnreadableRecording: It has no type, no plausible shape, or not as many names as numbers.
    """
    try:
        dtype, shape, names = str(described["dtype"]), described["shape"], described.get("names")
        if dtype in ("image", "video"):
            return Feature(name, dtype, 1)
        width = prod(int(side) for side in shape)
        names = _listed(names) if isinstance(names, dict) else names
        # some datasets have a list of one list of names
        names = names[0] if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list) else names
        flat = tuple(names) if isinstance(names, list) else ()
        if not 1 <= width <= NUMBERS or not all(isinstance(one, str) for one in flat) or len(flat) not in (0, width):
            raise ValueError(name)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UnreadableRecording(
            f"The feature {printable(name)!r} in {INFO} has no dtype, no shape of up to {NUMBERS} numbers, or not as "
            "many names as numbers."
        ) from error
    return Feature(name, dtype, width, flat)


def _listed(names: Json) -> Any:
    """Return names under words such as "motors", group after group; or those that have their indices as values."""
    if all(isinstance(one, list) for one in names.values()):
        return [name for group in names.values() for name in group]
    if sorted(names.values()) == list(range(len(names))):
        return sorted(names, key=names.__getitem__)
    return next(iter(names.values())) if len(names) == 1 else names


def _tasks_in(file: BinaryIO) -> dict[int, str]:
    """Read the tasks of v3.0: numbers and texts, where the texts may be an index of pandas.

    Raises:
        UnreadableRecording: They are missing, or too many.
    """
    names = open_parquet(file).schema_arrow.names
    text = "task" if "task" in names else "__index_level_0__"
    rows = read_rows(file, ["task_index", text], most_rows=TASKS)
    return {row["task_index"]: row[text] for row in rows if _is_task({**row, "task": row[text]})}


def _object(files: Files, name: str) -> Json:
    """Return a file that is a JSON object; any other raises `UnreadableRecording`."""
    parsed = _parsed(files.text(name), name)
    if not isinstance(parsed, dict):
        raise UnreadableRecording(f"{shown(name)} of the dataset is not a JSON object.")
    return parsed


def _parsed(text: str, name: str) -> Any:
    """Return JSON of limited length; any other text raises `UnreadableRecording`."""
    if len(text) > JSON_CHARACTERS:
        raise UnreadableRecording(f"{shown(name)} of the dataset has more than {JSON_CHARACTERS} characters.")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UnreadableRecording(f"{shown(name)} of the dataset is not valid JSON. Copy it again.") from error


def _is_task(line: Json) -> bool:
    return isinstance(line.get("task_index"), int) and isinstance(line.get("task"), str)


def is_shadow(name: str) -> bool:
    """Return whether a file holds only macOS metadata of another file."""
    path = PurePosixPath(name)
    return path.name.startswith("._") or "__MACOSX" in path.parts
