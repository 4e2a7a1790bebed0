"""The file that a command uploads for a path: a recording, a bag folder, or an episode of a LeRobot dataset."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.output import bar
from skills.errors import BadInput
from skills.keywords import TableKeywords

if TYPE_CHECKING:
    from skills.client import Progress
    from skills.formats.lerobot import Dataset
    from skills.formats.lerobot.cut import Episode

RecordingPath = Annotated[
    Path,
    typer.Argument(
        help="A recording, a bag folder, a session's folder with one, or a LeRobot dataset; pictures are not sent."
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        help="A column under another name, of a table as x_mm=PosX (docs/tables.md), of a LeRobot dataset as "
        "psm1_jaw=THEIRS[7]; repeatable.",
    ),
]
OneEpisode = Annotated[
    str | None, typer.Option(help="The episode of a LeRobot dataset, by its number; needed if it has several.")
]
Tool = Annotated[
    list[str] | None,
    typer.Option(help="The instrument of an arm in a LeRobot dataset, such as PSM1=400006; repeatable."),
]


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for a path, and the callback for its progress; a bag folder becomes one file."""
    from skills.formats.upload import find_bag, prepare_upload

    bag = find_bag(path)
    for name in bag.left_aside:
        typer.echo(f"{name} has no tags of a recorder: left aside.", err=True)
    read = 0
    with bar("reading") as reading:

        def advance(count: int) -> None:
            nonlocal read
            read += count
            reading(read, bag.size_bytes)

        with prepare_upload(bag, advance) as file, bar("sending") as sending:
            yield file, sending


@contextmanager
def ready_episode(
    dataset: "Dataset", episode: "Episode", column: Sequence[str] | None, tool: Sequence[str] | None
) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for an episode of a LeRobot dataset, and the callback for its progress."""
    from skills.formats.lerobot.cut import cut_episode

    with TemporaryDirectory() as folder, bar("sending") as sending:
        file = Path(folder) / "episode.zip"
        with file.open("wb") as out:
            columns, tools = pairs("--column", column), pairs("--tool", tool)
            cut_episode(dataset, episode, out, columns=columns, tools=tools)
        yield file, sending


@contextmanager
def ready_one(
    path: Path, table: TableKeywords, episode: str | None, tool: Sequence[str] | None
) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for a recording, or for one episode of a dataset, and the callback for its progress.

    In the file of an episode the columns are mapped already, so they are removed from `table`.
    """
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    with find_dataset(path) as dataset:
        if dataset is None:
            if episode or tool:
                raise refused_of_dataset(path)
            with ready(path) as sent:
                yield sent
            return
        if episode == "all":
            raise BadInput("Name one episode: a demonstration is of one.")
        column = table.pop("column", None)
        with ready_episode(dataset, choose_episodes(dataset, episode)[0], column, tool) as sent:
            yield sent


def refused_of_dataset(path: Path) -> BadInput:
    """Return the error that options are about a LeRobot dataset, for another recording."""
    return BadInput(f"{path} is no LeRobot dataset; --episode and --tool are about one.")


def pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Return the two names of each statement of an option such as --tool."""
    pairs = [one.partition("=") for one in given or ()]
    wrong = next((one for one in pairs if not (one[0] and one[2])), None)
    if wrong is not None:
        raise BadInput(f"{option} takes two names with = between them, not {''.join(wrong)!r}.")
    return {ours: theirs for ours, _, theirs in pairs}
