"""`skills`: the installation's own commands, and the typed client's, from a shell.

Tables for people, `--json` for programs; exit code 0 only on success. What is heavy is imported where it is used, so
that `skills --help` is quick.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer
from rich.console import Console
from rich.table import Table

from skills.errors import BadInput, SkillsError

if TYPE_CHECKING:
    from skills.client import Client

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Suture styles: learn, certify, serve and check. Research use only.",
)
recordings = typer.Typer(no_args_is_help=True, help="Raw recordings.")
demos = typer.Typer(no_args_is_help=True, help="Demonstrations: one hand-off each.")
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors give on request.")
policies = typer.Typer(no_args_is_help=True, help="Learnt policies.")
app.add_typer(recordings, name="recording")
app.add_typer(demos, name="demo")
app.add_typer(policies, name="policy")
app.add_typer(jigsaws, name="jigsaws")

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, digests stay whole
err = Console(stderr=True, highlight=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print the service's JSON.")]
Surgeon = Annotated[str, typer.Argument(help="The surgeon's pseudonym.")]
Suture = Annotated[str, typer.Argument(help="The suture type, such as simple-running.")]
RateHz = Annotated[float | None, typer.Option(help="Samples per second, for a table without times.")]
Frame = Annotated[str | None, typer.Option(help="The frame of a table's positions; PSM_base where none is given.")]
RecordingPath = Annotated[
    Path, typer.Argument(help="A recording, a bag folder, or a session's folder with one; pictures stay here.")
]
Triple = tuple[float, float, float]


P = ParamSpec("P")


def refusing(command: Callable[P, None]) -> Callable[P, None]:
    """Say in one sentence what was refused, and exit with 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except SkillsError as error:
            err.print(f"{type(error).__name__}: {error}", style="red", markup=False, soft_wrap=True)
            raise typer.Exit(1) from error

    return run


@contextmanager
def service(*, works: bool = False) -> Iterator["Client"]:
    """Connect to the service, or to the application in this process."""
    from skills.connection import connect
    from skills.settings import settings

    with connect(settings(), works=works) as client:
        yield client


def show(answer: Any, as_json: bool, columns: Sequence[str]) -> None:
    """Print an answer: a table of some of its fields, or all of it as JSON."""
    if as_json:
        out.print_json(json.dumps(answer))
        return
    rows = answer if isinstance(answer, list) else [answer]
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*("" if row.get(name) is None else str(row[name]) for name in columns))
    out.print(table)


