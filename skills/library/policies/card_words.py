"""Sentences of a policy card: the properties that were checked, and those that were not."""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from skills import __version__
from skills.db.models import PolicyVersion
from skills.demonstration.quality import describe_count
from skills.gridworld.domain import REACH
from skills.schemas.cards import Citation, StartCounts
from skills.schemas.demos import DemoReport
from skills.schemas.people import Consent
from skills.verification.arm_errors import CALIBRATED_MM, UNCALIBRATED_MM

USE = "Research use only; not a medical device. Never move an arm by it on or near a person."
IS = [
    "One surgeon's needle hand-off, learnt from one recorded demonstration: for every cell of a grid world the "
    "next of 27 moves, up to the demonstrated goal.",
    "Certified on that grid: every greedy action was compared with exact dynamic programming, and every cell was "
    "tried as a start. The certificate below has the results.",
    "An immutable value: its SHA-256 covers all of its numbers and all measurements on this card.",
]
IS_NOT = [
    "A statement about accuracy: the certificate does not tell how closely a real arm follows its setpoints.",
    "Evidence that the demonstration is a good one, clinically or technically: the policy repeats the demonstration.",
    "A plan of motion: a plan stacks policies at suture points, and has its own simulated playback and verdict.",
    "Validated for use on people, animals or tissue.",
]
NOT_CHECKED = [
    "Tissue, thread and needle: the grid world has none.",
    "Collisions, clearances, speeds and joint velocities: they are judged for a plan, by its playback in simulation.",
    "The turn of the jaw at the hand-off (A2): the policy is the path of the tip; the turn is planned.",
    "Any other arm, frame, instrument or grid than those named here.",
    "A real robot: no figure on this card was measured on one. The study's protocol describes the recording equipment.",
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
        "States at which the rollout is in the same cell as the demonstration at the same step.",
    ),
    (
        "discretisation_rmse_mm",
        "Lost to the grid",
        "mm",
        "RMSE of the recorded samples against the centres of their cells. The other rows compare paths on the "
        "grid and do not include this error.",
    ),
)

DIGESTS = {
    "recording": "SHA-256 of the file's bytes as uploaded (`sha256sum FILE`).",
    "demonstration": "SHA-256 of `digest_of` as canonical JSON: it names recording, style, segment and grid.",
    "reward map": "SHA-256 of the rewards that Algorithm 1 computes for the path; they are computed again to check.",
    "policy": "SHA-256 of `digest_of` as canonical JSON: the description of the policy with the digest of the "
    "demonstration, and the digest of its numbers.",
}
VERIFY = [
    "All of these digests were computed again before this card was written, that of the recording over its "
    "bytes; a difference would have prevented the card.",
    "On the installation, `skills verify` does the same for everything that is stored.",
    "Without the installation: take `lineage` of the JSON card. Canonical JSON has sorted keys, no spaces and ASCII "
    "alone; Python's "
    'json.dumps(digest_of, sort_keys=True, separators=(",", ":")) writes it.',
]


HOW = {
    "medoid": "It follows the demonstration that is closest to all others, as recorded",
    "barycentre": (
        "It follows the path with the least total distance to all (DTW barycentre), which is none of the demonstrations"
    ),
    "corridor": (
        "It follows the middle of those that agree, at each place on the path, which is none of the demonstrations"
    ),
}


def of_several(count: int, how: str) -> list[str]:
    """Return the introduction of a card whose policy was learnt from several demonstrations.

    Args:
        count: The number of demonstrations.
        how: The sentence on how they were combined, see `combined`.
    """
    return [IS[0].replace("one recorded demonstration", f"{count} recorded demonstrations"), how, *IS[1:]]


def combined(said: dict[str, Any], count: int) -> str:
    """Return the sentences on how several demonstrations were combined, and how far each is from the combined path."""
    place = (
        "They were recorded at different places, and were turned and scaled onto each other. " if said["moved"] else ""
    )
    wide = said["width_mm"]
    return (
        f"{HOW[said['kind']]}. {place}The {count} demonstrations are {min(said['apart_mm']):.2f} to "
        f"{max(said['apart_mm']):.2f} mm from it at a place, on average (DTW); the majority of them pass its "
        f"waypoints within {min(wide):.2f} to {max(wide):.2f} mm. On this card the demonstration means this path."
    )


