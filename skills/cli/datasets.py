"""The command that exports demonstrations as a LeRobot dataset, and adds the user's own videos to it."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.commands import command
from skills.cli.connecting import finished, service
from skills.cli.output import Answer, bar, text
from skills.cli.uploading import Tool, pairs
from skills.errors import BadInput
from skills.keywords import DatasetKeywords

if TYPE_CHECKING:
    from skills.client import Client
    from skills.formats.lerobot.videos import EpisodeSource

commands = typer.Typer()


@command(commands, "export-dataset")
def export_dataset(
    to: Annotated[Path, typer.Argument(metavar="OUT")],
    options: DatasetKeywords,
    videos: list[Path] | None = None,
    pictures_consented: bool = False,
    column: list[str] | None = None,
    tool: Tool = None,
) -> Answer:
    """Export demonstrations as a LeRobot dataset, and verify it; the consent to export is required.

    Args:
        to: A new folder, or a new file that ends in .zip.
        videos: Add the videos of this LeRobot dataset of yours, from which the recordings were uploaded; repeatable,
            with --whole. They stay on this machine.
        pictures_consented: Declare that everyone in the videos consented to passing them on: the service knows no such
            consent.
        column: A column under another name in a LeRobot dataset, as in the upload; repeatable.
    """
    from skills.formats.lerobot.manifest import refuse_existing
    from skills.schemas.results import DatasetResult

    refuse_existing(to)
    sources: Mapping[str, EpisodeSource] = {}
    if videos:
        _refuse_videos(to, whole=options.get("whole", False), consented=pictures_consented)
        from skills.formats.lerobot.videos import find_recorded

        fps = options.get("fps", 30)
        sources = find_recorded(videos, fps, columns=pairs("--column", column), tools=pairs("--tool", tool))
    elif pictures_consented or column or tool:
        raise BadInput("--pictures-consented, --column and --tool are about --videos; name the folder of the videos.")
    with service(workers=1) as client:
        result = DatasetResult.of(finished(client, client.export_dataset(**options)))
        if videos:
            _save_with_videos(client, result.dataset, to, sources, options.get("version", "v2.1"))
        else:
            with bar("fetching") as progress:
                client.save_dataset(result.dataset, to, progress)
    sentences = [
        f"{result.dataset}  episodes: {result.episodes}, frames: {result.frames}",
        f"{to}: every file is verified against SHA256SUMS. Research use only.",
    ]
    if videos:
        sentences.append("It has videos. Its README says that you declared the consent of everyone in them.")
    return text({"file": to, **result.model_dump()}, *sentences)


def _refuse_videos(to: Path, *, whole: bool, consented: bool) -> None:
    """Refuse an export with videos that is not possible, or not declared."""
    if not whole:
        raise BadInput(
            "A video is not cut at a hand-off, since it would have to be encoded again; with --videos, export whole "
            "recordings, with --whole."
        )
    if to.suffix == ".zip":
        raise BadInput("A dataset with videos is written to a folder; name one that does not end in .zip.")
    if not consented:
        raise BadInput(
            "Videos may show persons, and the consent that the service knows is not about pictures. If everyone in "
            "them agreed to passing them on, declare it with --pictures-consented."
        )


def _save_with_videos(
    client: "Client", dataset: str, to: Path, sources: Mapping[str, "EpisodeSource"], version: Literal["v2.1", "v3.0"]
) -> None:
    """Download a dataset and add its videos, in a folder beside `to` that is renamed when all is there."""
    from skills.formats.lerobot.manifest import refuse_existing
    from skills.formats.lerobot.videos import add_videos, choose_videos

    recordings = [one.recording for one in client.dataset_episodes(dataset).episodes]
    chosen = choose_videos(recordings, sources, version)
    with TemporaryDirectory(prefix=".dataset-", dir=to.parent) as folder:
        part = Path(folder) / to.name
        with bar("fetching") as progress:
            client.save_dataset(dataset, part, progress)
        add_videos(part, chosen)
        refuse_existing(to)
        part.rename(to)
