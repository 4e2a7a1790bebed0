"""Consent in the library: checked at every storage; an ended consent stops serving everything that depends on it."""

from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import select

from skills.db.models import Release
from skills.db.service_tables import Event
from skills.db.session import Database
from skills.errors import Conflict, NotFound, SkillsError
from skills.formats.parsed import parse_recording
from skills.library.comparison import atlas, scores
from skills.library.operation import styles
from skills.library.people import consent
from skills.library.people.consent import covered, may
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.plans import plans
from skills.library.policies import batches, learning, releases, retraining, versions
from skills.schemas.people import Consent, SurgeonIn
from skills.schemas.scores import ScoreIn
from tests.library import cases
from tests.library.cases import SUTURE
from tests.library.styles import add_styles, ask_retraining, count_versions, counted, parts_of, states_of, styles_of

ALL = {"uses": ["training", "export", "atlas"], "until": None}
NO_TRAINING = {"uses": ["export", "atlas"], "until": None}
TODAY = date(2031, 3, 31)
REALLY_TODAY = consent.today


@pytest.fixture(autouse=True)
def on_one_day(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let it be the same day in every test: a run, or a test, may go on past midnight."""
    monkeypatch.setattr(consent, "today", lambda: TODAY)


def agree(database: Database, to: dict[str, Any] | None, surgeon: str = "kestrel") -> None:
    """Record a surgeon's consent."""
    cases.committed(database, put_surgeon, surgeon, SurgeonIn.model_validate({"consent": to}), "anna")


def served(database: Database) -> int | None:
    """Return the version that kestrel's style serves, None if there is none; all lists of served styles must agree."""
    with database.reading() as session:
        listed = [one.policy.version for one in versions.list_served(session, 10, None)]
        assert [one.version for one in styles.released_styles(session)] == listed
        assert styles.matrix(session).counts["released styles"] == len(listed)
        shown = styles.whole_style(session, "kestrel", SUTURE)
        assert (shown.style.state == "released", shown.served is not None) == (bool(listed), bool(listed))
        assert len(styles.matrix(session, state="released").rows) == len(listed)
        try:
            version = versions.served_release(session, "kestrel", SUTURE).policy.version
        except NotFound:
            assert listed == []
            return None
        assert listed == [version]
        return version


def midway(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, happens: Callable[[], None]) -> None:
    """Run a callback during a function of a module."""
    does = getattr(module, name)

    def interrupted(*given: Any, **named: Any) -> Any:
        done = does(*given, **named)
        happens()
        return done

    monkeypatch.setattr(module, name, interrupted)


# ---- checks at storage


def test_consent_withdrawn_during_training_stores_and_releases_nothing(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    cases.add_demo(database)
    job = cases.ask_training(database, release=True)
    midway(monkeypatch, learning, "learn_policy", lambda: agree(database, NO_TRAINING))
    ended = cases.work(database, job)
    assert ended.state == "failed"
    assert "does not cover training" in ended.error
    assert (count_versions(database), counted(database, Release)) == (0, 0)


def test_in_a_batch_consent_withdrawn_after_its_part_began_is_seen(database: Database, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(retraining, "FEWEST_PARTS", 1)
    styles = add_styles(database, 14)
    first = sum(surgeon == "surgeon-0" for surgeon, _ in styles)  # the others are surgeon-1's
    job = ask_retraining(database, release=True)
    (part,) = parts_of(database, job)
    learnt: list[str] = []
    learn = batches.learn_style

    def withdrawing(lesson: Any, *given: Any) -> Any:
        if not learnt:
            agree(database, NO_TRAINING, "surgeon-1")
        learnt.append(lesson.surgeon.slug)
        return learn(lesson, *given)

    monkeypatch.setattr(batches, "learn_style", withdrawing)
    monkeypatch.setattr(batches, "TOGETHER_S", 60.0)  # on a slow machine too
    cases.work(database, part)
    assert states_of(database, job) == ["done"] * first + ["failed"] * (14 - first)
    assert all("'surgeon-1' does not cover training" in one.reason for one in styles_of(database, job)[first:])
    assert 0 < first < 14
    assert (count_versions(database), counted(database, Release)) == (first, first)


def test_in_a_batch_nobody_learns_from_whom_consent_was_withdrawn_before(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(retraining, "FEWEST_PARTS", 1)
    styles = add_styles(database, 14)
    first = sum(surgeon == "surgeon-0" for surgeon, _ in styles)  # the others are surgeon-1's
    monkeypatch.setattr(batches, "TOGETHER", first)
    job = ask_retraining(database)
    (part,) = parts_of(database, job)
    learnt: list[str] = []
    learn = learning.learn_policy

    def withdrawing(*given: Any, **named: Any) -> Any:
        if not learnt:
            agree(database, NO_TRAINING, "surgeon-1")
        learnt.append("a style")
        return learn(*given, **named)

    monkeypatch.setattr(learning, "learn_policy", withdrawing)
    cases.work(database, part)
    assert (len(learnt), states_of(database, job).count("failed")) == (first, 14 - first)


def test_a_plan_is_not_stored_where_consent_is_withdrawn_while_it_is_made(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    cases.add_demo(database)
    cases.train(database, release=True)
    with monkeypatch.context() as meanwhile:
        midway(meanwhile, plans, "stack", lambda: agree(database, NO_TRAINING))
        with pytest.raises(Conflict, match="does not cover training"):
            cases.add_plan(database)
    assert counted(database, plans.Plan) == 0
    with pytest.raises(Conflict, match="does not cover training"):
        cases.add_plan(database, version=1)
    agree(database, ALL)
    known = cases.add_plan(database, version=1)
    agree(database, NO_TRAINING)
    with pytest.raises(Conflict, match="does not cover training"):
        cases.add_plan(database, version=1)
    with database.reading() as session, pytest.raises(Conflict, match="does not cover training"):
        plans.motion_of(session, known.sha256)


def test_a_release_asks(database: Database):
    cases.add_demo(database)
    cases.train(database)
    agree(database, NO_TRAINING)
    with database.writing() as session, pytest.raises(Conflict, match="does not cover training"):
        releases.release(session, versions.find_version(session, "kestrel", SUTURE, 1), "anna")
    agree(database, {"uses": ["training", "export"], "until": None})
    with database.writing() as session:
        releases.release(session, versions.find_version(session, "kestrel", SUTURE, 1), "anna")
    with database.reading() as session:
        assert versions.served_release(session, "kestrel", SUTURE).policy.version == 1


def test_who_takes_consent_back_while_an_atlas_is_measured_is_not_in_it(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    cases.add_surgeon(database, "heron")
    mine = cases.add_demo(database)
    cases.add_demo(database, cases.hand_off((0.0, 0.0, 2.5)), "heron")
    with monkeypatch.context() as meanwhile:
        midway(meanwhile, atlas, "far_apart", lambda: agree(database, {"uses": ["training"], "until": None}, "heron"))
        found = atlas.atlas_of(database, SUTURE)
    assert [one.id for one in found.demos] == [mine.sha256]
    assert found.left_out.without_consent == 1
    assert "heron" not in repr(found)


def test_consent_withdrawn_during_scoring_returns_no_score(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.add_surgeon(database, "heron")
    cases.add_demo(database)
    scored = cases.add_demo(database, cases.hand_off((0.0, 0.0, 2.5)), "heron")
    asked = ScoreIn(surgeon="kestrel", suture=SUTURE, demo=scored.sha256)
    for surgeon in ("kestrel", "heron"):
        with monkeypatch.context() as meanwhile:
            midway(meanwhile, scores, "laid_on", lambda: agree(database, NO_ATLAS, surgeon))  # noqa: B023
            with pytest.raises(Conflict, match=f"'{surgeon}' does not cover atlas"):
                scores.score(database, asked, parse_recording)
        agree(database, ALL, surgeon)
    assert scores.score(database, asked, parse_recording).figures


NO_ATLAS = {"uses": ["training"], "until": None}

# ---- dependants of consent


def test_withdrawn_consent_withdraws_releases_and_renewal_restores_none(
    database: Database,
):
    cases.add_demo(database)
    cases.train(database, release=True)
    cases.train(database, seed=1, release=True)
    agree(database, {"uses": ["training"], "until": "2999-12-31"})
    assert served(database) == 2
    agree(database, NO_TRAINING)
    assert served(database) is None
    with database.reading() as session:
        assert all(one.withdrawn_at is not None for one in session.scalars(select(Release)))
        withdrawn = select(Event).where(Event.action == "withdraw", Event.object_kind == "policy-version")
        assert [one.actor for one in session.scalars(withdrawn)] == ["anna", "anna"]
        with pytest.raises(NotFound, match=r"is served\. The consent of 'kestrel' does not cover training"):
            versions.served_release(session, "kestrel", SUTURE)
    agree(database, ALL)
    assert served(database) is None
    with database.writing() as session:
        releases.release(session, versions.find_version(session, "kestrel", SUTURE, 1), "anna")
    assert served(database) == 1


def test_consent_serves_to_the_end_of_its_last_day_and_no_longer(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.add_demo(database)
    agree(database, ALL | {"until": TODAY.isoformat()})
    version = cases.train(database, release=True)
    assert served(database) == 1
    monkeypatch.setattr(consent, "today", lambda: TODAY + timedelta(days=1))
    assert served(database) is None
    with database.reading() as session, pytest.raises(NotFound, match=f"expired on {TODAY}"):
        versions.served_release(session, "kestrel", SUTURE)
    with database.writing() as session, pytest.raises(Conflict, match=f"expired on {TODAY}"):
        releases.release(session, versions.find_version(session, "kestrel", SUTURE, version.version), "anna")
    with pytest.raises(Conflict, match=f"expired on {TODAY}"):
        cases.ask_training(database, seed=3)
    with pytest.raises(SkillsError, match=f"expired on {TODAY}"):
        cases.add_plan(database)


def test_extending_consent_in_time_keeps_the_release_and_too_late_does_not(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    cases.add_demo(database)
    agree(database, ALL | {"until": TODAY.isoformat()})
    cases.train(database, release=True)
    later = TODAY + timedelta(days=10)
    agree(database, ALL | {"until": later.isoformat()})
    monkeypatch.setattr(consent, "today", lambda: later)
    assert served(database) == 1
    monkeypatch.setattr(consent, "today", lambda: later + timedelta(days=1))
    assert served(database) is None
    agree(database, ALL)
    assert served(database) is None
    with database.reading() as session:
        assert session.scalars(select(Release)).one().withdrawn_at is not None


def test_other_changes_of_a_surgeon_withdraw_nothing(database: Database):
    cases.add_demo(database)
    cases.train(database, release=True)
    with database.writing() as session:
        put_surgeon(session, "kestrel", SurgeonIn.model_validate({"skill_level": "novice", "consent": ALL}), "anna")
        put_surgeon(
            session, "kestrel", SurgeonIn.model_validate({"consent": {"uses": ["training"], "until": None}}), "anna"
        )
        put_surgeon(session, "kestrel", SurgeonIn.model_validate({"consent": None}), "anna")
    assert served(database) == 1


def test_withdrawn_consent_withdraws_a_surgeons_combined_and_other_styles(database: Database):
    demos = [cases.add_demo(database, cases.hand_off((0.0, 0.0, 1.0 * n))).sha256 for n in range(3)]
    cases.train(database, demos=demos, release=True)
    cases.committed(database, put_surgeon, "heron", SurgeonIn(), "test")
    other = cases.add_demo(database, surgeon="heron")
    cases.train(database, "heron", demos=[other.sha256], release=True)
    agree(database, NO_TRAINING)
    with database.reading() as session:
        assert [one.policy.surgeon.slug for one in versions.list_served(session, 10, None)] == ["heron"]


@pytest.mark.parametrize("until", [None, "2999-12-31", TODAY.isoformat(), (TODAY - timedelta(days=1)).isoformat()])
@pytest.mark.parametrize("uses", [[], ["training"], ["export", "atlas"], ["atlas", "training", "export"], None])
def test_the_question_is_answered_alike_in_python_and_in_sql(
    database: Database, uses: list[str] | None, until: str | None
):
    agree(database, None if uses is None else {"uses": uses, "until": until})
    with database.reading() as session:
        surgeon = find_surgeon(session, "kestrel")
        for use in ("training", "export", "atlas"):
            wanted = uses is None or (use in uses and (until is None or date.fromisoformat(until) >= TODAY))
            found = session.scalar(select(type(surgeon).row).where(covered(use)))
            assert (may(surgeon, use), found == surgeon.row) == (wanted, wanted)


@pytest.mark.parametrize(
    ("uses", "until", "why"),
    [
        ([], None, "The consent of 'kestrel' does not cover training; it covers nothing."),
        (["export", "atlas"], None, "The consent of 'kestrel' does not cover training; it covers export, atlas."),
        (["training"], "2031-03-30", "The consent of 'kestrel' expired on 2031-03-30."),
        (["training"], "2031-03-31", None),
        (["training"], "2031-04-01", None),
        (["training"], None, None),
    ],
)
def test_a_refusal_says_what_the_consent_covers_or_when_it_ended(uses: list[str], until: str | None, why: str | None):
    surgeon = SimpleNamespace(slug="kestrel", consent=Consent.model_validate({"uses": uses, "until": until}))
    assert may(surgeon, "training") is (why is None)
    refused = consent.refusal(surgeon, "training")
    assert (refused and str(refused)) == why
    assert consent.last_day(surgeon.consent) == (None if until is None else date.fromisoformat(until))
    if why is not None:
        with pytest.raises(Conflict):
            consent.require(surgeon, "training")


def test_a_day_ends_in_utc(monkeypatch: pytest.MonkeyPatch):
    for minute, day in ((59, TODAY), (60, TODAY + timedelta(days=1))):
        moment = datetime(2031, 3, 31, 23, tzinfo=UTC) + timedelta(minutes=minute)
        monkeypatch.setattr(consent, "now", lambda moment=moment: moment)
        assert REALLY_TODAY() == day


def test_a_surgeon_of_whom_nothing_was_ever_recorded_covers_everything(database: Database):
    cases.committed(database, put_surgeon, "plain", SurgeonIn(), "test")
    with database.reading() as session:
        plain = find_surgeon(session, "plain")
        assert may(plain, "training")
        assert plain.row in session.scalars(select(type(plain).row).where(covered("training"))).all()
