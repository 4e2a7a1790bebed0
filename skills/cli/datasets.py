"""The command that exports demonstrations as a dataset."""

from pathlib import Path
from typing import Annotated, Literal

import typer

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
    as_json: AsJson = False,
) -> None:
    """Export demonstrations as a LeRobot dataset, and verify it; the consent to export is required."""
    from skills.formats.lerobot.manifest import refuse_existing

    refuse_existing(to)
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
        with bar("fetching") as progress:
            client.save_dataset(result["dataset"], to, progress)
    if as_json:
        print_json({"file": to, **result})
        return
    out.print(f"{result['dataset']}  episodes: {result['episodes']}, frames: {result['frames']}")
    out.print(f"{to}: every file is verified against SHA256SUMS. Research use only.", soft_wrap=True)