def status(version: int, served: int | None, refused: Sequence[str], was_released: bool) -> str:
    """Return the sentence on whether a version is served, and if not, why."""
    if served == version:
        return "This version is served for this style."
    now = "no version is" if served is None else f"version {served} is"
    if refused:
        return f"It cannot be released: {'; '.join(refused)}. Of this style, {now} released now."
    before = "It was released before" if was_released else "It was never released"
    return f"{before}; of this style, {now} released now."


def consent(given: Consent | None) -> str:
    """Return the sentence on a surgeon's consent; it does not say whether the consent has expired by now."""
    if given is None:
        return "No consent is recorded here; the study's protocol states the permitted uses."
    uses = ", ".join(given.uses) or "nothing"
    return (
        f"Covers {uses}{'' if given.until is None else f', until {given.until}'}; other uses are refused. The protocol "
        "states whether this card may be published."
    )


def demonstration_state(withdrawn_at: datetime | None, outcome: str | None, reason: str | None) -> str:
    """Return the sentences on whether a demonstration is active or withdrawn, and on its outcome if it is known."""
    why = "" if reason is None else f": {reason.rstrip('.')}"
    marked = "" if outcome is None else f" Marked {outcome}{why}."
    if withdrawn_at is None:
        return f"Active.{marked}"
    return (
        f"Withdrawn on {withdrawn_at:%Y-%m-%d} by its surgeon or the lab. No policy that was learnt from it is "
        f"or can be released; do not use this policy.{marked}"
    )


def quality(report: DemoReport) -> list[str]:
    """Return the sentences on a demonstration's quality, and the advice for recording a better one."""
    smooth, clutched = report.log_dimensionless_jerk, report.clutch_presses
    size = " x ".join(f"{side:.1f}" for side in report.extent_mm)
    said = [
        f"{report.duration_s:.2f} s, {report.samples} samples at {report.rate_hz:.0f} Hz; the longest gap is "
        f"{1000 * report.longest_gap_s:.0f} ms.",
        *_dropped(report),
        f"The tip moves {report.path_length_mm:.1f} mm in a box of {size} mm, at {report.speed_median_mm_s:.1f} "
        f"mm/s in the median and {report.speed_peak_mm_s:.1f} mm/s at most; {report.idle_share:.0%} of the time "
        "it is idle.",
        "No press of the clutch is recorded."
        if clutched == 0
        else f"The clutch was pressed {describe_count(clutched)}, {report.clutched_s:.1f} s in all.",
    ]
    if smooth is not None:
        said.append(
            f"Smoothness (log dimensionless jerk): {smooth:.1f}; one smooth stroke has -5.3, a hesitant motion less."
        )
    return said + [f"Advice to the surgeon: {one}" for one in report.advice]


def _dropped(report: DemoReport) -> list[str]:
    """Return the sentence on the samples that were dropped for their stamps; none if there are none."""
    repeated, back = (report.duplicate_stamps, report.backward_stamps)
    if not repeated + back:
        return []
    return [
        f"Samples dropped from the whole recording: {repeated} for repeating a stamp, "
        f"{back} for a stamp that went back."
    ]


def lost(report: DemoReport) -> str:
    """Return the sentences on the precision that a demonstration lost in the grid."""
    x, y, z = report.discretisation_rmse_mm
    crossings = report.revisits
    crossed = "never crosses itself" if crossings == 0 else f"returns to a state {describe_count(crossings)}"
    gaps = report.bridged_cells
    bridged = "each state has a sample" if gaps == 0 else f"{gaps} of the states have no sample and were bridged"
    return (
        f"{report.discretisation_rmse_3d_mm:.2f} mm (RMSE, 3-D; {x:.2f} in x, {y:.2f} in y, {z:.2f} in z). The path "
        f"has {report.path_states} states and {crossed}; {bridged}."
    )


