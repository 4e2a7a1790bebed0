"""The command that exports demonstrations as a dataset."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.recordings import DatasetColumns, Tool, pairs
from skills.cli.shell import (
    AsJson,
    bar,
    complete_surgeons,
    complete_sutures,
    finished,
    out,
    print_json,
    refusing,
    result_of,
    service,
)
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.client import Client
    from skills.formats.lerobot.videos import Source

commands = typer.Typer()


@commands.command("export-dataset")
@refusing
def export_dataset(
    to: Annotated[Path, typer.Argument(metavar="OUT", help="A new folder, or a new file that ends in .zip.")],
    surgeon: Annotated[
        list[str] | None,
        typer.Option(help="Only of this surgeon; repeatable.", autocompletion=complete_surgeons),
    ] = None,
    suture: Annotated[
        list[str] | None,
        typer.Option(help="Only of this suture type; repeatable.", autocompletion=complete_sutures),
    ] = None,
    demo: Annotated[list[str] | None, typer.Option(help="This demonstration, by its digest; repeatable.")] = None,
    outcomes: Annotated[
        Literal["success", "any"],
        typer.Option(help="any: with those marked recovery or failure, in splits of these names."),
    ] = "success",
    whole: Annotated[
        bool, typer.Option("--whole", help="Whole recordings, where all surgeons in them consent.")
    ] = False,
    version: Annotated[Literal["v2.1", "v3.0"], typer.Option(help="The version of LeRobot's format.")] = "v2.1",
    fps: Annotated[int, typer.Option(help="Frames per second, at most the rate of the recordings.")] = 30,
    split: Annotated[
        Literal["surgeon", "session"], typer.Option(help="Keep a surgeon, or a recording, in one split.")
    ] = "surgeon",
    arm: Annotated[
        list[str] | None, typer.Option(help="This arm, such as PSM1; repeatable. By default all common ones.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The dataset's title.")] = None,
    licence: Annotated[str | None, typer.Option(help="Its licence, such as CC-BY-4.0.")] = None,
    description: Annotated[str | None, typer.Option(help="What it contains.")] = None,
    procedure: Annotated[str | None, typer.Option(help="How it was collected.")] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            help="Add the videos of this LeRobot dataset of yours, from which the recordings were uploaded; "
            "repeatable, with --whole. They stay on this machine."
        ),
    ] = None,
    pictures_consented: Annotated[
        bool,
        typer.Option(
            "--pictures-consented",
            help="Declare that everyone in the videos consented to passing them on: the service knows no such consent.",
        ),
    ] = False,
    column: DatasetColumns = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> None:
    """Export demonstrations as a LeRobot dataset, and verify it; the consent to export is required."""
    from skills.formats.lerobot.manifest import refuse_existing

    refuse_existing(to)
    sources: dict[str, Source] = {}
    if videos:
        _refuse_videos(to, whole=whole, consented=pictures_consented)
        from skills.formats.lerobot.videos import find_recorded

        sources = find_recorded(videos, fps, columns=pairs("--column", column), tools=pairs("--tool", tool))
    elif pictures_consented or column or tool:
        raise BadInput("--pictures-consented, --column and --tool are about --videos; name the folder of the videos.")
    with service(workers=1) as client:
        job = client.export_dataset(
            demos=demo,
            surgeons=surgeon,
            sutures=suture,
            outcomes=outcomes,
            whole=whole,
            version=version,
            fps=fps,
            split=split,
            arms=arm,
            name=name,
            licence=licence,
            description=description,
            procedure=procedure,
        )
        result = result_of(finished(client, job))
        if videos:
            _save_with_videos(client, result["dataset"], to, sources, version)
        else:
            with bar("fetching") as progress:
                client.save_dataset(result["dataset"], to, progress)
    if as_json:
        print_json({"file": to, **result})
        return
    out.print(f"{result['dataset']}  episodes: {result['episodes']}, frames: {result['frames']}")
    out.print(f"{to}: every file is verified against SHA256SUMS. Research use only.", soft_wrap=True)
    if videos:
        out.print("It has videos. Its README says that you declared the consent of everyone in them.", soft_wrap=True)


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
    client: "Client", dataset: str, to: Path, sources: Mapping[str, "Source"], version: Literal["v2.1", "v3.0"]
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
