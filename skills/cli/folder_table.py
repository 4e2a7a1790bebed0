"""`skills recording table`: what is understood of each recording in a folder, or why it is refused, as Markdown.

What a recording does not say itself is stated in a TOML file: a table for each name or pattern below the folder, with
the options of `skills recording preview` and the source of the recordings:

    ["calibration/*_fixed.csv"]
    source = "a public calibration"
    rate_hz = 100
"""

import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skills.cli.recordings import count_dropped, ready_one
from skills.cli.shell import AsJson, first_sentence, print_json, refusing, service
from skills.errors import BadInput, SkillsError

if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.given import RecordingPreview

COLUMNS = {
    "name": "recording", "source": "source", "stated": "stated", "format": "format", "samples": "samples",
    "understood": "understood", "refused": "refused because",
}  # fmt: skip

Row = dict[str, str]

commands = typer.Typer()


@commands.command("table")
@refusing
def recording_table(
    folder: Annotated[Path, typer.Argument(help="A folder with recordings, at any depth.", file_okay=False)],
    stated: Annotated[
        Path | None, typer.Option(help="A TOML file with what the recordings do not say (docs/recordings.md).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what would be understood of each recording in a folder, and why others are refused; nothing is stored."""
    statements = {} if stated is None else _statements(stated)
    rows: list[Row] = []
    with service() as client:
        for path in _recordings_in(folder):
            name = path.relative_to(folder).as_posix()
            said = next((one for pattern, one in statements.items() if fnmatch(name, pattern)), {})
            rows += _rows(client, path, name, said)
    if as_json:
        print_json(rows)
        return
    for line in (list(COLUMNS.values()), ["---"] * len(COLUMNS), *([row[one] for one in COLUMNS] for row in rows)):
        print("|", " | ".join(cell.replace("|", "\\|") for cell in line), "|")


def _statements(path: Path) -> dict[str, dict[str, Any]]:
    """Read the statements about recordings, by name or pattern.

    Raises:
        BadInput: It is not TOML, or states something that a preview does not take.
    """
    from pydantic import ValidationError

    from skills.schemas.requests import StatedIn

    try:
        said = tomllib.loads(path.read_text())
        return {name: StatedIn.model_validate(one).model_dump(exclude_none=True) for name, one in said.items()}
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{path} is not TOML: {error}.") from error
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, fault["loc"]))
        raise BadInput(f"{path}: {where}: {fault['msg']}; {', '.join(StatedIn.model_fields)} can be stated.") from error


def _recordings_in(folder: Path) -> Iterator[Path]:
    """Yield the files with the suffix of a recording, and bag folders and LeRobot datasets, each as one, by name."""
    from skills.formats import SUFFIXES
    from skills.formats.bag_folder import METADATA
    from skills.formats.lerobot import INFO

    for path in sorted(folder.iterdir()):
        if path.is_dir() and not ((path / METADATA).is_file() or (path / INFO).is_file()):
            yield from _recordings_in(path)
        elif path.is_dir() or path.suffix.lower() in SUFFIXES.values():
            yield path


def _rows(client: "Client", path: Path, name: str, said: dict[str, Any]) -> Iterator[Row]:
    """Yield the row of a recording, or one for each episode of a dataset."""
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    options = {option: one for option, one in said.items() if option != "source"}
    row = dict.fromkeys(COLUMNS, "") | {
        "name": name,
        "source": said.get("source", ""),
        "stated": " ".join(f"`{word}`" for word in _words(options)),
    }
    try:
        with find_dataset(path) as dataset:
            episodes = [] if dataset is None else choose_episodes(dataset, options.get("episode", "all"))
    except SkillsError as error:
        yield row | {"format": path.suffix[1:], "refused": first_sentence(error)}
        return
    if dataset is None:
        yield row | _understood(client, path, options)
    for one in episodes:
        label = {"name": f"{name}, episode {one.number}"}
        yield row | label | _understood(client, path, options | {"episode": str(one.number)})


def _words(options: dict[str, Any]) -> Iterator[str]:
    for option, given in options.items():
        for one in given if isinstance(given, list) else [given]:
            yield f"--{option.replace('_', '-')} {one:g}" if isinstance(one, float) else f"--{option} {one}"


def _understood(client: "Client", path: Path, options: dict[str, Any]) -> Row:
    how = {option: one for option, one in options.items() if option not in ("episode", "column", "tool")}
    try:
        with ready_one(path, options.get("episode"), options.get("column"), options.get("tool")) as (file, _, columns):
            seen = client.preview_recording(file, column=columns, **how)
    except SkillsError as error:
        return {"format": path.suffix[1:], "refused": first_sentence(error)}
    samples = dict.fromkeys(str(motion.samples) for motion in seen.motions)
    return {"format": seen.format, "samples": ", ".join(samples), "understood": "; ".join(_facts(seen))}


def _facts(seen: "RecordingPreview") -> Iterator[str]:
    """Yield arms, frames and rates, what the joints show, and what was dropped, repeated or left out."""
    for motion, quality in zip(seen.motions, seen.quality, strict=True):
        rate = "without times" if quality.rate_hz is None else f"at {quality.rate_hz:.1f} Hz"
        yield f"{motion.arm} in {motion.frame} {rate}"
    for one in seen.identifications:
        found = one.found
        if found.verdict == "identified":
            fit = f"{found.residual_mm:.3f} mm RMS, {found.greatest_mm:.3f} mm at most"
            yield f"{one.arm} in {one.frame} is a {found.generation} with {found.instrument}: {fit}"
        else:
            yield f"{one.arm} in {one.frame}, {found.verdict}: {found.reason}"
    yield from count_dropped(seen)
    if "last row" in seen.notes:
        yield f"last row: {seen.notes['last row']}"
    if seen.left_out:
        yield f"left out: {', '.join(one.topic for one in seen.left_out)}"
