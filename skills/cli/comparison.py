"""Commands of atlases, scores, calibrations, and the report that redraws the paper's figures."""

import re
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skills.cli.recordings import ready
from skills.cli.shell import (
    AsJson,
    Suture,
    cell,
    complete_surgeons,
    complete_sutures,
    err,
    out,
    print_json,
    refusing,
    service,
    show,
)
from skills.errors import BadInput
from skills.remedies import did_you_mean

if TYPE_CHECKING:
    from skills.schemas.comparison import Atlas, Recognition

SHORT = 12  # characters of a digest: enough to distinguish it from the others in a table

commands = typer.Typer()


@commands.command()
@refusing
def atlas(
    suture: Suture,
    scaled: Annotated[bool, typer.Option("--scaled", help="Scale all demonstrations to one size.")] = False,
    clusters: Annotated[int | None, typer.Option(help="Number of clusters; by default as many as are found.")] = None,
    demo: Annotated[
        str | None, typer.Option(help="Recognise the surgeon of this demonstration, by its digest.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare all demonstrations of a suture type: clusters, differences between surgeons, and recognition."""
    with service() as client:
        found = client.atlas(suture, scaled=scaled, clusters=clusters, demo=demo)
    if as_json:
        print_json(found)
        return
    out.print(
        f"Demonstrations of {suture}: {len(found.demos)}, of {found.recordings} recordings; distances in {found.unit}, "
        "about as at one place"
    )
    for sentence in found.left_out.because:
        out.print(sentence, markup=False, soft_wrap=True)
    _tables(found)
    for pair in found.differences:
        out.print(f"- {pair.sentence}", markup=False, soft_wrap=True)
    _recognition(found)


def _tables(found: "Atlas") -> None:
    surgeons = [
        one.model_dump()
        | {"medoid": one.medoid[:SHORT], "consistency": _rounded(one.spread)}
        | {"share": None if one.mean_share is None else f"{one.mean_share:.0%}"}
        for one in found.surgeons
    ]
    show(surgeons, False, ("surgeon", "demos", "recordings", "sessions", "consistency", "share", "medoid"))
    clusters = [
        {
            "cluster": one.cluster,
            "demos": one.demos,
            "spread": _rounded(one.spread),
            "medoid": one.medoid[:SHORT],
            "surgeons": ", ".join(f"{of.demos} of {of.surgeon}" for of in one.surgeons),
        }
        for one in found.clusters
    ]
    show(clusters, False, ("cluster", "demos", "spread", "medoid", "surgeons"))


def _tell_recognition(recognition: "list[Recognition]", because: str | None) -> None:
    for seen in recognition:
        low, high = seen.interval
        out.print(
            f"recognition on {seen.arm}: {seen.right} of {seen.tested} with their session left out, "
            f"{seen.accuracy:.0%} ({low:.0%} to {high:.0%}), by chance {seen.chance:.0%}; log loss "
            f"{seen.log_loss:.2f} nat, guessing {seen.log_loss_of_guessing:.2f}; by {', '.join(seen.compared)}",
            soft_wrap=True,
        )
    if because is not None:
        out.print(f"no recognition: {because}", soft_wrap=True)


def _recognition(found: "Atlas") -> None:
    _tell_recognition(found.recognition, found.no_recognition_because)
    if found.votes is not None:
        out.print(
            f"votes of recordings: {found.votes.right} of {found.votes.recordings}, {found.votes.accuracy:.0%}",
            soft_wrap=True,
        )
    if found.recognised is not None:
        whose = found.recognised
        likely = ", ".join(f"{one.surgeon} {one.probability:.0%}" for one in whose.likely[:3])
        voted = f"; its recording votes for {whose.voted} ({whose.voters})" if whose.voted else ""
        out.print(
            f"{whose.demo[:SHORT]} of {whose.surgeon}, {whose.arm}: {likely}; none of these "
            f"{whose.none_of_these:.0%}{voted}",
            soft_wrap=True,
        )
    if found.recognition:
        out.print("Set-up and day are confounded with the surgeon: see docs/atlas.md.")


@commands.command()
@refusing
def recognise(
    recording: Annotated[str, typer.Argument(help="The digest of a recording that has a demonstration.")],
    suture: Annotated[str, typer.Option(help="The suture type.", autocompletion=complete_sutures)],
    as_json: AsJson = False,
) -> None:
    """Recognise the surgeon of a whole recording by all its movements, with its session left out."""
    with service() as client:
        found = client.recognise(recording, suture)
    if as_json:
        print_json(found)
        return
    out.print(f"{found.recording[:SHORT]} of {found.surgeon}: {found.voters} movements vote for {found.voted}")
    low, high = found.votes.interval
    out.print(
        f"votes of recordings: {found.votes.right} of {found.votes.recordings}, {found.votes.accuracy:.0%} "
        f"({low:.0%} to {high:.0%}), by chance {found.votes.chance:.0%}",
        soft_wrap=True,
    )
    _tell_recognition(found.recognition, found.no_recognition_because)


def _rounded(distance: float | None) -> str | None:
    return None if distance is None else f"{distance:.3g}"


if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.scores import Score

scoring_commands = typer.Typer()

DIGEST = re.compile("[0-9a-f]{8,64}")


@scoring_commands.command()
@refusing
def score(
    what: Annotated[str, typer.Argument(help="A recording's file, which is then stored; or a demonstration's digest.")],
    surgeon: Annotated[
        str, typer.Option(help="The surgeon whose style is the reference.", autocompletion=complete_surgeons)
    ],
    suture: Annotated[str, typer.Option(help="The suture type.", autocompletion=complete_sutures)],
    proposal: Annotated[int | None, typer.Option(help="The proposed hand-off of a file, counted from 1.")] = None,
    arm: Annotated[str | None, typer.Option(help="The arm, for a file.")] = None,
    start_s: Annotated[float | None, typer.Option(help="The start of the hand-off in a file.")] = None,
    end_s: Annotated[float | None, typer.Option(help="The end of the hand-off in a file.")] = None,
    reference: Annotated[str | None, typer.Option(help="The demonstration of the style to compare with.")] = None,
    task: Annotated[
        str | None, typer.Option(help="The task of the whole recording, for its rating; needed if there are several.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Score a motion against a style: its distance, where it deviates, and its percentiles. Not a credential."""
    with service() as client:
        if Path(what).exists():
            part = _part(client, Path(what), proposal, arm, start_s, end_s)
            scored = client.score(surgeon, suture, reference=reference, task=task, **part)
        elif DIGEST.fullmatch(what) is None or any(one is not None for one in (proposal, arm, start_s, end_s)):
            raise BadInput(
                f"There is no file {what}. Name a recording's file, or a demonstration by its digest and without "
                "--proposal, --arm, --start-s and --end-s."
            )
        else:
            scored = client.score(surgeon, suture, demo=what, reference=reference, task=task)
    if as_json:
        print_json(scored)
    else:
        _tell(scored)


def _part(
    client: "Client", path: Path, proposal: int | None, arm: str | None, start_s: float | None, end_s: float | None
) -> dict[str, Any]:
    """Store a recording, and return the part to score: the given times, else the proposed hand-off."""
    with ready(path) as (file, progress):
        stored = client.add_recording(file, progress=progress)
    if proposal is None and (start_s, end_s) != (None, None):
        return {"recording": stored.sha256, "arm": arm, "start_s": start_s, "end_s": end_s}
    arms = sorted({part.arm for part in stored.segments})
    if arm is not None and arms and arm not in arms:
        raise BadInput(
            f"No hand-off of {arm} is proposed in the recording; there are proposals of {', '.join(arms)}.",
            *did_you_mean(arm, arms),
        )
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
    named = scored.differences.words if scored.differences else ()
    for sentence in (*named, *scored.deviation.words, *scored.skill.words):
        out.print(sentence, markup=False, soft_wrap=True)
    out.print(scored.use, markup=False, soft_wrap=True)


@scoring_commands.command()
@refusing
def progress(
    surgeon: Annotated[str, typer.Argument(help="The surgeon's pseudonym.", autocompletion=complete_surgeons)],
    suture: Annotated[str, typer.Option(help="The suture type.", autocompletion=complete_sutures)],
    against: Annotated[
        str, typer.Option(help="The surgeon whose style is the reference.", autocompletion=complete_surgeons)
    ],
    as_json: AsJson = False,
) -> None:
    """Compare a surgeon's demonstrations with a style's reference, session by session. Not a credential."""
    with service() as client:
        found = client.progress(surgeon, suture, against=against)
    if as_json:
        print_json(found)
        return
    rows = [
        {
            "session": one.session or "",
            "stored": f"{one.stored_at:%Y-%m-%d}",
            "demos": one.demos,
            "distance, mm": f"{one.distance_mm:.1f}",
            "duration, s": "" if one.duration_s is None else f"{one.duration_s:.1f}",
            "smoothness": "" if one.log_dimensionless_jerk is None else f"{one.log_dimensionless_jerk:.1f}",
        }
        for one in found.sessions
    ]
    show(rows, False, ("session", "stored", "demos", "distance, mm", "duration, s", "smoothness"))
    out.print(f"Medians, beside {found.reference.demo}: {found.reference.because}.", soft_wrap=True)
    out.print(found.use, markup=False, soft_wrap=True)


@scoring_commands.command()
@refusing
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
    from skills.library.comparison.calibrations import accepted, calibrate_on, put_calibration, read_cohort
    from skills.scoring.validation import check_permutations
    from skills.serving import prepare
    from skills.settings import settings

    check_permutations(permutations)
    prepare(settings())
    with err.status("reading") as status:
        rated = read_cohort(folder, tasks=task or (), progress=lambda share: status.update(f"reading {share:.0%}"))
        _tell_left_out(rated.left_out)
        calibration = calibrate_on(
            rated,
            seed=seed,
            permutations=permutations,
            progress=lambda share: status.update(f"measuring the chance level {share:.0%}"),
        )
    about = calibration.model_dump(mode="json")
    if not as_json:
        _tell_judged(about)
    sha256 = None
    try:
        with closing(Database(settings().database_url)) as database, database.writing() as session:
            stored, _ = put_calibration(session, calibration, "local")
            sha256 = stored.sha256
    finally:
        if as_json:  # the figures of a refused model too, without a digest
            print_json({"sha256": sha256, **about})
    if not as_json:
        _tell_model(about, accepted(calibration))
        out.print(f"Stored, and used by every score from now on: {sha256}", soft_wrap=True)


def _tell_left_out(left_out: dict[str, list[str]]) -> None:
    for why, names in left_out.items():
        said = f"Left out, {why}: {', '.join(names)}."
        err.print(said, style="yellow", markup=False, soft_wrap=True)


def _tell_judged(about: dict[str, Any]) -> None:
    """Print the quality of the model and of its rivals, for each task."""
    from skills.demonstration.quality import times_in_words

    tasks, validated = about["data"]["tasks"], about["validated"]
    for name, judged in validated["tasks"].items():
        levels = ", ".join(f"{count} {level}" for level, count in tasks[name]["levels"].items())
        out.print(f"{name}: {judged['trials']} trials ({levels}) of {judged['surgeons']} surgeons", soft_wrap=True)
        _tell_task(judged)
    if len(tasks) > 1:
        out.print("The mean of the tasks")
        _tell_task(validated["mean"])
    chosen = "; ".join(f"{design} ({times_in_words(count)})" for design, count in validated["chosen"].items())
    out.print(f"Chosen with a surgeon left out: {chosen}", markup=False, soft_wrap=True)


def _tell_task(judged: dict[str, Any]) -> None:
    from rich.table import Table

    from skills.scoring.validation import RIVALS, SEEN

    table = Table(box=None, pad_edge=False)
    for name in ("a surgeon left out", "rho", "95 %", "level right", "95 %"):
        table.add_column(name, no_wrap=True)

    def tell(label: str, row: dict[str, Any]) -> None:
        right = ("", "")
        if row["accuracy"] is not None:
            right = (f"{100 * row['accuracy']:.0f} %", _span(row["accuracy_interval"]))
        table.add_row(label, f"{row['rho']:.2f}", _span(row["rho_interval"]), *right)

    tell("the model", judged["model"])
    for name, label in RIVALS.items():
        if name not in SEEN:
            tell(label, judged["rivals"][name])
    chance, accuracy = judged["chance"], ("", "")
    if chance["accuracy"] is not None:
        accuracy = (f"{100 * chance['accuracy']:.0f} %", f"p = {chance['accuracy_p']:.3f}")
    table.add_row("chance", f"{chance['rho']:.2f}", f"p = {chance['rho_p']:.3f}", *accuracy)
    table.add_row("a repetition left out", *[""] * 4)
    tell("the model", judged["repetition_out"])
    for name in SEEN:
        tell(RIVALS[name], judged["rivals"][name])
    out.print(table)
    out.print(f"The model's rho minus the better of the durations': {_span(judged['over_duration'])} (95 %)")
    parts = ", ".join(f"{name} {part['rho']:.2f}" for name, part in judged["parts"].items())
    out.print(f"Its rho with the parts of the rating: {parts}", soft_wrap=True)


def _tell_model(about: dict[str, Any], used: list[str]) -> None:
    """Print the weights of each task, and which tasks are rated."""
    from rich.table import Table

    from skills.scoring.calibration import from_numbers
    from skills.scoring.features import TRIAL_KIND_OF
    from skills.scoring.validation import level_refusals, refusals

    model = from_numbers(about["model"])
    for task, name in enumerate(model.tasks):
        judged = about["validated"]["tasks"][name]
        if name not in used:
            out.print(f"{name} is not rated: {' '.join(refusals(judged))}", markup=False, soft_wrap=True)
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
            out.print(f"No skill level is given: {sentence}", soft_wrap=True)
        out.print(f"Typical rating {model.means[task, 0]:.1f}; 90 % of unseen ones within {model.margins[task]:.1f}.")


def _span(interval: list[float] | tuple[float, float]) -> str:
    low, high = interval
    return f"{low:.2f} to {high:.2f}"


report_commands = typer.Typer()


@report_commands.command()
@refusing
def report(
    to: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("build/report"),
    irl_iterations: Annotated[int, typer.Option(min=1, help="Iterations of maximum-entropy IRL, for Fig. 5.")] = 200,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds for each learner.")] = 200,
    runs: Annotated[
        int, typer.Option(min=1, help="Runs of each policy and rival, for each probability of a slip.")
    ] = 1000,
    as_json: AsJson = False,
) -> None:
    """Redraw the paper's Figures 5 to 9 and Table I, compared with rivals: pictures and one HTML page."""
    if find_spec("movement_primitives") is None:
        raise BadInput(
            "The figures have a movement primitive as a rival, whose library is not installed here.",
            "Install the extra 'report': pip install 'suture-skills[report]'",
        )
    from skills.report import ABSENT, Effort, write_report
    from skills.settings import settings

    with err.status("...") as status:
        effort = Effort(irl_iterations=irl_iterations, seeds=seeds, runs=runs)
        written = write_report(to, settings().paper_data, effort, status.update)
    if not written.has_paper_data:
        err.print(ABSENT, soft_wrap=True)
    if as_json:
        out.print(written.numbers.read_text(), markup=False, soft_wrap=True)
        return
    for one in written.tables:
        out.print(f"\n{one.caption}", markup=False, soft_wrap=True)
        show([dict(zip(one.columns, row, strict=True)) for row in one.rows], False, one.columns)
    out.print(f"\n{len(written.pictures)} pictures and the page: {written.page}", soft_wrap=True)
