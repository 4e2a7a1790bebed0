"""The command that fits the model of skill ratings to rated trials."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.commands import command
from skills.cli.connecting import installation
from skills.cli.output import Answer, err, out, say, show_cells, warn
from skills.errors import SkillsError

if TYPE_CHECKING:
    from skills.schemas.calibrations import Calibration
    from skills.scoring.validation import Judged, TaskValidation

commands = typer.Typer()


@command(commands)
def calibrate(
    folder: Annotated[Path, typer.Argument(file_okay=False)],
    task: list[str] | None = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    permutations: Annotated[int, typer.Option(max=10_000)] = 200,
) -> Answer:
    """Fit a model of skill ratings to a folder of rated trials, and store it: every score uses the newest model.

    All tasks are fitted together and judged one by one, on surgeons left out. A task is rated only if the model is
    better than chance and than the duration alone.

    Args:
        folder: A folder with TASK/kinematics/AllGestures/*.txt and TASK/meta_file_TASK.txt.
        task: A task, such as Suturing; again for another. By default all of the folder.
        seed: Seed of the bootstrap and the permutations.
        permutations: Number of permutations for the chance level: p is the share that does as well.
    """
    from skills.library.comparison.calibrations import calibrate_on, put_calibration, read_cohort
    from skills.scoring.validation import check_permutations
    from skills.serving import prepare
    from skills.settings import settings

    check_permutations(permutations)
    prepare(settings())
    with err.status("reading") as status:
        rated = read_cohort(folder, tasks=task or (), progress=lambda share: status.update(f"reading {share:.0%}"))
        warn(*(f"Left out, {why}: {', '.join(names)}." for why, names in rated.left_out.items()), style="yellow")
        found = calibrate_on(
            rated,
            seed=seed,
            permutations=permutations,
            progress=lambda share: status.update(f"measuring the chance level {share:.0%}"),
        )
    sha256, refused = None, None
    try:
        with installation() as database, database.writing() as session:
            sha256 = put_calibration(session, found, "local")[0].sha256
    except SkillsError as error:
        refused = error

    def show() -> None:
        _show_validation(found)
        if refused is None:
            _show_model(found)
            say(f"Stored, and used by every score from now on: {sha256}")

    # the figures of a refused model too, without a digest
    return Answer({"sha256": sha256, **found.model_dump(mode="json")}, show, refused=refused)


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
    from skills.fields import percent
    from skills.scoring.validation import RIVALS, SEEN

    def figures(label: str, row: "Judged") -> tuple[str, ...]:
        right: tuple[str, ...] = ()
        if row.accuracy is not None and row.accuracy_interval is not None:
            right = (f"{percent(row.accuracy)} %", _span(row.accuracy_interval))
        return label, f"{row.rho:.2f}", _span(row.rho_interval), *right

    chance = judged.chance
    by_chance: tuple[str, ...] = ("chance", f"{chance.rho:.2f}", f"p = {chance.rho_p:.3f}")
    if chance.accuracy is not None:
        by_chance += (f"{percent(chance.accuracy)} %", f"p = {chance.accuracy_p:.3f}")
    rows = [
        figures("the model", judged.model),
        *(figures(label, judged.rivals[name]) for name, label in RIVALS.items() if name not in SEEN),
        by_chance,
        ("a repetition left out",),
        figures("the model", judged.repetition_out),
        *(figures(RIVALS[name], judged.rivals[name]) for name in SEEN),
    ]
    show_cells(("a surgeon left out", "rho", "95 %", "level right", "95 %"), rows)
    out.print(f"The model's rho minus the better of the durations': {_span(judged.over_duration)} (95 %)")
    parts = ", ".join(f"{name} {part.rho:.2f}" for name, part in judged.parts.items())
    say(f"Its rho with the parts of the rating: {parts}")


def _show_model(found: "Calibration") -> None:
    """Print the weights of each task, and which tasks are rated."""
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
        kinds = [TRIAL_KIND_OF[figure] for figure in model.figures]
        rows = [
            (kind.label, f"{kind.readable(float(centre)):.3g}", kind.unit, f"{weight:+.2f}")
            for kind, centre, weight in zip(kinds, model.centre[task], model.weights[task, 0], strict=True)
        ]
        out.print(f"{name} is rated by")
        show_cells(("figure", "typical", "unit", "points per deviation"), rows)
        say(*(f"No skill level is given: {sentence}" for sentence in level_refusals(judged)))
        out.print(f"Typical rating {model.means[task, 0]:.1f}; 90 % of unseen ones within {model.margins[task]:.1f}.")


def _span(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{low:.2f} to {high:.2f}"
