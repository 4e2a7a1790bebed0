"""The command that fits the model of skill ratings to rated trials."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.commands import AsJson, command
from skills.cli.output import cell, err, out, print_json, say

if TYPE_CHECKING:
    from skills.schemas.calibrations import Calibration
    from skills.scoring.validation import Judged, TaskValidation

commands = typer.Typer()


@command(commands)
def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(
            help="A folder with TASK/kinematics/AllGestures/*.txt and TASK/meta_file_TASK.txt.", file_okay=False
        ),
    ],
    task: Annotated[
        list[str] | None,
        typer.Option(help="A task, such as Suturing; again for another. By default all of the folder."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the bootstrap and the permutations.", min=0)] = 0,
    permutations: Annotated[
        int,
        typer.Option(help="Number of permutations for the chance level: p is the share that does as well.", max=10_000),
    ] = 200,
    as_json: AsJson = False,
) -> None:
    """Fit a model of skill ratings to a folder of rated trials, and store it: every score uses the newest model.

    All tasks are fitted together and judged one by one, on surgeons left out. A task is rated only if the model is
    better than chance and than the duration alone.
    """
    from skills.db.session import Database
    from skills.library.comparison.calibrations import calibrate_on, put_calibration, read_cohort
    from skills.scoring.validation import check_permutations
    from skills.serving import prepare
    from skills.settings import settings

    check_permutations(permutations)
    prepare(settings())
    with err.status("reading") as status:
        rated = read_cohort(folder, tasks=task or (), progress=lambda share: status.update(f"reading {share:.0%}"))
        _warn_left_out(rated.left_out)
        found = calibrate_on(
            rated,
            seed=seed,
            permutations=permutations,
            progress=lambda share: status.update(f"measuring the chance level {share:.0%}"),
        )
    if not as_json:
        _show_validation(found)
    sha256 = None
    try:
        with closing(Database(settings().database_url)) as database, database.writing() as session:
            stored, _ = put_calibration(session, found, "local")
            sha256 = stored.sha256
    finally:
        if as_json:  # the figures of a refused model too, without a digest
            print_json({"sha256": sha256, **found.model_dump(mode="json")})
    if not as_json:
        _show_model(found)
        say(f"Stored, and used by every score from now on: {sha256}")


def _warn_left_out(left_out: dict[str, list[str]]) -> None:
    for why, names in left_out.items():
        said = f"Left out, {why}: {', '.join(names)}."
        err.print(said, style="yellow", markup=False, soft_wrap=True)


def _show_validation(found: "Calibration") -> None:
    """Print the quality of the model and of its rivals, for each task."""
    from skills.demonstration.quality import describe_count

    for name, judged in found.validated.tasks.items():
        levels = ", ".join(f"{count} {level}" for level, count in found.data.tasks[name].levels.items())
        say(f"{name}: {judged.trials} trials ({levels}) of {judged.surgeons} surgeons")
        _show_task(judged)
    if len(found.data.tasks) > 1:
        out.print("The mean of the tasks")
        _show_task(found.validated.mean)
    chosen = "; ".join(f"{design} ({describe_count(count)})" for design, count in found.validated.chosen.items())
    say(f"Chosen with a surgeon left out: {chosen}")


def _show_task(judged: "TaskValidation") -> None:
    from rich.table import Table

    from skills.scoring.validation import RIVALS, SEEN

    table = Table(box=None, pad_edge=False)
    for name in ("a surgeon left out", "rho", "95 %", "level right", "95 %"):
        table.add_column(name, no_wrap=True)

    def add_row(label: str, row: "Judged") -> None:
        right = ("", "")
        if row.accuracy is not None and row.accuracy_interval is not None:
            right = (f"{100 * row.accuracy:.0f} %", _span(row.accuracy_interval))
        table.add_row(label, f"{row.rho:.2f}", _span(row.rho_interval), *right)

    add_row("the model", judged.model)
    for name, label in RIVALS.items():
        if name not in SEEN:
            add_row(label, judged.rivals[name])
    chance, accuracy = judged.chance, ("", "")
    if chance.accuracy is not None:
        accuracy = (f"{100 * chance.accuracy:.0f} %", f"p = {chance.accuracy_p:.3f}")
    table.add_row("chance", f"{chance.rho:.2f}", f"p = {chance.rho_p:.3f}", *accuracy)
    table.add_row("a repetition left out", *[""] * 4)
    add_row("the model", judged.repetition_out)
    for name in SEEN:
        add_row(RIVALS[name], judged.rivals[name])
    out.print(table)
    out.print(f"The model's rho minus the better of the durations': {_span(judged.over_duration)} (95 %)")
    parts = ", ".join(f"{name} {part.rho:.2f}" for name, part in judged.parts.items())
    say(f"Its rho with the parts of the rating: {parts}")


def _show_model(found: "Calibration") -> None:
    """Print the weights of each task, and which tasks are rated."""
    from rich.table import Table

    from skills.library.comparison.calibrations import accepted
    from skills.scoring.calibration import from_numbers
    from skills.scoring.features import TRIAL_KIND_OF
    from skills.scoring.validation import level_refusals, refusals

    model, used = from_numbers(found.model), accepted(found)
    for task, name in enumerate(model.tasks):
        judged = found.validated.tasks[name]
        if name not in used:
            say(f"{name} is not rated: {' '.join(refusals(judged))}")
            continue
        weights = Table(box=None, pad_edge=False)
        for column in ("figure", "typical", "unit", "points per deviation"):
            weights.add_column(column)
        for figure, centre, weight in zip(model.figures, model.centre[task], model.weights[task, 0], strict=True):
            kind = TRIAL_KIND_OF[figure]
            weights.add_row(kind.label, f"{kind.readable(float(centre)):.3g}", cell(kind.unit), f"{weight:+.2f}")
        out.print(f"{name} is rated by")
        out.print(weights)
        for sentence in level_refusals(judged):
            say(f"No skill level is given: {sentence}")
        out.print(f"Typical rating {model.means[task, 0]:.1f}; 90 % of unseen ones within {model.margins[task]:.1f}.")


def _span(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{low:.2f} to {high:.2f}"