def learner(
    phases: int, settled: bool, rule: dict[str, Any] | None, outcomes: Sequence[str | None] | None, marked: bool
) -> str:
    """Return the sentences on a learner's state, convergence and ties, and on the outcomes it learnt from.

    Args:
        phases: The number of phases of its state.
        settled: Whether learning converged.
        rule: The rule among equally good actions (`schemas.policies.Policy.ties`); None is the lowest index.
        outcomes: Of a training from demonstrations of any outcome: that of each as it was then.
        marked: Whether one of its demonstrations is marked with an outcome now.
    """
    state = (
        "Its state is the cell and the phase (how far along the demonstration), so a path that crosses itself can be "
        "followed."
        if phases > 1
        else "Its state is the cell alone, as in the paper, so a path that crosses itself cannot be followed."
    )
    ended = "It ended when the values no longer changed." if settled else "It ended before it had converged."
    ended = f"{ended} {ties(rule)}"
    same = "The same demonstration, settings, seed and learner version give the same numbers."
    if outcomes is None:
        none = " When it was learnt, no demonstration of it was marked recovery or failure." if marked else ""
        return f"{state} {ended} {same}{none}"
    known = ", ".join("not known" if one is None else one for one in outcomes)
    return f"{state} {ended} {same} It was asked to learn from any outcome; that of its demonstrations was: {known}."


def ties(rule: dict[str, Any] | None) -> str:
    """Return the sentence on the rule among equally good actions, as the manifest states it."""
    if rule is None:
        return "Of equally good actions it takes the one with the lowest index."
    along, depth = rule["depth_along"], "depth is not compared, because the frame is not the base of the arm"
    if rule["depth_from_mm"] is not None:
        depth = "depth is the distance from the remote centre"
    if along is not None:
        depth = "depth is measured along ({:g}, {:g}, {:g})".format(*along)
    return (
        "Of equally good actions it takes the one on the shortest way to the path, then the one that goes least deep, "
        f"then the one that joins the path earliest; {depth}."
    )


def coverage(counts: StartCounts, stated: dict[str, Any]) -> str:
    """Return the sentences on how much of the demonstration the starts follow, and how many reach the goal and how."""
    reach, starts = counts.follow + counts.reach_otherwise, stated["n_states"]
    share = (
        f"From a start the policy follows {stated['mean_share']:.0%} of the demonstration's moves on average, in the "
        f"median {stated['median_share']:.0%}; from {stated['starts_goal_alone']} of {starts} starts it goes to the "
        "goal alone."
    )
    if counts.follow == starts:
        return (
            f"{share} All starts join the demonstration in the fewest moves that the joining rule allows, and follow "
            "it to the goal."
        )
    return (
        f"{share} {reach} of {starts} starts reach the goal. {counts.follow} join the demonstration in the fewest "
        f"moves that the joining rule allows and follow it from there; {counts.reach_otherwise} reach it in another "
        "way."
    )


def bodies(scene: dict[str, Any]) -> str:
    """Return the parts of a scene in words, from its JSON."""
    boxes, capsules = len(scene["boxes"]), len(scene["capsules"])
    parts = [f"{boxes} {'box' if boxes == 1 else 'boxes'}"] if boxes else []
    parts += [f"{capsules} {'capsule' if capsules == 1 else 'capsules'}"] if capsules else []
    parts += ["tissue"] if scene["tissue"] is not None else []
    return ", ".join(parts) or "nothing"


def in_scene(scene: dict[str, Any], slip: float) -> str:
    """Return the sentences on the scene that a policy was learnt in, and on its odds there.

    Args:
        scene: The JSON of `schemas.policies.PolicyScene`.
        slip: The slip that it was learnt with.
    """
    near, all_starts = scene["near"], scene["certificate"]
    return (
        f"It was learnt in a scene ({bodies(scene['scene'])}; SHA-256 {scene['sha256'][:12]}) with a slip of "
        f"{slip:.0%}. There a pass finishes with a probability of at least {near['finishing']:.1%} and touches with at "
        f"most {near['touching']:.1%} from the {near['starts']} allowed starts near the demonstrated one; over all "
        f"{all_starts['starts']} allowed starts with {all_starts['mean_finishing']:.1%} and "
        f"{all_starts['mean_touching']:.1%} on average, {all_starts['least_finishing']:.1%} and "
        f"{all_starts['most_touching']:.1%} at worst."
    )


