"""Writer of LeRobot datasets, v2.1 and v3.0, from recordings of one arm or several.

    ExportedEpisode ... --dataset_files--> names and files, in the order in which they are finished

Each episode is sampled at `fps` from the first time at which every arm and jaw is known to the last: for each frame the
recorded sample that is nearest in time, never an interpolated one, and of an interval never one outside it. So a
recording made at this rate is written as it is. `observation.state` has for each arm the names of Open-H,
`psmN_pose.position.x` ... and `psmN_jaw`, in m and rad; `action` has, as `AboutDataset.action` says, either

    next state   the next frame's state (the last one is repeated), under the state's names
    setpoint     the setpoints nearest in time, in the frames of the state: `psmN_sp.position.x` ... and `psmN_jaw_sp`

The frames of the poses and the rule of the action are in `meta/suture-skills.json`, which our reader reads. Kinematics
only, so `videos/` is empty; `skills.formats.lerobot.videos` adds videos of the user's own.

Memory does not grow with the number of frames: files are temporary ones, and statistics are summed. Statistics are
those of all values; quantiles of the dataset are the means of the episodes', weighted by frames, as LeRobot computes
them.
"""

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from tempfile import TemporaryFile
from typing import IO, Any, Literal, NamedTuple

import numpy as np
from jinja2 import Template
from numpy.typing import NDArray

from skills.arrays import Floats, Ints, nearest
from skills.demonstration.recording import Motion, Recording, Signal
from skills.errors import BadInput, MixedFrames, NoUsableTopic, UnreadableRecording
from skills.formats.checksums import SUMS, digest_of, write_sums
from skills.formats.columns import POSE_PARTS
from skills.formats.lerobot import INFO, STATEMENTS, TASK_LINES, TASK_TABLE, Json

Version = Literal["v2.1", "v3.0"]
ActionRule = Literal["next state", "setpoint"]
Split = Literal["train", "val", "test", "recovery", "failure"]
SPLITS: tuple[Split, ...] = ("train", "val", "test", "recovery", "failure")
SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}  # of the episodes; a surgeon is in one of them
CHUNK = 1000  # episodes or files in a folder
FILE_BYTES = 32 << 20  # of numbers in a data file of v3.0
FILE_EPISODES = 1000  # in it at most, for the places of their row groups are in memory until it ends
TABLE_ROWS = 100  # episodes that are written to the table of v3.0 together, since its columns are many
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
NO_PICTURES = "There are no pictures."  # in the README, where `skills.formats.lerobot.videos` names the cameras instead

_V21_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_V30_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_STAGE, _TASK, _TOOL = "observation.meta.stage", "instruction.text", "observation.meta.tool.{}"
_ACTIONS: dict[ActionRule, str] = {
    "next state": "`action` is the state of the next frame.",
    "setpoint": "`action` has the setpoints of these poses and jaws that are nearest in time, in the same frames.",
}

Singles = NDArray[np.float32]
Numbers = NDArray[Any]
Stats = dict[str, dict[str, list[float]]]


@dataclass(frozen=True, eq=False)
class ExportedEpisode:
    """One episode of a dataset.

    Attributes:
        recording: The recording.
        task: What is done in it, such as "simple interrupted suture".
        split: Its split; episodes are given in the order of `SPLITS`.
        start_ns: The first stamp that is used; None: the recording's first.
        end_ns: The last stamp that is used; None: the recording's last.
        source: What it is called in an error; by default its number.
    """

    recording: Recording
    task: str
    split: Split = "train"
    start_ns: int | None = None
    end_ns: int | None = None
    source: str | None = None