def finished(client: "Client", job: dict[str, Any]) -> dict[str, Any]:
    """Wait for a job, with something to look at."""
    with err.status(f"{job['kind']} {job['id']} ..."):
        return client.wait(job)


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, Callable[[int], None]]]:
    """Make the recording that a path means ready to be sent: the file to send, and what is told of bytes sent."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    from skills.recordings.folder import find_bag, ready_to_send

    bag = find_bag(path)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as bar:
        reading = bar.add_task("reading", total=bag.size_bytes)
        with ready_to_send(bag, lambda count: bar.advance(reading, count)) as file:
            bar.update(reading, visible=False)
            sending = bar.add_task("sending", total=file.stat().st_size)
            yield file, lambda count: bar.advance(sending, count)


# ---- the installation


@app.command()
@refusing
def serve(
    samples: Annotated[bool, typer.Option(help="Load the sample surgeons and train them first.")] = False,
) -> None:
    """Start the service and its worker; stop both with Ctrl-C."""
    from skills.settings import settings

    settings().check_address()  # before anything is touched
    from skills.serving import serve as run

    run(settings(), samples=samples)


@app.command()
@refusing
def worker() -> None:
    """Work on jobs in this process, beside those that a service has started."""
    from skills.jobs.worker import run_worker
    from skills.settings import settings

    run_worker(settings())


@app.command()
@refusing
def migrate() -> None:
    """Bring the database to this version; an empty one gets its tables and the catalogue."""
    from skills.serving import prepare
    from skills.settings import settings

    prepare(settings())
    out.print("The database is up to date.")


@app.command()
@refusing
def seed() -> None:
    """Load the synthetic sample surgeons and their recordings."""
    from skills.samples import load_samples

    with service() as client:
        for demo in load_samples(client):
            out.print(f"{demo['surgeon']} {demo['suture']}: {demo['report']['path_states']} states")


# ---- recordings and demonstrations


@recordings.command("add")
@refusing
def recording_add(path: RecordingPath, rate_hz: RateHz = None, frame: Frame = None, as_json: AsJson = False) -> None:
    """Store a recording and see which hand-offs it seems to hold."""
    with service() as client, ready(path) as (file, sent):
        stored = client.add_recording(file, sent=sent, rate_hz=rate_hz, frame=frame)
    if as_json:
        out.print_json(json.dumps(stored))
        return
    out.print(
        f"{stored['sha256']}  {stored['format']}, {stored['duration_s']:.1f} s, integrity {stored['integrity']}",
        soft_wrap=True,
    )
    for name, value in stored["notes"].items():
        out.print(f"{name}: {value}", markup=False, soft_wrap=True)
    show(stored["segments"], False, ("arm", "start_s", "end_s", "reason"))


@demos.command("add")
@refusing
def demo_add(
    path: RecordingPath,
    surgeon: Annotated[str, typer.Option()],
    suture: Annotated[str, typer.Option()],
    arm: Annotated[str | None, typer.Option(help="Needed where a recording has several arms.")] = None,
    topic: Annotated[str | None, typer.Option()] = None,
    start_s: Annotated[float | None, typer.Option(help="Start of the hand-off in the recording.")] = None,
    end_s: Annotated[float | None, typer.Option(help="Its end.")] = None,
    proposal: Annotated[int | None, typer.Option(help="Take this proposed hand-off, counted from 1.")] = None,
    grid: Annotated[str, typer.Option(help="auto, paper or fit.")] = "auto",
    cell_mm: Annotated[float | None, typer.Option()] = None,
    hysteresis: Annotated[
        float, typer.Option(help="How far beyond its cell a sample stays in it: 0 to 0.5 cells, 0.25 against tremor.")
    ] = 0.0,
    session: Annotated[str | None, typer.Option()] = None,
    rate_hz: RateHz = None,
    frame: Frame = None,
    as_json: AsJson = False,
) -> None:
    """Store a recording and one demonstration of it."""
    asked: dict[str, Any] = {"arm": arm, "topic": topic, "session": session}
    asked |= {"grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis}
    how: dict[str, Any] = {"rate_hz": rate_hz, "frame": frame}
    with service() as client, ready(path) as (file, sent):
        if proposal is None:
            asked |= {"start_s": start_s, "end_s": end_s}
            answer = client.add_demo(file, surgeon=surgeon, suture=suture, sent=sent, **how, **asked)
        else:
            stored = client.add_recording(file, sent=sent, **how)
            proposed = [s for s in stored["segments"] if arm in (None, s["arm"])]
            if not 1 <= proposal <= len(proposed):
                raise BadInput(f"The recording has {len(proposed)} proposed hand-offs; see `skills recording add`.")
            part = proposed[proposal - 1]
            asked |= {"arm": part["arm"], "start_s": part["start_s"], "end_s": part["end_s"]}
            answer = client.cut_demo(stored["sha256"], surgeon=surgeon, suture=suture, **asked)
    answer["path_states"] = answer["report"]["path_states"]
    show(answer, as_json, ("id", "surgeon", "suture", "arm", "frame", "path_states"))
    if not as_json:
        x, y, z = answer["report"]["discretisation_rmse_mm"]
        loss = f"{x:.2f}, {y:.2f}, {z:.2f} mm off their cells along x, y, z (RMSE)"
        out.print(f"{answer['report']['revisits']} crossings; samples are {loss}")


@demos.command("list")
@refusing
def demo_list(surgeon: str | None = None, suture: str | None = None, as_json: AsJson = False) -> None:
    """List demonstrations, the newest first."""
    with service() as client:
        show(client.demos(surgeon, suture), as_json, ("id", "surgeon", "suture", "arm", "state", "created_at"))


@demos.command("show")
@refusing
def demo_show(demo: str) -> None:
    """Show a demonstration and its report, as JSON."""
    with service() as client:
        out.print_json(json.dumps(client.demo(demo)))


@demos.command("report")
@refusing
def demo_report(
    demo: str,
    html: Annotated[Path | None, typer.Option(help="Write it to this file as a page for a browser.")] = None,
) -> None:
    """Tell how good a demonstration is, and what would make it better."""
    with service() as client:
        if html is None:
            out.print_json(json.dumps(client.demo_report(demo)))
        else:
            html.write_bytes(client.demo_report_page(demo))
            out.print(f"The report: {html}")


@demos.command("withdraw")
@refusing
def demo_withdraw(demo: str) -> None:
    """Withdraw a demonstration and the releases that rest on it."""
    with service() as client:
        client.withdraw_demo(demo)


@jigsaws.command("add")
@refusing
def jigsaws_add(
    folder: Annotated[Path, typer.Argument(help="With TASK/kinematics/AllGestures/*.txt and what belongs to them.")],
    task: Annotated[list[str] | None, typer.Option(help="Only this task, such as Suturing; once for each.")] = None,
    suture: Annotated[
        str | None, typer.Option(help="Make demonstrations of this suture type of the proposed hand-offs.")
    ] = None,
    arm: Annotated[str | None, typer.Option(help="Of PSM_left or PSM_right only.")] = None,
    prefix: Annotated[str, typer.Option(help="Before a surgeon's letter, in their pseudonym.")] = "jigsaws",
    as_json: AsJson = False,
) -> None:
    """Store every trial of a folder; exit code 1 where one was refused, and the others are stored."""
    from rich.progress import track

    from skills.dataset import find_trials, send_trials

    found = find_trials(folder, task or ())
    with service() as client:
        sending = send_trials(client, found, suture=suture, arm=arm, prefix=prefix)
        done = [asdict(sent) for sent in track(sending, "sending", total=len(found), console=err, transient=True)]
    if as_json:
        out.print_json(json.dumps(done))
    else:
        rows = [one | {"recording": (one["recording"] or "")[:12], "demos": len(one["demos"])} for one in done]
        show(rows, False, ("trial", "surgeon", "skill_level", "score", "recording", "proposed", "demos"))
        for one in done:
            for problem in one["problems"]:
                err.print(f"{one['trial']}: {problem}", style="red", markup=False, soft_wrap=True)
    if any(one["problems"] for one in done):
        raise typer.Exit(1)


# ---- learning


@app.command()
@refusing
def train(
    surgeon: Surgeon,
    suture: Suture,
    release: Annotated[bool, typer.Option(help="Release the version if it passes the gate.")] = False,
    seed: int = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a style from its newest demonstration, and wait for it."""
    with service(works=True) as client:
        job = finished(client, client.train(surgeon, suture, seed=seed, release=release))
    show(job if as_json else job["result"], as_json, ("policy_version", "sha256", "releasable", "released"))


