"""Scores against a style, and the calibration that rates them."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.completing import surgeons, sutures
from skills.cli.recordings import ready
from skills.cli.shell import AsJson, cell, err, out, print_json, refusing, service
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.api.schemas.given import Score
    from skills.client import Client

commands = typer.Typer()

DIGEST_LENGTH = 64


@commands.command()
@refusing
def score(
    what: Annotated[str, typer.Argument(help="A recording's file, which is stored; or a demonstration's digest.")],
    surgeon: Annotated[str, typer.Option(help="Whose style to score against.", autocompletion=surgeons)],
    suture: Annotated[str, typer.Option(help="The suture type.", autocompletion=sutures)],
    proposal: Annotated[int | None, typer.Option(help="Of a file, this proposed hand-off, counted from 1.")] = None,
    arm: Annotated[str | None, typer.Option(help="Of a file, this arm.")] = None,
    start_s: Annotated[float | None, typer.Option(help="Of a file, from here.")] = None,
    end_s: Annotated[float | None, typer.Option(help="Of a file, to here.")] = None,
    reference: Annotated[str | None, typer.Option(help="The demonstration of the style to compare with.")] = None,
    as_json: AsJson = False,
) -> None:
    """Score a motion against a style: how far from it, where, and beside whom. Not a credential."""
    with service() as client:
        if Path(what).exists():
            part = _part(client, Path(what), proposal, arm, start_s, end_s)
            scored = client.score(surgeon, suture, reference=reference, **part)
        elif len(what) != DIGEST_LENGTH or any(one is not None for one in (proposal, arm, start_s, end_s)):
            raise BadInput(
                f"There is no file {what}. Name a recording's file, or a demonstration by its digest and without "
                "--proposal, --arm, --start-s and --end-s."
            )
        else:
            scored = client.score(surgeon, suture, demo=what, reference=reference)
    if as_json:
        print_json(scored)
    else:
        _tell(scored)


def _part(
    client: "Client", path: Path, proposal: int | None, arm: str | None, start_s: float | None, end_s: float | None
) -> dict[str, Any]:
    """Store a recording, and say which part of it is to be scored: the one given, else the proposed hand-off."""
    with ready(path) as (file, progress):
        stored = client.add_recording(file, progress=progress)
    if proposal is None and (start_s, end_s) != (None, None):
        return {"recording": stored.sha256, "arm": arm, "start_s": start_s, "end_s": end_s}
    proposed = [part for part in stored.segments if arm in (None, part.arm)]
    number = proposal or 1
    if not 1 <= number <= len(proposed) or (proposal is None and len(proposed) > 1):
        raise BadInput(
            f"The recording has {len(proposed)} proposed hand-offs; choose one with --proposal, or give --start-s and "
            "--end-s."
        )
    part = proposed[number - 1]
    return {"recording": stored.sha256, "arm": part.arm, "start_s": part.start_s, "end_s": part.end_s}


def _tell(scored: "Score") -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    beside = [one for one in scored.percentiles if one.below]
    for name in ("", "value", "reference", "ratio", "", *(f"below {one.level}" for one in beside)):
        table.add_column(name)
    for one in scored.figures:
        below = [level.below.get(one.name) if level.below else None for level in beside]
        shares = ["" if share is None else f"{100 * share:.0f} %" for share in below]
        numbers = ["" if n is None else f"{n:.2f}" for n in (one.value, one.reference, one.ratio)]
        table.add_row(one.label, *numbers, one.unit, *shares)
    out.print(table)
    out.print(f"Beside {scored.reference.demo}: {scored.reference.because}.", soft_wrap=True)
    for sentence in (*scored.deviation.words, *scored.skill.words):
        out.print(sentence, markup=False, soft_wrap=True)
    out.print(scored.use, markup=False, soft_wrap=True)


@commands.command()
@refusing
def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(help="With TASK/kinematics/AllGestures/*.txt and TASK/meta_file_TASK.txt.", file_okay=False),
    ],
    task: Annotated[str | None, typer.Option(help="Such as Suturing; needed where there are several.")] = None,
    arm: Annotated[Literal["PSM_left", "PSM_right"] | None, typer.Option(help="Of this arm only.")] = None,
    of: Annotated[
        Literal["hand-off", "trial"], typer.Option(help="What is measured: each proposed hand-off, or a trial whole.")
    ] = "hand-off",
    seed: Annotated[int, typer.Option(help="Of the bootstrap and the permutations.", min=0)] = 0,
    permutations: Annotated[int, typer.Option(help="How often chance is tried.", min=20, max=10_000)] = 200,
    as_json: AsJson = False,
) -> None:
    """Learn to rate skill from a folder of rated trials, and keep the model: the newest is used by every score."""
    from skills.db.session import Database
    from skills.library.calibrations import calibrate_on, keep, read_cohort
    from skills.serving import prepare
    from skills.settings import settings

    prepare(settings())
    with err.status("reading") as status:
        rated = read_cohort(folder, task=task, arm=arm, of=of, told=lambda share: status.update(f"reading {share:.0%}"))
        about = calibrate_on(
            rated,
            seed=seed,
            permutations=permutations,
            told=lambda share: status.update(f"trying what chance does {share:.0%}"),
        )
    with closing(Database(settings().database_url)) as database, database.writing() as session:
        stored, _ = keep(session, about, "local")
    if as_json:
        print_json({"sha256": stored.sha256, **about})
    else:
        _tell_calibration(stored.sha256, about)


def _tell_calibration(digest: str, about: dict[str, Any]) -> None:
    from rich.table import Table

    from skills.style.scoring.figures import KIND_OF

    data, judged, model = about["data"], about["validated"], about["model"]
    levels = ", ".join(f"{count} {level}" for level, count in data["levels"].items())
    out.print(f"{digest}  {data['task']}, each {data['of']}", soft_wrap=True)
    out.print(f"{data['trials']} trials ({levels}) of {data['surgeons']} surgeons, {data['motions']} motions")
    if data["left_out"]:
        err.print(f"{data['left_out']} trials were left out: no {data['of']} in them could be measured.", style="red")
    table = Table(box=None, pad_edge=False)
    for name in ("a surgeon left out", "rho", "95 %", "level right", "95 %"):
        table.add_column(name)
    for name, row in (("all figures", judged["all_figures"]), ("duration only", judged["duration_only"])):
        table.add_row(name, f"{row['rho']:.2f}", _span(row["rho_interval"]), f"{100 * row['accuracy']:.0f} %",
                      _span(row["accuracy_interval"]))  # fmt: skip
    chance = judged["chance"]
    table.add_row("chance", f"{chance['rho']:.2f}", f"p = {chance['rho_p']:.3f}", f"{100 * chance['accuracy']:.0f} %",
                  f"p = {chance['accuracy_p']:.3f}")  # fmt: skip
    out.print(table)
    weights = Table(box=None, pad_edge=False)
    for name in ("figure", "mean", "deviation", "unit", "points per deviation"):
        weights.add_column(name)
    for name, centre, scale, weight in zip(
        model["figures"], model["centre"], model["scale"], model["rating_weights"], strict=True
    ):
        kind = KIND_OF[name]
        weights.add_row(kind.label, f"{centre:.2f}", f"{scale:.2f}", cell(kind.unit), f"{weight:+.2f}")
    out.print(weights)
    out.print(f"Rating at the means {model['rating']:.1f}; 90 % of unseen ones within {model['rating_margin']:.1f}.")


def _span(interval: list[float] | tuple[float, float]) -> str:
    low, high = interval
    return f"{low:.2f} to {high:.2f}"