@dataclass(frozen=True)
class AboutDataset:
    """The description of a dataset, most of it for its README.

    Attributes:
        name: Its title.
        arms: The arms of every episode, in the order of the state, such as ("PSM1", "PSM2").
        fps: Frames per second.
        action: The rule of the action; `action_rule` returns the one that the episodes allow.
        licence: The licence, such as "CC-BY-4.0".
        consent: The consent under which it is passed on, as a sentence.
        description: What it contains, as sentences.
        procedure: How it was collected, as sentences.
        split_by: What is in one split only: a surgeon, or a session.
        export: The id of the job that writes it, which makes its bytes differ from those of other jobs.
    """

    name: str
    arms: tuple[str, ...]
    fps: int = 30
    action: ActionRule = "next state"
    licence: str = "unknown"
    consent: str = "Not stated."
    description: str = "Not stated."
    procedure: str = "Not stated."
    split_by: str = "surgeon"
    export: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= 1000 or not self.arms or len(set(self.arms)) < len(self.arms):
            raise BadInput("A dataset has 1 to 1000 frames per second, and arms, each once.", fps=self.fps)

    @property
    def names(self) -> list[str]:
        """The names of the state's numbers."""
        return [
            name
            for arm in map(str.lower, self.arms)
            for name in (*(f"{arm}_pose.{p}" for p in POSE_PARTS), f"{arm}_jaw")
        ]

    @property
    def action_names(self) -> list[str]:
        """The names of the action's numbers."""
        if self.action == "next state":
            return self.names
        return [name.replace("_pose.", "_sp.").replace("_jaw", "_jaw_sp") for name in self.names]


def action_rule(episodes: Iterable[ExportedEpisode], about: AboutDataset) -> ActionRule:
    """Return "setpoint" if every episode has setpoints of every arm at every frame, and otherwise "next state".

    Args:
        episodes: Those of the dataset; each is used once, and not kept, and none after the first without setpoints.
        about: Its description, of which the arms and the rate are used.

    Raises:
        NoUsableTopic, UnreadableRecording: An episode cannot be written, whatever its actions are.
    """
    total = _Total(replace(about, action="next state"))
    for episode in episodes:
        _, times_ns = total.sampled(episode)
        try:
            total.commanded(episode, times_ns)
        except (NoUsableTopic, UnreadableRecording):
            return "next state"
    return "setpoint"


def dataset_files(
    episodes: Iterable[ExportedEpisode], about: AboutDataset, version: Version = "v2.1"
) -> Iterator[tuple[str, IO[bytes]]]:
    """Write a dataset.

    Args:
        episodes: In the order of their splits; each is used once, and not kept.
        about: The description.
        version: The version of the format.

    Yields:
        The name and the content of each file, at its beginning, which is valid until the next one. The manifest of the
        SHA-256 of all others is the last.

    Raises:
        BadInput: There are no episodes, or not in the order of their splits.
        NoUsableTopic: An episode lacks an arm, its orientation or its jaw, or these have no time in common; or
            setpoints, if these are the actions.
        MixedFrames: An arm's poses are in another frame than in the episodes before.
        UnreadableRecording: An arm has no sample within one frame of a frame's time.
    """
    seen: dict[str, str] = {}
    for name, file in _files(episodes, about, version):
        file.seek(0)
        seen[name] = digest_of(file)
        file.seek(0)
        yield name, file
    yield SUMS, io.BytesIO(write_sums(seen))


def _files(
    episodes: Iterable[ExportedEpisode], about: AboutDataset, version: Version
) -> Iterator[tuple[str, IO[bytes]]]:
    """Yield the files of a dataset, without its manifest."""
    total = _Total(about)
    with TemporaryFile() as first, TemporaryFile() as second:
        store = _SingleFiles(first, second) if version == "v2.1" else _SharedFiles(first, second)
        for episode in episodes:
            added = total.take(episode)
            yield from store.write(added)
        if not total.episodes:
            raise BadInput("There are no episodes to write.")
        yield from store.finish(total)
    yield INFO, io.BytesIO(as_json(total.info(version)))
    export = {} if about.export is None else {"export": about.export}
    yield STATEMENTS, io.BytesIO(as_json({"action": about.action, "frames": total.frames, **export}))
    yield "meta/README.md", io.BytesIO(_readme(about, total).encode())
    yield "videos/.keep", io.BytesIO()


@dataclass(frozen=True, eq=False)
class _EpisodeColumns:
    """An episode as columns, with its statistics."""

    number: int
    task: str
    first: int  # frames of all episodes before it
    columns: dict[str, Numbers | list[str]]
    stats: Stats

    @property
    def rows(self) -> int:
        return len(self.columns["frame_index"])


