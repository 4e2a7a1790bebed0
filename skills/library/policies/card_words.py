"""Sentences of a policy card: the properties that were checked, and those that were not.

Those with numbers are macros of the template beside this file; `sentence` and `sentences` render one.
"""

import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from skills import __version__
from skills.db.models import PolicyVersion
from skills.demonstration.quality import describe_count
from skills.schemas.cards import Citation
from skills.schemas.policies import PolicyScene

USE = "Research use only; not a medical device. Never move an arm by it on or near a person."
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


@cache
def _macros() -> Any:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        autoescape=False,  # noqa: S701 - plain text, which pages escape
    )
    environment.filters |= {"times": describe_count, "share": lambda share: f"{share:.1%}"}
    return environment.get_template("card.jinja").module


def sentence(macro: str, *facts: Any) -> str:
    """Return the text of a macro."""
    return " ".join(str(getattr(_macros(), macro)(*facts)).split())


def sentences(macro: str, *facts: Any) -> list[str]:
    """Return the sentences of a macro, which blank lines separate."""
    found = re.split(r"\n\s*\n", str(getattr(_macros(), macro)(*facts)))
    return [text for one in found if (text := " ".join(one.split()))]


def not_checked(scene: PolicyScene | None) -> list[str]:
    """Return the properties that were not checked, of a policy learnt in a scene or in none (None)."""
    if scene is None:
        return NOT_CHECKED
    return [
        "Thread, needle and the arm's body: in the scene the tip alone was checked, between the centres of cells.",
        "Any other scene: with the tissue elsewhere, or the pass at another place, the odds do not hold.",
        *NOT_CHECKED[1:],
    ]


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
