"""Commands of atlases, recognition and scores."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.commands import Surgeon, Suture, TheSurgeon, TheSuture, command
from skills.cli.completion import complete_surgeons
from skills.cli.connecting import service
from skills.cli.output import Answer, say, show_cells, show_table, table, text
from skills.cli.uploading import ready
from skills.errors import BadInput
from skills.keywords import ScoreKeywords
from skills.remedies import did_you_mean

if TYPE_CHECKING:
    from skills.client.blocking.client import Client
    from skills.schemas.comparison import Atlas, Recognition
    from skills.schemas.scores import Score

SHORT = 12  # characters of a digest: enough to distinguish it from the others in a table
DIGEST = re.compile("[0-9a-f]{8,64}")

commands = typer.Typer()


@command(commands)
def atlas(suture: Suture, scaled: bool = False, clusters: int | None = None, demo: str | None = None) -> Answer:
    """Compare all demonstrations of a suture type: clusters, differences between surgeons, and recognition.

    Args:
        scaled: Scale all demonstrations to one size.
        clusters: Number of clusters; by default as many as are found.
        demo: Recognise the surgeon of this demonstration, by its digest.
    """
    with service() as client:
        found = client.atlas(suture, scaled=scaled, clusters=clusters, demo=demo)
    return Answer(found, lambda: _show_atlas(suture, found))


def _show_atlas(suture: str, found: "Atlas") -> None:
    say(
        f"Demonstrations of {suture}: {len(found.demos)}, of {found.recordings} recordings; distances in {found.unit}, "
        "about as at one place"
    )
    say(*found.left_out.because)
    _show_tables(found)
    say(*(f"- {pair.sentence}" for pair in found.differences))
    _say_recognised(found)


def _show_tables(found: "Atlas") -> None:
    from skills.fields import percent

    surgeons = [
        one.model_dump()
        | {"medoid": one.medoid[:SHORT], "consistency": _rounded(one.spread)}
        | {"share": None if one.mean_share is None else f"{percent(one.mean_share)}%"}
        for one in found.surgeons
    ]
    show_table(surgeons, ("surgeon", "demos", "recordings", "sessions", "consistency", "share", "medoid"))
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
    show_table(clusters, ("cluster", "demos", "spread", "medoid", "surgeons"))


def _recognition(recognition: "list[Recognition]", because: str | None) -> Iterator[str]:
    """Yield a sentence for each arm, and why there is no recognition."""
    from skills.fields import percent

    for seen in recognition:
        low, high = seen.interval
        yield (
            f"recognition on {seen.arm}: {seen.right} of {seen.tested} with their session left out, "
            f"{percent(seen.accuracy)}% ({percent(low)}% to {percent(high)}%), by chance "
            f"{percent(seen.chance)}%; log loss "
            f"{seen.log_loss:.2f} nat, guessing {seen.log_loss_of_guessing:.2f}; by {', '.join(seen.compared)}"
        )
    if because is not None:
        yield f"no recognition: {because}"


def _say_recognised(found: "Atlas") -> None:
    from skills.fields import percent

    say(*_recognition(found.recognition, found.no_recognition_because))
    if found.votes is not None:
        say(f"votes of recordings: {found.votes.right} of {found.votes.recordings}, {percent(found.votes.accuracy)}%")
    if (one := found.recognised) is not None:
        likely = ", ".join(f"{of.surgeon} {percent(of.probability)}%" for of in one.likely[:3])
        voted = f"; its recording votes for {one.voted} ({one.voters})" if one.voted else ""
        none = f"none of these {percent(one.none_of_these)}%"
        say(f"{one.demo[:SHORT]} of {one.surgeon}, {one.arm}: {likely}; {none}{voted}")
    if found.recognition:
        say("Set-up and day are confounded with the surgeon: see docs/atlas.md.")


@command(commands)
def recognise(recording: str, suture: TheSuture) -> Answer:
    """Recognise the surgeon of a whole recording by all its movements, with its session left out.

    Args:
        recording: The digest of a recording that has a demonstration.
    """
    from skills.fields import percent

    with service() as client:
        found = client.recognise(recording, suture)
    low, high = found.votes.interval
    return text(
        found,
        f"{found.recording[:SHORT]} of {found.surgeon}: {found.voters} movements vote for {found.voted}",
        f"votes of recordings: {found.votes.right} of {found.votes.recordings}, {percent(found.votes.accuracy)}% "
        f"({percent(low)}% to {percent(high)}%), by chance {percent(found.votes.chance)}%",
        *_recognition(found.recognition, found.no_recognition_because),
    )


def _rounded(distance: float | None) -> str | None:
    return None if distance is None else f"{distance:.3g}"


@command(commands, without=("demo", "recording"))
def score(
    what: str, surgeon: TheSurgeon, suture: TheSuture, options: ScoreKeywords, proposal: int | None = None
) -> Answer:
    """Score a motion against a style: its distance, where it deviates, and its percentiles. Not a credential.

    Args:
        what: A recording's file, which is then stored; or a demonstration's digest.
        proposal: The proposed hand-off of a file, counted from 1.
    """
    with service() as client:
        if Path(what).exists():
            _choose_part(client, Path(what), proposal, options)
        elif DIGEST.fullmatch(what) is None or proposal is not None or {"arm", "start_s", "end_s"} & options.keys():
            raise BadInput(
                f"There is no file {what}. Name a recording's file, or a demonstration by its digest and without "
                "--proposal, --arm, --start-s and --end-s."
            )
        else:
            options["demo"] = what
        scored = client.score(surgeon, suture, **options)
    return Answer(scored, lambda: _show_score(scored))


def _choose_part(client: "Client", path: Path, proposal: int | None, options: ScoreKeywords) -> None:
    """Store a recording, and add the part to score to the options: the given times, else the proposed hand-off."""
    with ready(path) as (file, progress):
        stored = client.add_recording(file, progress=progress)
    options["recording"] = stored.sha256
    if {"start_s", "end_s"} & options.keys():
        if proposal is not None:
            raise BadInput("Use --proposal or --start-s and --end-s, not both.")
        return
    arm = options.get("arm")
    arms = sorted({part.arm for part in stored.segments})
    if arm is not None and arms and arm not in arms:
        raise BadInput(
            f"No hand-off of {arm} is proposed in the recording; there are proposals of {', '.join(arms)}.",
            *did_you_mean(arm, arms),
        )
    proposed = [part for part in stored.segments if arm in (None, part.arm)]
    number = 1 if proposal is None else proposal
    if not 1 <= number <= len(proposed) or (proposal is None and len(proposed) > 1):
        raise BadInput(
            f"The recording has {len(proposed)} proposed hand-offs; choose one with --proposal, or give --start-s and "
            "--end-s."
        )
    part = proposed[number - 1]
    options |= {"arm": part.arm, "start_s": part.start_s, "end_s": part.end_s}


def _show_score(scored: "Score") -> None:
    from skills.fields import percent

    beside = [one for one in scored.percentiles if one.below]
    rows = []
    for one in scored.figures:
        below = [level.below.get(one.name) if level.below else None for level in beside]
        shares = ["" if share is None else f"{percent(share)} %" for share in below]
        numbers = ["" if n is None else f"{n:.2f}" for n in (one.value, one.reference, one.ratio)]
        rows.append((one.label, *numbers, one.unit, *shares))
    show_cells(("", "value", "reference", "ratio", "", *(f"below {one.level}" for one in beside)), rows)
    say(f"Beside {scored.reference.demo}: {scored.reference.because}.")
    named = scored.differences.words if scored.differences else ()
    say(*named, *scored.deviation.words, *scored.skill.words, scored.use)


@command(commands)
def progress(
    surgeon: Surgeon, suture: TheSuture, against: Annotated[str, typer.Option(autocompletion=complete_surgeons)]
) -> Answer:
    """Compare a surgeon's demonstrations with a style's reference, session by session. Not a credential.

    Args:
        against: The surgeon whose style is the reference.
    """
    with service() as client:
        found = client.progress(surgeon, suture, against=against)
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
    columns = ("session", "stored", "demos", "distance, mm", "duration, s", "smoothness")
    beside = f"Medians, beside {found.reference.demo}: {found.reference.because}."
    return table(found, columns, beside, found.use, rows=rows)