@dataclass
class _Total:
    """The episodes so far: their numbers, tasks, frames of poses, splits and statistics."""

    about: AboutDataset
    episodes: int = 0
    rows: int = 0
    tasks: dict[str, int] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)
    splits: dict[Split, list[int]] = field(default_factory=dict)
    widths: dict[str, int] = field(default_factory=dict)  # of the columns with statistics, in their order
    numbers: dict[str, list[float]] = field(default_factory=dict)  # the statistics of all columns, one after another

    def take(self, episode: ExportedEpisode) -> _EpisodeColumns:
        """Return an episode as columns, and add it."""
        self._add_to_split(episode.split)
        state, stamps_ns = self.sampled(episode)
        following = np.concatenate([state[1:], state[-1:]])
        rows, number = len(state), self.episodes
        task = self.tasks.setdefault(episode.task, len(self.tasks))
        tools = dict(episode.recording.tools)
        columns: dict[str, Numbers | list[str]] = {
            "observation.state": state,
            "action": following if self.about.action == "next state" else self.commanded(episode, stamps_ns),
            **{_TOOL.format(arm.lower()): [tools.get(arm, "")] * rows for arm in self.about.arms},
            _STAGE: _stages(episode.recording, stamps_ns),
            _TASK: [episode.task] * rows,
            "timestamp": (np.arange(rows) / self.about.fps).astype(np.float32),
            "frame_index": np.arange(rows),
            "episode_index": np.full(rows, number),
            "index": np.arange(self.rows, self.rows + rows),
            "task_index": np.full(rows, task),
        }
        wide = {name: one.reshape(rows, -1) for name, one in columns.items() if not isinstance(one, list)}
        numbers = _stats_of(np.concatenate([*wide.values()], axis=1, dtype=np.float64))
        self.widths = {name: one.shape[1] for name, one in wide.items()}
        self.numbers = joined_stats(self.numbers, numbers) if number else numbers
        added = _EpisodeColumns(number, episode.task, self.rows, columns, _by_column(numbers, self.widths))
        self.episodes, self.rows = number + 1, self.rows + rows
        return added

    def _add_to_split(self, split: Split) -> None:
        """Count an episode in its split; raises `BadInput` if the splits are not in order."""
        if any(SPLITS.index(before) > SPLITS.index(split) for before in self.splits):
            raise BadInput(f"Give the episodes in the order of their splits: {', '.join(SPLITS)}.", split=split)
        self.splits.setdefault(split, [self.episodes, self.episodes])[1] += 1

    def sampled(self, episode: ExportedEpisode) -> tuple[Singles, Ints]:
        """Return the state at each frame, shape (T, 8 per arm), and the frames' times, shape (T,)."""
        series = [part.within(episode) for arm in self.about.arms for part in self._arm(episode, arm)]
        if not all(len(one.stamps_ns) for one in series) or (
            (start := max(int(one.stamps_ns[0]) for one in series))
            > (end := min(int(one.stamps_ns[-1]) for one in series))
        ):
            raise NoUsableTopic(f"The arms and jaws of {self._name(episode)} have no time in common; leave it out.")
        period_ns = 1e9 / self.about.fps
        count = int(np.floor((end - start) / period_ns + 1e-6)) + 1  # stamps are rounded to nanoseconds
        times_ns = start + np.rint(np.arange(count) * period_ns).astype(np.int64)
        return self._numbers(series, episode, times_ns), times_ns

    def commanded(self, episode: ExportedEpisode, times_ns: Ints) -> Singles:
        """Return the setpoints at some times, shape (T, 8 per arm), in the frames of the state.

        Raises:
            NoUsableTopic: An arm or its jaw has none in the episode's interval.
            UnreadableRecording: None is within one frame of a time.
        """
        recording, series = episode.recording, list[_Series]()
        for arm in self.about.arms:
            tip, jaw = recording.setpoint_of(recording.motion_of(arm=arm)), recording.jaw_setpoint_of(arm)
            found = () if tip is None or jaw is None else _series_of(tip, jaw)
            parts = [one.within(episode) for one in found]
            if not parts or not all(len(one.stamps_ns) for one in parts):
                raise NoUsableTopic(
                    f"{self._name(episode).capitalize()} has no setpoints of {arm} and its jaw in the frame of its "
                    "poses; leave it out, or write the next states as actions."
                )
            series += parts
        return self._numbers(series, episode, times_ns)

    def _numbers(self, series: "list[_Series]", episode: ExportedEpisode, times_ns: Ints) -> Singles:
        """Return the samples of series that are nearest to some times, side by side."""
        numbers = [one.at(times_ns, 1e9 / self.about.fps, self._name(episode)) for one in series]
        return np.concatenate(numbers, axis=1).astype(np.float32)

    def _arm(self, episode: ExportedEpisode, arm: str) -> "tuple[_Series, ...]":
        """Return an arm's poses and jaw, and note the frame of its poses."""
        recording, name = episode.recording, self._name(episode)
        motion, jaw = recording.motion_of(arm=arm), recording.jaw_of(arm)
        if motion.rotation_xyzw is None or jaw is None or not len(jaw.values):
            missing = "orientation" if motion.rotation_xyzw is None else "jaw"
            raise NoUsableTopic(f"{name[:1].upper()}{name[1:]} has no {missing} of {arm}; leave it out.")
        before = self.frames.setdefault(arm, motion.frame)
        if before != motion.frame:
            raise MixedFrames(
                f"{arm} is in the frame {motion.frame} in {name}, and in {before} in the episodes "
                "before; write a dataset for each frame."
            )
        return _series_of(motion, jaw)

    def _name(self, episode: ExportedEpisode) -> str:
        return f"episode {self.episodes}{'' if episode.source is None else f' ({episode.source})'}"

    def info(self, version: Version) -> Json:
        """Return the contents of info.json."""
        state = {"dtype": "float32", "shape": [len(self.about.names)], "names": [self.about.names]}
        texts = [*(_TOOL.format(arm.lower()) for arm in self.about.arms), _STAGE, _TASK]
        features: dict[str, Json] = {
            "observation.state": state,
            "action": state | {"names": [self.about.action_names]},
        }
        features |= {name: {"dtype": "string", "shape": [1], "names": ["value"]} for name in texts}
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        for name in ("frame_index", "episode_index", "index", "task_index"):
            features[name] = {"dtype": "int64", "shape": [1], "names": None}
        info = {
            "codebase_version": version,
            "robot_type": "dvrk",
            "total_episodes": self.episodes,
            "total_frames": self.rows,
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK,
            "fps": self.about.fps,
            "splits": {split: f"{first}:{end}" for split, (first, end) in self.splits.items()},
            "data_path": _V21_DATA if version == "v2.1" else _V30_DATA,
            "video_path": None,
            "features": features,
        }
        if version == "v2.1":
            return info | {"total_videos": 0, "total_chunks": -(-self.episodes // CHUNK)}
        info["features"] = {name: one | {"fps": self.about.fps} for name, one in features.items()}
        return info | {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}


class _Series(NamedTuple):
    """A recorded series: its topic, its stamps, and its values: tips in mm and rotations, or the jaw."""

    topic: str
    stamps_ns: Ints
    values: tuple[Floats, ...]

    def within(self, episode: ExportedEpisode) -> "_Series":
        """Return its samples in an episode's interval: no sample outside is written, however near it is."""
        start, end = episode.start_ns, episode.end_ns
        first = 0 if start is None else int(np.searchsorted(self.stamps_ns, start))
        last = None if end is None else int(np.searchsorted(self.stamps_ns, end, "right"))
        return _Series(self.topic, self.stamps_ns[first:last], tuple(one[first:last] for one in self.values))

    def at(self, times_ns: Ints, period_ns: float, episode: str) -> Floats:
        """Return the samples that are nearest to some times, lengths in m; shape (T, 7) or (T, 1)."""
        chosen = nearest(self.stamps_ns, times_ns)
        off_ns = np.abs(self.stamps_ns[chosen] - times_ns)
        if off_ns.max() > period_ns:
            worst = int(np.argmax(off_ns))
            raise UnreadableRecording(
                f"{self.topic} has no sample within one frame of {(times_ns[worst] - times_ns[0]) / 1e9:.3f} s in "
                f"{episode}; write the parts before and after the gap as two episodes.",
                gap_s=float(off_ns[worst]) / 1e9,
            )
        tips, *rest = (one[chosen] for one in self.values)
        return np.concatenate([tips / 1000.0, *rest], axis=1) if rest else tips


def _series_of(motion: Motion, jaw: Signal) -> tuple[_Series, ...]:
    """Return the poses and the jaw of an arm; nothing if the orientation is missing."""
    if motion.rotation_xyzw is None:
        return ()
    poses = _Series(motion.topic, motion.stamps_ns, (motion.tip_mm, motion.rotation_xyzw))
    return poses, _Series(jaw.topic, jaw.stamps_ns, (jaw.values[:, None],))


def _stages(recording: Recording, times_ns: Ints) -> list[str]:
    """Return the name of the stage or gesture at each time, "" where there is none; the later label counts."""
    names = np.full(len(times_ns), "", dtype=object)
    for label in recording.labels:
        names[np.searchsorted(times_ns, label.start_ns) : np.searchsorted(times_ns, label.end_ns, "right")] = label.name
    named: list[str] = names.tolist()
    return named


# ---- statistics ----------------------------------------------------------------------------------------------------


def _stats_of(values: Floats) -> dict[str, list[float]]:
    """Return the statistics of the numbers of all columns, shape (rows, numbers): together, because that is faster."""
    stats = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    quantiles = dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values()), axis=0), strict=True))
    return {name: one.tolist() for name, one in (stats | quantiles).items()} | {"count": [len(values)]}