def not_checked(scene: dict[str, Any] | None) -> list[str]:
    """Return the properties that were not checked, of a policy learnt in a scene or in none (None)."""
    if scene is None:
        return NOT_CHECKED
    return [
        "Thread, needle and the arm's body: in the scene the tip alone was checked, between the centres of cells.",
        "Any other scene: with the tissue elsewhere, or the pass at another place, the odds do not hold.",
        *NOT_CHECKED[1:],
    ]


def domain(phases: int) -> str:
    """Return the sentences on the certified domain of a policy."""
    if phases == 1:
        return "Every cell of the grid, in its one phase. Outside the grid nothing is certified: a client must stop."
    return (
        f"Phase 0 (not joined yet) in every cell of the grid, and phase p within {REACH} cells (Chebyshev) of the "
        "waypoints p-1 and p. Outside it the action is -2: a client must stop there."
    )


def joint_limits(manifest: dict[str, Any], turned: bool) -> str:
    """Return the sentences on the check of the demonstrated pass against the arm's joint limits."""
    frame = manifest["frame"]
    if not frame.endswith("_base"):
        return f"Not checked: the frame {frame} is not the base of the arm."
    tool = "as demonstrated" if turned else "assumed to point straight down, because the wrist was not recorded"
    arm = f"a PSM with instrument {manifest['instrument']}, its tool {tool}"
    driven = manifest["grid_certificate"]["driven"]
    if driven is None:
        return "Not checked: the demonstrated pass cannot be driven."
    what = (
        "the path fitted to the recording"
        if driven["path"] == "fitted"
        else "the path through the centres of its cells"
    )
    nearest, inside = driven["nearest_limit"], driven["samples"] - driven["beyond"]
    closest = (
        "one of them cannot be reached with any joints"
        if nearest["margin"] is None
        else f"the nearest limit is that of {nearest['joint']}, {nearest['margin']:.3g} {nearest['unit']} away "
        "(negative: beyond it)"
    )
    return (
        f"The demonstrated pass as it is driven, {what}, was checked in closed form against the limits of {arm}: "
        f"{inside} of {driven['samples']} positions are within them, and {closest}. Of the centres of its cells, "
        f"which a rollout names, {driven['cell_centres_beyond']} are beyond. Positions that are reached from "
        "other starts were not checked."
    )


def tip_accuracy() -> str:
    """Return the sentences on the tip error to expect of a real arm."""
    return (
        f"Not known for your arm. Mean tip errors of {CALIBRATED_MM:g} mm were measured elsewhere for a "
        f"calibrated dVRK, and of {UNCALIBRATED_MM:g} mm for an uncalibrated one. A plan is judged under the errors "
        "that the laboratory states for its arms (docs/errors.md), and those of an uncalibrated arm where it states "
        "none. docs/replay.md has the checklist before a robot moves."
    )


def resting(plans: int, playbacks: int, feasible_playbacks: int) -> str:
    """Return the sentence on the plans and playbacks that follow a version."""
    if plans == 0:
        return "No plan follows this version yet."
    follow = "1 plan follows" if plans == 1 else f"{plans} plans follow"
    played = "none was played" if playbacks == 0 else f"of {playbacks} playbacks {feasible_playbacks} were feasible"
    return f"{follow} this version; in simulation, {played}."


def citation(version: PolicyVersion) -> Citation:
    """Return the citation of a policy version, as text and as BibTeX."""
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
    return Citation(
        text=f"{title} ({version.created_at:%Y}). {made}. sha256:{sha256}.",
        bibtex="\n".join([f"@misc{{{surgeon}-{suture}-v{number}-{sha256[:8]},", ",\n".join(lines), "}"]),
    )


def _for_tex(text: str) -> str:
    """Escape text for BibTeX: of the characters in slugs and digests, only the underscore is special in TeX."""
    return text.replace("_", r"\_")
