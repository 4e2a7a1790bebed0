"""What a policy card says in sentences: what was checked and what was not, in words that a reader can hold us to."""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from skills import __version__
from skills.db.models import PolicyVersion
from skills.style.domain import REACH
from skills.style.doubt import CALIBRATED_MM, UNCALIBRATED_MM
from skills.style.quality import times_in_words

USE = "Research use only; not a medical device. Never move an arm by it on or near a person."
IS = [
    "One surgeon's way to hand the needle on (the hand-off of a stitch), learnt from one recorded demonstration: for "
    "every cell of a grid world the next of 27 moves, up to the demonstrated goal.",
    "Certified on that grid: every greedy action was compared with exact dynamic programming, and every cell was tried "
    "as a start. The certificate below says what was found.",
    "An immutable value: its SHA-256 covers all of its numbers and all that is said of it here as measured.",
]
IS_NOT = [
    "A statement about accuracy: the certificate says nothing about how near a real arm comes to what it is told.",
    "Evidence that the demonstration is a good one, clinically or technically: the policy repeats what it was shown.",
    "A plan of motion: that stacks policies at suture points, and has a simulated playback and a verdict of its own.",
    "Validated for use on people, animals or tissue.",
]
NOT_CHECKED = [
    "Tissue, thread and needle: there are none in the grid world.",
    "Collisions, clearances, speeds and joint velocities: they are judged for a plan, by its playback in simulation.",
    "The turn of the jaw at the hand-off (A2): the policy is the way of the tip; the turn is planned.",
    "Any other arm, frame, instrument or grid than those named here.",
    "A real robot: no figure on this card was measured on one. What the recording was made with, its protocol says.",
]

METRICS = (
    (
        "dtw_total_mm",
        "Total DTW",
        "mm",
        "Dynamic time warping of the rollout from the demonstrated start against the demonstration in the grid: the "
        "Manhattan distance, summed over all pairs of a shortest alignment. Exact, whatever the tie-break.",
    ),
    ("dtw_mean_mm", "Mean difference", "mm", "Over the pairs of that alignment, along each axis; {tie_break}."),
    ("dtw_std_mm", "Standard deviation", "mm", "Of the same differences, of the population."),
    ("rmse_mm", "RMSE", "mm", "Root mean square of the same differences."),
    (
        "exact_states",
        "States reproduced",
        "of {path_states} states",
        "Those at which the rollout is in the cell that the demonstration is in at the same step.",
    ),
    (
        "discretisation_rmse_mm",
        "Lost to the grid",
        "mm",
        "RMSE of the recorded samples against the centres of their cells. The other rows compare paths on the grid, "
        "and do not see what it had lost before.",
    ),
)

DIGESTS = {
    "recording": "SHA-256 of the file's bytes, as they were uploaded (`sha256sum FILE`).",
    "demonstration": "SHA-256 of `digest_of` as canonical JSON: it names recording, style, segment and grid.",
    "reward map": "SHA-256 of the rewards that Algorithm 1 writes for the path; they are written again to check.",
    "policy": "SHA-256 of `digest_of` as canonical JSON: all that is told of the policy, the demonstration's digest in "
    "it, and the digest of its numbers.",
}
VERIFY = [
    "All of these digests were computed again, the recording's over its bytes, before this card was written; had one "
    "differed, there would be no card.",
    "On the installation, `skills verify` does so for everything that is stored.",
    "Without it: take `lineage` of the JSON card. Canonical JSON has sorted keys, no spaces and ASCII alone; Python's "
    'json.dumps(digest_of, sort_keys=True, separators=(",", ":")) writes it.',
]


HOW = {
    "medoid": "It follows the one of them that is nearest to all, as it was recorded",
    "barycentre": "It follows the way of the least total distance to all (DTW barycentre), which none of them is",
    "corridor": "It follows the middle of those that agree, at each place on the way, which none of them is",
}


def of_several(count: int, how: str) -> list[str]:
    """Say what a policy is that was learnt from several demonstrations, and how."""
    return [IS[0].replace("one recorded demonstration", f"{count} recorded demonstrations"), how, *IS[1:]]