def _by_column(numbers: Mapping[str, list[float]], widths: Mapping[str, int]) -> Stats:
    """Divide the statistics of all columns into those of each."""
    stats: Stats = {}
    at = 0
    for name, width in widths.items():
        of = {key: some if key == "count" else some[at : at + width] for key, some in numbers.items()}
        stats[name], at = of, at + width
    return stats


def joined_stats(one: Mapping[str, list[float]], other: Mapping[str, list[float]]) -> dict[str, list[float]]:
    """Return the statistics of two sets of rows from those of each; both have quantiles, or none."""
    n, m = one["count"][0], other["count"][0]
    a, b = ({name: np.array(values) for name, values in stats.items()} for stats in (one, other))
    joined = {"min": np.minimum(a["min"], b["min"]), "max": np.maximum(a["max"], b["max"])}
    joined |= {name: (n * a[name] + m * b[name]) / (n + m) for name in ("mean", *QUANTILES) if name in a}
    spread = n * (a["std"] ** 2 + (a["mean"] - joined["mean"]) ** 2)
    spread += m * (b["std"] ** 2 + (b["mean"] - joined["mean"]) ** 2)
    joined["std"] = np.sqrt(spread / (n + m))
    return {name: values.tolist() for name, values in joined.items()} | {"count": [n + m]}


