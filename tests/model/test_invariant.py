"""The invariant of `tests.model.invariant` over random steps, and over those that once violated it.

A failure prints the steps. `HYPOTHESIS_SEED` is the seed of the long run, 0 by default.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Set

import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test
from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from skills.comparison.distances import Measured
from skills.db.history import History
from skills.db.models import Demonstration, ErasedInterval, MeasuredShape, RecordingSurgeon, Surgeon
from skills.db.packed import pack
from skills.db.session import Database
from skills.library import perform
from skills.library.comparison import measuring
from skills.library.operation import erasure_list, locks
from skills.library.people import erasure
from skills.library.policies import training
from skills.library.recordings import proposals
from tests import backends
from tests.by_day import some
from tests.library import cases
from tests.model.machine import Installation, Step
from tests.model.replaced import in_our_hands
from tests.model.second_machine import within_reach

TRAIN: Step = ("train", "kestrel", cases.SUTURE, "newest", 0, True)
NO_TRAINING: Step = ("agree", "kestrel", frozenset({"atlas", "export"}), None)
FOUND: dict[str, list[Step]] = {
    "a_training_is_asked_for_again_after_a_withdrawal": [TRAIN, ("withdraw", 0), TRAIN],
    "a_batch_is_asked_for_again_after_a_withdrawal": [
        ("retrain", "kestrel", False, True),
        ("withdraw", 0),
        ("retrain", "kestrel", False, True),
    ],
    "consent_ends_while_a_style_is_learnt": [(*TRAIN, (5, NO_TRAINING))],
    "consent_ends_before_a_batch_learns": [("retrain", "kestrel", False, True, (6, NO_TRAINING))],
    "consent_ends_after_a_release": [TRAIN, NO_TRAINING],
    "the_last_day_of_consent_passes": [("agree", "kestrel", None, 0), TRAIN, ("pass_a_day",)],
    "the_served_demonstration_is_erased_after_the_backup": [
        TRAIN,
        ("add_demo", "kestrel", cases.SUTURE, 1),
        TRAIN,
        ("back_up",),
        ("erase_demo", 2),
        ("restore", 0),
    ],
    "a_release_is_withdrawn_after_the_backup": [TRAIN, ("back_up",), ("withdraw", 0), ("restore", 0)],
    "a_release_is_superseded_after_the_backup": [
        TRAIN,
        ("back_up",),
        ("add_demo", "kestrel", cases.SUTURE, 1),
        TRAIN,
        ("restore", 0),
    ],
    "a_demonstration_is_withdrawn_after_the_backup": [("back_up",), ("withdraw_demo", 0), ("restore", 0)],
    "a_served_demonstration_is_marked_after_the_backup": [
        TRAIN,
        ("back_up",),
        ("mark", 0, "failure"),
        ("release", 0),
        ("restore", 0),
        ("release", 0),
    ],
    "a_demonstration_is_marked_while_it_is_learnt": [
        (*TRAIN, (5, ("mark", 0, "failure"))),
        (*TRAIN, None, True),
        ("mark", 0, "recovery"),
        ("retrain", "kestrel", False, True),
    ],
    "a_mark_is_taken_back_and_the_training_asked_for_again": [
        TRAIN,
        ("mark", 0, "failure"),
        TRAIN,
        ("mark", 0, "success"),
        TRAIN,
    ],
    "a_key_is_revoked_after_the_backup": [("make_key", None, None), ("back_up",), ("revoke", 0), ("restore", 0)],
    "consent_is_narrowed_after_the_backup": [("back_up",), NO_TRAINING, ("restore", 0)],
    "a_recording_is_deleted_then_lost_by_a_restore_and_brought_again": [
        ("back_up",),
        ("add_recording", 2),
        ("delete_recording", 2),
        ("restore", 0),
        ("add_demo", "kestrel", cases.SUTURE, 2),
        ("back_up",),
        ("restore", 1),
    ],
    "a_demonstration_is_erased_while_the_atlas_measures": [
        ("add_demo", "kestrel", cases.SUTURE, 1),
        ("atlas", cases.SUTURE, (6, ("erase_demo", 2))),  # before the last transaction, which stores the distance
    ],
    "a_demonstration_is_withdrawn_while_a_plan_follows_it": [TRAIN, ("plan", "kestrel", (2, ("withdraw_demo", 0)))],
    "a_demonstration_is_erased_between_a_tries_check_and_its_cut": [
        ("try", "kestrel", cases.SUTURE, 0, (7, ("erase_demo", 0)))  # heron's is of the same recording
    ],
    "a_try_is_cancelled_before_its_cut": [
        ("add_recording", 1, "kestrel"),
        ("try", "kestrel", cases.SUTURE, 1, (7, ("cancel", -1))),
    ],
    "a_refusing_surgeon_whom_an_upload_names_is_erased": [
        ("agree", "lark", frozenset({"training"}), None),
        ("add_demo", "kestrel", cases.SUTURE, 1),
        ("add_recording", 1, "lark"),
        ("export", 2),
        ("erase_surgeon", "lark"),
        ("export", 2),
    ],
    "a_refusing_surgeons_demonstration_is_erased": [
        ("agree", "heron", frozenset({"training"}), None),
        ("erase_demo", 1),
        ("export", 0),
    ],
    "a_version_is_learnt_after_the_newest_was_erased": [
        ("add_demo", "kestrel", cases.SUTURE, 1),
        TRAIN,
        ("erase_demo", 2),
        TRAIN,
    ],
    "an_older_copy_is_put_back": [
        TRAIN,
        ("copy",),
        ("withdraw", 0),
        ("put_back", 0, False),
        ("put_back", 0, True),
        TRAIN,
    ],
    "the_service_starts_with_another_key": [TRAIN, ("other_key",), ("withdraw", 0), ("verify",)],
    "another_machine_learns_again_and_exports": [TRAIN, ("plan", "kestrel"), ("second_machine",)],
    "a_recording_without_a_demonstration_is_deleted": [("add_recording", 2), ("delete_recording", 2)],
    "a_rejected_proposal_is_opened_and_accepted_after_the_backup": [
        ("add_recording", 3),
        ("decide", "rejected", "The needle fell."),
        ("back_up",),
        ("decide", "open"),
        ("add_demo", "kestrel", cases.SUTURE, 3),
        ("decide", "rejected"),
        ("withdraw_demo", 2),
        ("restore", 0),
        ("decide", "open"),
        ("decide", "rejected"),
        ("delete_recording", 3),
        ("add_recording", 3),
    ],
}


@pytest.fixture(autouse=True)
def hands() -> Iterator[None]:
    with in_our_hands(), within_reach():
        yield


def on(backend: str, without: Set[str] = frozenset()) -> type[Installation]:
    return type("Installation", (Installation,), {"backend": backend, "without": without})


def run(backend: str, number: int, examples: int, steps: int, without: Set[str] = frozenset()) -> None:
    """Take steps; a failure is not shrunk, because that takes longer than reading the steps."""
    how = settings(
        max_examples=examples,
        stateful_step_count=steps,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(seed(number)(on(backend, without)), settings=how)


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_what_is_served_stored_and_answered_obeys_the_invariant(backend: str):
    run(backend, 0, examples=2, steps=15)


@pytest.mark.parametrize("backend", backends.BACKENDS)
@pytest.mark.parametrize("steps", some(FOUND.values(), 2), ids=FOUND)  # each defect has a test of its own by day
def test_the_invariant_holds_where_it_once_did_not(backend: str, steps: list[Step]):
    on(backend).play(*steps)


@pytest.mark.nightly
@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_the_service_obeys_the_invariant_for_2000_steps(backend: str):
    run(backend, int(os.environ.get("HYPOTHESIS_SEED", "0")), examples=40, steps=50)


# ---- the defects for which this test was written, put back one by one ------------------------------------------------


def keep_without_looking(database: Database, measured: Mapping[int, Measured]) -> None:
    """Store distances although a demonstration on the other side of one was erased meanwhile."""
    with database.writing([locks.DISTANCES]) as session:
        rows = session.scalars(select(Demonstration.row).where(Demonstration.row.in_(measured))).all()
        session.execute(delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(rows)))
        kept = [
            {"demonstration_row": row, "version": measuring.VERSION, "measured": pack(measured[row])} for row in rows
        ]
        if kept:
            session.execute(insert(MeasuredShape), kept)


def forget_without_a_trace(session: Session, surgeon: Surgeon) -> None:
    """Delete what names an erased surgeon, and leave nothing that says that somebody is in these recordings."""
    for of in (RecordingSurgeon, ErasedInterval):
        session.execute(delete(of).where(of.surgeon_row == surgeon.row))


PUT_BACK: dict[str, tuple[object, str, Callable[..., object], str]] = {
    "a_repeated_training_releases_nothing": (
        training,
        "_release_again",
        lambda *_: "Nothing.",
        "a_training_is_asked_for_again_after_a_withdrawal",
    ),
    "a_restore_withdraws_nothing_again": (
        erasure_list,
        "withdraw_policies",
        lambda *_: None,
        "a_release_is_withdrawn_after_the_backup",
    ),
    "a_distance_from_an_erased_demonstration_is_stored": (
        measuring,
        "store_shapes",
        keep_without_looking,
        "a_demonstration_is_erased_while_the_atlas_measures",
    ),
    "a_job_goes_on_after_it_was_erased": (
        perform,
        "while_running",
        lambda database, *_: database,
        "a_demonstration_is_erased_between_a_tries_check_and_its_cut",
    ),
    "an_erased_surgeons_refusal_is_forgotten": (
        erasure,
        "_forget_name",
        forget_without_a_trace,
        "a_refusing_surgeon_whom_an_upload_names_is_erased",
    ),
    "an_older_copy_is_served": (History, "compare", lambda *_: None, "an_older_copy_is_put_back"),
    "an_accepted_proposal_may_be_rejected": (
        proposals,
        "_cut_there",
        lambda *_: None,
        "a_rejected_proposal_is_opened_and_accepted_after_the_backup",
    ),
}


@pytest.mark.parametrize("defect", PUT_BACK)
def test_a_defect_can_be_put_back(defect: str):
    """By day, because the tests that put it back run at night."""
    where, name, *_, steps = PUT_BACK[defect]
    assert hasattr(where, name) and steps in FOUND


@pytest.mark.nightly
@pytest.mark.parametrize("defect", PUT_BACK)
def test_a_defect_that_is_put_back_is_found(monkeypatch: pytest.MonkeyPatch, defect: str):
    """Otherwise its steps have lost their meaning, as where the transactions of an atlas are others than before."""
    where, name, instead, steps = PUT_BACK[defect]
    monkeypatch.setattr(where, name, instead)
    with pytest.raises(AssertionError):
        on("sqlite").play(*FOUND[steps])


@pytest.mark.nightly
@pytest.mark.parametrize("defect", PUT_BACK)
def test_random_steps_find_a_defect_that_is_put_back(monkeypatch: pytest.MonkeyPatch, defect: str):
    """Any change of a step draws others, so more than one seed is tried."""
    where, name, instead, _ = PUT_BACK[defect]
    monkeypatch.setattr(where, name, instead)
    assert any(fails(number) for number in range(8))


def fails(number: int) -> bool:
    """Return whether 2000 steps of a seed violate the invariant."""
    try:
        run("sqlite", number, examples=40, steps=50)
    except AssertionError:
        return True
    return False