def combined(said: dict[str, Any], count: int) -> str:
    """Say how several demonstrations became one way, and how far they are from it."""
    place = (
        "They were shown at different places, and were turned and scaled to lie on each other. "
        if said["moved"]
        else ""
    )
    wide = said["width_mm"]
    return (
        f"{HOW[said['kind']]}. {place}The {count} demonstrations are {min(said['apart_mm']):.2f} to "
        f"{max(said['apart_mm']):.2f} mm from it at a place, on average (DTW); the majority of them pass its waypoints "
        f"within {min(wide):.2f} to {max(wide):.2f} mm. Where this card speaks of the demonstration, it means this way."
    )


def status(version: int, served: int | None, refused: Sequence[str], was_released: bool) -> str:
    """Say whether a version is served, and else why not."""
    if served == version:
        return "This is the version that is served for this style."
    now = "nothing of this style is" if served is None else f"version {served} is"
    if refused:
        return f"It cannot be released: {'; '.join(refused)}. Of this style, {now} released now."
    before = "It was released before" if was_released else "It was never released"
    return f"{before}; of this style, {now} released now."


def consent(given: dict[str, Any] | None) -> str:
    """Say what a surgeon agreed to; whether it has run out depends on when that is read."""
    if given is None:
        return "No consent is recorded here; the protocol of the study says what is allowed."
    uses = ", ".join(given["uses"]) or "nothing"
    until = given.get("until")
    return (
        f"Covers {uses}{'' if until is None else f', until {until}'}; other uses are refused. Whether this card may be "
        "published, the protocol says."
    )


def demonstration_state(withdrawn_at: datetime | None) -> str:
    """Say whether a demonstration stands."""
    if withdrawn_at is None:
        return "Active."
    return (
        f"Withdrawn on {withdrawn_at:%Y-%m-%d}: its surgeon or the lab took it back. Nothing that was learnt from it "
        "is released any more, nor can be; do not use this policy."
    )


def quality(report: dict[str, Any]) -> list[str]:
    """Say what kind of demonstration it is, and what would have made it a better one."""
    smooth, clutched = report["log_dimensionless_jerk"], report["clutch_presses"]
    size = " x ".join(f"{side:.1f}" for side in report["extent_mm"])
    said = [
        f"{report['duration_s']:.2f} s, {report['samples']} samples at {report['rate_hz']:.0f} Hz; the longest gap is "
        f"{1000 * report['longest_gap_s']:.0f} ms.",
        f"The tip moves {report['path_length_mm']:.1f} mm in a box of {size} mm, at {report['speed_median_mm_s']:.1f} "
        f"mm/s in the median and {report['speed_peak_mm_s']:.1f} mm/s at most; {report['idle_share']:.0%} of the time "
        "it is idle.",
        "No press of the clutch is recorded."
        if clutched == 0
        else f"The clutch was pressed {times_in_words(clutched)}, {report['clutched_s']:.1f} s in all.",
    ]
    if smooth is not None:
        said.append(
            f"Smoothness (log dimensionless jerk): {smooth:.1f}; one even stroke has -5.3, a hesitant hand less."
        )
    return said + [f"Advice to the surgeon: {one}" for one in report["advice"]]


def lost(report: dict[str, Any]) -> str:
    """Say what the grid took of a demonstration."""
    x, y, z = report["discretisation_rmse_mm"]
    crossings = report["revisits"]
    crossed = (
        "never crosses itself" if crossings == 0 else f"comes back to a state it was in {times_in_words(crossings)}"
    )
    gaps = report["bridged_cells"]
    bridged = "every one has a sample in it" if gaps == 0 else f"{gaps} of them were bridged, for no sample lies there"
    return (
        f"{report['discretisation_rmse_3d_mm']:.2f} mm (RMSE, 3-D; {x:.2f} in x, {y:.2f} in y, {z:.2f} in z). The path "
        f"has {report['path_states']} states and {crossed}; {bridged}."
    )


