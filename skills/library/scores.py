"""Score a demonstration against a style: how far it lies from the style's own, where, and beside whom.

A score is nothing but arithmetic on what is stored, so it is worked out whenever it is asked for, and not stored: it
takes account of what was added, withdrawn or erased since. For learning by oneself; it is no examination.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, StoredCalibration, StoredRecording, Surgeon
from skills.db.seen import EVERYBODYS
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound
from skills.library import calibrations, releases
from skills.library.beside import USE, agrees, course, others_of, percentiles
from skills.library.catalogue import check_consent, find_surgeon, find_suture_type
from skills.library.demos import Cut, find_demo, newest_demo
from skills.library.recordings import Reader, find_recording, recording_bytes
from skills.style.demo import Demo, cut_demo
from skills.style.evaluation import TIE_BREAK
from skills.style.scoring.deviation import Deviation, as_recorded, in_words, laid_on
from skills.style.scoring.figures import KIND_OF, Figure, Numbers, compare, measure
from skills.style.scoring.model import Predicted, predict

CREDENTIAL = "Research use only. It compares motions, says nothing about a result, and is not a credential."


@dataclass(frozen=True)
class Asked:
    """What is to be scored, a stored demonstration or a part of a stored recording, and against which style."""

    surgeon: str
    suture: str
    demo: str | None = None
    recording: str | None = None
    part: Cut | None = None
    reference: str | None = None


@dataclass(frozen=True, eq=False)
class _Scored:
    """What is scored: its motion, where it comes from, and whose it is where that is known."""

    demo: Demo
    recording: StoredRecording
    row: Demonstration | None = None


def score(database: Database, asked: Asked, read: Reader) -> dict[str, Any]:
    """Score a motion: what a client is told of it.

    Raises:
        NotFound: There is no such surgeon, suture type, demonstration or recording, or nothing of the style.
        BadInput: The demonstration is of another suture type, or the reference of another style.
        BadPath: One of the two ends where it began, so that it has no shape.
        BadRecording: The part asked for is not in the recording.
        Conflict: One of the two was withdrawn, or a consent does not cover being compared.
    """
    with database.reading() as session:
        find_suture_type(session, asked.suture)
        reference, because = _reference(session, asked)
        check_consent(reference.surgeon, USE)
        scored = _stored(session, asked)
        taught = reference.demo
    if scored is None:
        scored = _of_recording(database, asked, read)
    numbers, beside = measure(scored.demo), measure(taught)
    deviation = laid_on(scored.demo, taught)
    with database.reading() as session:
        others = list(others_of(session, asked.suture, deviation.reference_mm))
        calibration = calibrations.newest(session)
    mine = {**numbers, "distance_mm": deviation.distance_mm}
    where = as_recorded(scored.demo, taught)
    row = scored.row
    return {
        "demo": row.sha256 if row else None,
        "recording": scored.recording.sha256,
        "arm": scored.demo.arm,
        "start_s": scored.demo.start_s,
        "end_s": scored.demo.end_s,
        "surgeon": row.surgeon.slug if row else None,
        "style": {"surgeon": asked.surgeon, "suture": asked.suture},
        "reference": {
            "demo": reference.sha256,
            "because": because,
            "is_itself": bool(row and row.row == reference.row),
        },
        "figures": [_figure(one) for one in compare(numbers, beside)],
        "deviation": _deviation(deviation),
        "as_recorded": None if where is None else _deviation(where),
        "tie_break": TIE_BREAK,
        "percentiles": percentiles(others, mine, row, reference),
        "curve": course(others, row),
        "skill": _skill(calibration, numbers),
        "use": CREDENTIAL,
    }


def references(session: Session, suture: str) -> list[Surgeon]:
    """List whose style a demonstration of a suture type can be scored against, experts first: who agreed to it."""
    having = select(Demonstration.surgeon_row).where(
        Demonstration.suture == suture, Demonstration.withdrawn_at.is_(None)
    )
    found = session.scalars(select(Surgeon).where(Surgeon.row.in_(having)).order_by(Surgeon.slug))
    return sorted(filter(agrees, found), key=lambda one: one.skill_level != "expert")


# ---- what is compared with what -----------------------------------------------------------------------------------


def _reference(session: Session, asked: Asked) -> tuple[Demonstration, str]:
    """Find what stands for a style, and say why."""
    surgeon = find_surgeon(session, asked.surgeon)
    if asked.reference is not None:
        named = find_demo(session, asked.reference)
        if (named.surgeon_row, named.suture) != (surgeon.row, asked.suture):
            raise BadInput("The reference is a demonstration of another style; name one of this surgeon and suture.")
        if named.withdrawn_at is not None:
            raise Conflict("The reference was withdrawn; name another, or none.")
        return named, "it was asked for"
    standing = releases.standing(session, surgeon.row, asked.suture)
    if standing:
        policy = standing[0].policy
        more = len(policy.manifest["demos"]) - 1
        rest = f" and {more} more" if more else ""
        return policy.demonstration, f"the released policy, version {policy.version}, was learnt from it{rest}"
    newest = newest_demo(session, surgeon.row, asked.suture)
    if newest is None:
        raise NotFound(f"There is no demonstration of '{asked.surgeon}' and '{asked.suture}' to compare with.")
    return newest, "no policy is released, and it is the newest demonstration"


def _stored(session: Session, asked: Asked) -> _Scored | None:
    """Find the demonstration that is to be scored; None where it is a part of a recording."""
    if asked.demo is None:
        return None
    row = find_demo(session, asked.demo)
    if row.suture != asked.suture:
        raise BadInput("The demonstration is of another suture type than the style.")
    if row.withdrawn_at is not None:
        raise Conflict("This demonstration was withdrawn; it is not compared any more.")
    check_consent(row.surgeon, USE)
    return _Scored(row.demo, row.recording, row)


def _of_recording(database: Database, asked: Asked, read: Reader) -> _Scored:
    """Cut what is to be scored out of a stored recording, and store nothing."""
    assert asked.recording is not None
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            stored = find_recording(session, asked.recording)
            also = select(Demonstration.surgeon_row).where(Demonstration.recording_row == stored.row)
            for surgeon in session.scalars(select(Surgeon).where(Surgeon.row.in_(also)), execution_options=EVERYBODYS):
                _refuse_unseen(surgeon)
            file.writelines(recording_bytes(session, stored))
        recording = read(file, **stored.reading)
    part = asked.part or Cut(asked.surgeon, asked.suture)
    demo = cut_demo(recording, arm=part.arm, topic=part.topic, start_s=part.start_s, end_s=part.end_s)
    return _Scored(demo, stored)


def _refuse_unseen(surgeon: Surgeon) -> None:
    """Check a consent without naming whose it is, for whoever asks may not be allowed to know."""
    try:
        check_consent(surgeon, USE)
    except Conflict:
        raise Conflict("The consent of a surgeon in this recording does not cover being compared.") from None


# ---- what is told -------------------------------------------------------------------------------------------------


def _figure(figure: Figure) -> dict[str, Any]:
    return asdict(figure.kind) | {"value": figure.value, "reference": figure.reference, "ratio": figure.ratio}


def _deviation(found: Deviation) -> dict[str, Any]:
    return {
        "total_mm": found.total_mm,
        "distance_mm": found.distance_mm,
        "dtw_mean_mm": list(found.mean_mm),
        "dtw_std_mm": list(found.std_mm),
        "shares": found.difference.shares.tolist(),
        "offsets_mm": found.difference.offsets.tolist(),
        "words": list(in_words(found)),
        "path_mm": found.path_mm.tolist(),
        "reference_mm": found.reference_mm.tolist(),
        "apart_mm": found.apart_mm.tolist(),
    }


def _skill(calibration: StoredCalibration | None, numbers: Numbers) -> dict[str, Any]:
    """Say what the calibrated model makes of the figures, or why it says nothing."""
    if calibration is None:
        return _uncalibrated("Not calibrated: `skills calibrate FOLDER` learns from rated trials that you have.")
    model = calibrations.read_calibration(calibration)
    predicted = predict(model, numbers)
    if predicted is None:
        missing = ", ".join(KIND_OF[name].label for name in model.figures if numbers[name] is None)
        return _uncalibrated(f"Not rated: the calibrated model needs what was not recorded ({missing}).")
    return {
        "calibrated": True,
        "calibration": calibration.sha256,
        "words": list(_skill_words(calibration.about, predicted)),
        "rating": predicted.rating,
        "interval": list(predicted.interval),
        "levels": dict(predicted.levels),
        "terms": dict(predicted.terms),
        "outside": list(predicted.outside),
    }


def _uncalibrated(why: str) -> dict[str, Any]:
    nothing = dict.fromkeys(("calibration", "rating", "interval", "levels", "terms"))
    return {"calibrated": False, "words": [why], "outside": [], **nothing}


def _skill_words(about: dict[str, Any], predicted: Predicted) -> Iterator[str]:
    data, judged = about["data"], about["validated"]
    rho, chance = judged["all_figures"], judged["chance"]
    low, high = rho["rho_interval"]
    yield (
        f"Calibrated on {data['trials']} rated trials ({data['task']}, each {data['of']}) of {data['surgeons']} "
        f"surgeons. Of a surgeon whom it had not seen, it orders trials with a rank correlation of {rho['rho']:.2f} "
        f"({low:.2f} to {high:.2f}; the duration alone: {judged['duration_only']['rho']:.2f}, chance: "
        f"{chance['rho']:.2f}) and is right about the level in {100 * rho['accuracy']:.0f} % of them "
        f"(chance: {100 * chance['accuracy']:.0f} %)."
    )
    low, high = predicted.interval
    likely = max(predicted.levels, key=predicted.levels.__getitem__)
    yield (
        f"It would rate this motion {predicted.rating:.1f} of 30 (90 %: {low:.1f} to {high:.1f}), and says "
        f"{likely} with a probability of {100 * predicted.levels[likely]:.0f} %."
    )
    if predicted.outside:
        yield "This motion is unlike what it was calibrated on, so do not rely on that: " + " ".join(predicted.outside)