@policies.command("show")
@refusing
def policy_show(surgeon: Surgeon, suture: Suture, version: int | None = None, as_json: AsJson = False) -> None:
    """Show the released policy of a style, or one of its versions."""
    with service() as client:
        policy = client.policy(surgeon, suture, version)
    if as_json:
        out.print_json(json.dumps(policy))
        return
    metrics, coverage = policy["metrics"], policy["coverage"]
    out.print(f"{surgeon} {suture} version {policy['version']}  {policy['sha256']}", soft_wrap=True)
    out.print(
        f"path    {metrics['exact_states']} of {metrics['path_states']} states, DTW {metrics['dtw_total_mm']:g} mm"
    )
    out.print(f"starts  {coverage['starts_reaching_goal']} of {coverage['n_states']} reach the goal")
    out.print(f"release {policy['released_at'] or 'not released'}")


@policies.command("release")
@refusing
def policy_release(surgeon: Surgeon, suture: Suture, version: int) -> None:
    """Release a version, if it passes the gate."""
    with service() as client:
        answer = client.release(surgeon, suture, version)
    out.print(f"Version {answer['version']} is released since {answer['released_at']}.")


@policies.command("withdraw")
@refusing
def policy_withdraw(surgeon: Surgeon, suture: Suture) -> None:
    """Withdraw what is released of a style."""
    with service() as client:
        client.withdraw(surgeon, suture)