def learner(phases: int, settled: bool) -> str:
    """Say what a learner's state is, and whether it came to rest."""
    state = (
        "Its state is the cell and the phase (how far along the demonstration), so a path that crosses itself can be "
        "followed."
        if phases > 1
        else "Its state is the cell alone, as in the paper, so a path that crosses itself cannot be followed."
    )
    ended = "It ended when nothing changed any more." if settled else "It ended before it had come to rest."
    return f"{state} {ended} The same demonstration, settings, seed and learner version give the same numbers."


def coverage(counts: dict[str, int], starts: int) -> str:
    """Say from where the goal is reached, and how."""
    reach = counts["follow"] + counts["reach_otherwise"]
    if counts["follow"] == starts:
        return f"All of {starts} starts join the demonstration in the fewest moves and follow it to the goal."
    return (
        f"{reach} of {starts} starts reach the goal. {counts['follow']} join the demonstration in the fewest moves and "
        f"follow it from there; {counts['reach_otherwise']} get there in another way."
    )


def domain(phases: int) -> str:
    """Say where the policy promises something."""
    if phases == 1:
        return "Every cell of the grid, in its one phase. Outside the grid nothing is promised: a client stops."
    return (
        f"Phase 0 (not joined yet) in every cell of the grid, and phase p within {REACH} cells (Chebyshev) of the "
        "waypoints p-1 and p. Outside it the action is -2: a client stops there."
    )


def joint_limits(frame: str, instrument: str, turned: bool, places: int, releasable: bool) -> str:
    """Say what was checked of the arm's joints."""
    if not frame.endswith("_base"):
        return f"Not checked: the frame {frame} is not the base of the arm."
    tool = "as demonstrated" if turned else "assumed to point straight down, for the wrist was not recorded"
    found = "all are within" if releasable else "those that are outside are among the reasons against a release, if any"
    return (
        f"The {places} places of the demonstrated pass were checked in closed form against the limits of a PSM with "
        f"instrument {instrument}, its tool {tool}: {found}. Places that are reached from other starts were not."
    )


def tip_accuracy() -> str:
    """Say how far off a real arm has to be expected."""
    return (
        f"Not known of your arm. A mean tip error of {CALIBRATED_MM:g} mm was measured elsewhere for a dVRK that was "
        f"calibrated, and is what plans are judged under; one that was not may be off by {UNCALIBRATED_MM:g} mm. "
        "docs/replay.md is the checklist before a robot moves."
    )


def resting(plans: int, playbacks: int, feasible_playbacks: int) -> str:
    """Say what was made from a policy."""
    if plans == 0:
        return "No plan follows this version yet."
    follow = "1 plan follows" if plans == 1 else f"{plans} plans follow"
    played = "none was played" if playbacks == 0 else f"of {playbacks} playbacks {feasible_playbacks} were feasible"
    return f"{follow} this version; in simulation, {played}."


def citation(version: PolicyVersion) -> dict[str, str]:
    """Write how a policy version is cited, in words and for BibTeX."""
    surgeon, suture, number, sha256 = version.surgeon.slug, version.suture, version.version, version.sha256
    title = f"Suture style of surgeon {surgeon} (a pseudonym), {suture}: policy version {number}"
    made = f"suture-skills {__version__}"
    sources = " and ".join(
        f"demonstration sha256:{one.sha256} of recording sha256:{one.recording.sha256}"
        for one in version.demonstrations
    )
    fields = {
        "title": f"{{{title}}}",
        "year": f"{version.created_at:%Y}",
        "month": f"{version.created_at.month}",
        "howpublished": f"{made}, policy version sha256:{sha256}",
        "note": f"Learnt from {sources}. Research use only.",
    }
    lines = [f"  {name} = {{{_for_tex(value)}}}" for name, value in fields.items()]
    return {
        "text": f"{title} ({version.created_at:%Y}). {made}. sha256:{sha256}.",
        "bibtex": "\n".join([f"@misc{{{surgeon}-{suture}-v{number}-{sha256[:8]},", ",\n".join(lines), "}"]),
    }


def _for_tex(text: str) -> str:
    """Write text for BibTeX: of what slugs and digests are made of, the underscore alone means something there."""
    return text.replace("_", r"\_")