# ---- files of each version -----------------------------------------------------------------------------------------


@dataclass
class _SingleFiles:
    """The files of v2.1: one of data per episode, and lines about the episodes, in two temporary files."""

    _episodes: IO[bytes]
    _stats: IO[bytes]

    def write(self, added: _EpisodeColumns) -> Iterator[tuple[str, IO[bytes]]]:
        """Yield the file of an episode."""
        from pyarrow import parquet

        with io.BytesIO() as file:
            parquet.write_table(_table(added), file)
            yield _V21_DATA.format(episode_chunk=added.number // CHUNK, episode_index=added.number), file
        about = {"episode_index": added.number, "tasks": [added.task], "length": added.rows}
        plain = {name: {key: one[key] for key in one if key not in QUANTILES} for name, one in added.stats.items()}
        self._episodes.write(as_line(about))
        self._stats.write(as_line({"episode_index": added.number, "stats": plain}))

    def finish(self, total: _Total) -> Iterator[tuple[str, IO[bytes]]]:
        """Yield the files about all episodes."""
        yield "meta/episodes.jsonl", self._episodes
        yield "meta/episodes_stats.jsonl", self._stats
        lines = (as_line({"task_index": number, "task": task}) for task, number in total.tasks.items())
        yield TASK_LINES, io.BytesIO(b"".join(lines))


@dataclass
class _SharedFiles:
    """The files of v3.0: data of many episodes in a file, each a row group, and a table of the episodes.

    Both are written in temporary files, that of the data again and again.
    """

    _data: IO[bytes]
    _table: IO[bytes]
    _writer: Any = None
    _table_writer: Any = None
    _waiting: list[Json] = field(default_factory=list)
    _file: int = 0
    _bytes: int = 0
    _episodes: int = 0

    def write(self, added: _EpisodeColumns) -> Iterator[tuple[str, IO[bytes]]]:
        """Add an episode; yield the data file that is full."""
        from pyarrow import parquet

        table = _table(added)
        full = self._bytes + table.nbytes > FILE_BYTES or self._episodes == FILE_EPISODES
        if self._writer is not None and full:
            yield from self._finished_file()
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self._data, table.schema)
        self._writer.write_table(table, row_group_size=max(1, added.rows))
        self._bytes, self._episodes = self._bytes + table.nbytes, self._episodes + 1
        place = {
            "episode_index": added.number,
            "tasks": [added.task],
            "length": added.rows,
            "data/chunk_index": self._file // CHUNK,
            "data/file_index": self._file % CHUNK,
            "dataset_from_index": added.first,
            "dataset_to_index": added.first + added.rows,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        stats = {f"stats/{name}/{key}": one for name, found in added.stats.items() for key, one in found.items()}
        self._waiting.append(place | stats)
        if len(self._waiting) == TABLE_ROWS:
            self._write_places()

    def finish(self, total: _Total) -> Iterator[tuple[str, IO[bytes]]]:
        """Yield the last data file, and the files about all episodes."""
        import pyarrow as pa
        from pyarrow import parquet

        yield from self._finished_file()
        self._write_places()
        self._table_writer.close()
        yield "meta/episodes/chunk-000/file-000.parquet", self._table
        numbers, texts = pa.array(list(total.tasks.values())), pa.array(list(total.tasks))
        tasks = pa.table({"task_index": numbers, "task": texts}).replace_schema_metadata({"pandas": _TASKS_FOR_PANDAS})
        with io.BytesIO() as file:
            parquet.write_table(tasks, file)
            yield TASK_TABLE, file
        yield "meta/stats.json", io.BytesIO(as_json(_by_column(total.numbers, total.widths)))

    def _finished_file(self) -> Iterator[tuple[str, IO[bytes]]]:
        """Close the present data file, yield it, and begin the next one."""
        self._writer.close()
        yield _V30_DATA.format(chunk_index=self._file // CHUNK, file_index=self._file % CHUNK), self._data
        self._data.seek(0)
        self._data.truncate()
        self._writer, self._file, self._bytes, self._episodes = None, self._file + 1, 0, 0

    def _write_places(self) -> None:
        """Write the waiting episodes to the table of places."""
        import pyarrow as pa
        from pyarrow import parquet

        if not self._waiting:
            return
        table = pa.Table.from_pylist(self._waiting, None if self._table_writer is None else self._table_writer.schema)
        if self._table_writer is None:
            self._table_writer = parquet.ParquetWriter(self._table, table.schema)
        self._table_writer.write_table(table)
        self._waiting = []


# LeRobot reads the tasks with pandas, whose index they are.
_TASKS_FOR_PANDAS = json.dumps(
    {
        "index_columns": ["task"],
        "column_indexes": [
            {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
        ],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
            {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
        ],
        "pandas_version": "2.0.0",
    }
)


def _table(added: _EpisodeColumns) -> Any:
    """Return an episode as pyarrow's table."""
    import pyarrow as pa

    arrays = {}
    for name, column in added.columns.items():
        if isinstance(column, np.ndarray) and column.ndim == 2:
            arrays[name] = pa.FixedSizeListArray.from_arrays(pa.array(column.ravel()), column.shape[1])
        else:
            arrays[name] = pa.array(column)
    return pa.table(arrays)


def as_json(value: object) -> bytes:
    """Return a value as the contents of a file, as LeRobot indents it."""
    return json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False).encode()


def as_line(value: object) -> bytes:
    """Return a value as a line of a file."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode() + b"\n"


def _readme(about: AboutDataset, total: _Total) -> str:
    """Return the README of a dataset, with the sections that Open-H asks for."""
    template = Template((files("skills.formats.lerobot") / "README.md.jinja").read_text(), autoescape=False)
    text = template.render(about=about, total=total, action=_ACTIONS[about.action], no_pictures=NO_PICTURES)
    return f"{text}\n"