@policies.command("export")
@refusing
def policy_export(surgeon: Surgeon, suture: Suture, to: Path) -> None:
    """Write the released policy to a file: .json, or .npz with its Q values."""
    if to.suffix not in (".json", ".npz"):
        raise BadInput("A policy is exported to a file that ends in .json or .npz.")
    with service() as client:
        policy = client.policy(surgeon, suture)
        data = json.dumps(policy).encode() if to.suffix == ".json" else client.policy_arrays(policy["sha256"])
    to.write_bytes(data)


@app.command()
@refusing
def rollout(
    surgeon: Surgeon,
    suture: Suture,
    start: Annotated[str, typer.Option(help="Where it starts, as x,y,z in mm of the policy's frame.")],
    as_json: AsJson = False,
) -> None:
    """Follow the released policy from a place to the goal."""
    with service() as client:
        answer = client.rollout(surgeon, suture, triple(start))
    answer["states_visited"] = len(answer["states"])
    show(answer, as_json, ("finished", "states_visited", "dtw_total_mm"))


# ---- plans


@app.command()
@refusing
def plan(
    surgeon: Surgeon,
    suture: Suture,
    point: Annotated[list[str], typer.Option(help="A suture point, as x,y,z in mm; once for each pass.")],
    speed_mm_s: float = 20.0,
    approach: Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")] = None,
    as_json: AsJson = False,
) -> None:
    """Stack the released policy at suture points."""
    points = [{"position_mm": triple(one)} for one in point]
    psm_m = None if approach is None else {"approach": triple(approach)}
    with service() as client:
        answer = client.plan(surgeon, suture, points, speed_mm_s=speed_mm_s, psm_m=psm_m)
    answer["duration_s"] = answer["trajectory"]["duration_s"]
    show(answer, as_json, ("id", "arm", "frame", "orientation", "duration_s"))


@app.command()
@refusing
def play(
    plan_id: Annotated[str, typer.Argument(help="The plan's digest.")],
    picture: Annotated[Path | None, typer.Option(help="Write a picture here.")] = None,
    as_json: AsJson = False,
) -> None:
    """Play a plan in the simulator, and print its verdict; exit code 1 where it is not feasible."""
    with service(works=True) as client:
        result = finished(client, client.play(plan_id))["result"]
        playback = client.playback(result["playback"])
        if picture is not None:
            picture.write_bytes(client.picture(playback["id"]))
    if as_json:
        out.print_json(json.dumps(playback))
    else:
        out.print("feasible" if playback["feasible"] else playback["report"]["failure_in_words"])
    if not playback["feasible"]:
        raise typer.Exit(1)


# ---- the paper


@app.command()
@refusing
def report(
    to: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("build/report"),
    irl_iterations: Annotated[int, typer.Option(min=1, help="Of maximum-entropy IRL, for Fig. 5.")] = 200,
    seeds: Annotated[int, typer.Option(min=1, help="Try each learner on this many seeds.")] = 200,
    runs: Annotated[int, typer.Option(min=1, help="Of each policy and rival, for each probability of a slip.")] = 1000,
    as_json: AsJson = False,
) -> None:
    """Redraw the paper's Figures 5 to 9 and Table I, with rivals beside them: pictures and one HTML page."""
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


# ---- for good


@app.command()
@refusing
def erase(surgeon: Surgeon, yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Erase a surgeon, and everything derived from them, for good."""
    if not yes:
        typer.confirm(f"Erase '{surgeon}', all recordings, policies and plans, for good?", abort=True)
    with service() as client:
        client.erase_surgeon(surgeon)


def triple(text: str) -> Triple:
    """Read x,y,z."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInput("Write three numbers with commas between them, such as 5,55,-125.") from None
    return x, y, z
