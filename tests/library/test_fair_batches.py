"""Comparison in a batch: trained and released policy on the same demonstrations, of which the number is kept."""

from math import nan
from typing import Any

import numpy as np
import pytest

from skills.db.models import PolicyVersion
from skills.db.session import Database
from skills.gridworld.grid import GridPath, GridWorld
from skills.library.policies import batches, fit, releases, versions
from skills.library.policies.fit import compare_versions, not_worse
from skills.library.recordings.demos import withdraw_demo
from skills.schemas.demos import DemoIn
from skills.schemas.training import FitOnTheSame
from tests.library import cases
from tests.library.styles import retrain, styles_of

SWERVES_MM = (0.0, 3.0, 14.0)  # the newest is the outlier


def demos(database: Database, *swerves_mm: float) -> list[str]:
    """Store the hand-off with swerves of different sizes; a shift alone would be removed by the alignment."""
    straight = cases.points_mm()
    bend = np.sin(np.linspace(0, np.pi, len(straight)))[:, None] * np.array([0.0, 1.0, 0.3])
    return [cases.add_demo(database, cases.table(straight + mm * bend)).sha256 for mm in swerves_mm]


def compared(database: Database, **asked: Any) -> dict[str, Any]:
    """Train and release kestrel's style in a batch, and return its comparison."""
    (style,) = styles_of(database, retrain(database, surgeon="kestrel", release=True, **asked))
    assert style.state == "done", style.reason
    return style.comparison


def served(database: Database) -> PolicyVersion:
    with database.reading() as session:
        return versions.served_release(session, "kestrel", cases.SUTURE).policy


def test_a_policy_of_three_demos_is_retrained_on_the_newest_three(database: Database):
    three = demos(database, *SWERVES_MM)
    cases.train(database, demos=three, release=True)
    (newest,) = demos(database, 5.0)
    comparison = compared(database)
    assert comparison.trained.demos == (*three[1:], newest)
    assert (comparison.released.rests_on, comparison.trained.rests_on) == (3, 3)
    assert comparison.on_the_same.demos == (*three, newest)
    with database.reading() as session:
        trained = versions.find_by_digest(session, comparison.trained.sha256)
        before = versions.find_by_digest(session, comparison.released.sha256)
        assert trained.manifest.combined.kind == before.manifest.combined.kind == "corridor"
        found = compare_versions(session, before, trained)
    assert comparison.on_the_same == found
    assert comparison.now_released == not_worse(found) == (served(database).sha256 == trained.sha256)


@pytest.mark.parametrize(
    ("before_mm", "added_mm", "better"),
    [((0.0, 0.4, 0.8), (14.0, 14.4), False), ((14.0, 14.4, 0.0), (0.4, 0.8), True)],
    ids=["the two newest of three go astray", "the two newest of three return"],
)
def test_three_replace_three_only_where_they_follow_all_five_better(
    before_mm: tuple[float, ...], added_mm: tuple[float, ...], better: bool, database: Database
):
    """Of five demonstrations three agree, and whichever policy follows these is nearer to all five."""
    three = demos(database, *before_mm)
    cases.train(database, demos=three, release=True)
    old = served(database).sha256
    added = demos(database, *added_mm)
    comparison = compared(database)
    assert comparison.trained.demos == (three[2], *added)
    assert (comparison.released.rests_on, comparison.trained.rests_on) == (3, 3)
    fit = comparison.on_the_same
    assert fit.demos == (*three, *added)
    nearer, further = sorted((fit.released_mm, fit.trained_mm))
    assert further > 1.2 * nearer
    assert (fit.trained_mm < fit.released_mm) == comparison.now_released == better
    assert (served(database).sha256 == old) != better
    assert len(served(database).manifest.demos) == 3
    if not better:
        (why,) = comparison.worse_because
        assert why.startswith("DTW ") and why.endswith("on the same 5 demonstrations")


def test_a_policy_of_the_newest_alone_does_not_replace_one_of_three(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    """This is a batch that was running when somebody released a policy of three."""
    three = demos(database, *SWERVES_MM)
    commit = batches._commit

    def released_before(*given: Any) -> bool:
        monkeypatch.setattr(batches, "_commit", commit)
        cases.train(database, demos=three, release=True)
        return commit(*given)

    monkeypatch.setattr(batches, "_commit", released_before)
    comparison = compared(database)
    assert (comparison.released.rests_on, comparison.trained.rests_on) == (3, 1)
    assert comparison.on_the_same.demos == tuple(three)
    assert comparison.on_the_same.trained_mm > comparison.on_the_same.released_mm > 0
    assert comparison.trained.dtw_total_mm == 0, "against its own it is always the nearest"
    assert not comparison.now_released
    assert "on the same 3 demonstrations" in comparison.not_released_because
    assert "it was learnt from 1 of them, the released one from 3" in comparison.not_released_because
    assert len(served(database).manifest.demos) == 3


def test_one_released_while_the_comparison_was_computed_is_compared_anew(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    three = demos(database, *SWERVES_MM)
    cases.train(database, demos=three[:1], release=True)
    measure = batches._measured

    def released_after(*given: Any) -> Any:
        found = measure(*given)
        monkeypatch.setattr(batches, "_measured", measure)
        cases.train(database, demos=three, release=True)
        return found

    monkeypatch.setattr(batches, "_measured", released_after)
    comparison = compared(database)
    assert (comparison.released.rests_on, comparison.now_released) == (3, False)


def test_an_equally_distant_newer_demo_replaces_the_older_one(database: Database):
    older, newer = demos(database, *SWERVES_MM[:2])
    cases.train(database, demos=[older], release=True)
    comparison = compared(database)
    same = comparison.on_the_same
    assert same.demos == (older, newer)
    assert same.trained_mm == pytest.approx(same.released_mm, abs=1e-6) and same.trained_mm > 0
    assert comparison.now_released


def test_a_style_whose_demos_cannot_be_combined_fails_and_stays_served(database: Database):
    three = demos(database, *SWERVES_MM)
    cases.train(database, demos=three, release=True)
    other = cases.upload_demo(
        database,
        cases.upload(cases.bag("PSM1"), "application/vnd.mcap"),
        DemoIn(surgeon="kestrel", suture=cases.SUTURE),
        "test",
    )[0]
    assert other.arm == "PSM1"
    version = served(database).version
    (style,) = styles_of(database, retrain(database, surgeon="kestrel", release=True))
    assert style.state == "failed"
    assert "only demonstrations of one arm" in style.reason
    assert served(database).version == version


@pytest.mark.parametrize("totals_mm", [(1.0, nan), (nan, 1.0), (nan, nan), (1.0, 1.1)])
def test_what_cannot_be_compared_is_worse(totals_mm: tuple[float, float]):
    assert not not_worse(FitOnTheSame(("a",), *totals_mm))


def test_in_another_frame_nothing_is_compared():
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), fit.np.array([0, 1, 2]))
    ways = [fit.StylePath("b" * 64, ("PSM2", frame), path.tip_mm) for frame in ("PSM2_base", "jigsaws")]
    one = fit.StylePath("a" * 64, ("PSM2", "PSM2_base"), path.tip_mm)
    found = fit.compare_paths(*ways, [one])
    assert (not_worse(found), found.released_mm, found.trained_mm) == (False, None, None)
    assert not_worse(fit.compare_paths(ways[0], ways[0], [one]))
    assert not not_worse(fit.compare_paths(ways[0], ways[0], []))


def test_the_gate_of_a_cell_policy_compares_on_the_same_demonstrations_too(database: Database):
    """A cell policy that follows its own demonstration well may be far from the released policy's one."""
    three = demos(database, *SWERVES_MM)
    cases.train(database, demos=three, release=True)
    trained = cases.train(database, demos=three[:1], learner=cases.PUBLISHED)
    with database.writing() as session:
        version = versions.find_by_digest(session, trained.sha256)
        found = compare_versions(session, versions.served_release(session, "kestrel", cases.SUTURE).policy, version)
        assert found.demos == tuple(three)
        with pytest.raises(releases.Conflict) as refused:
            releases.release(session, version, "test")
    worse = f"({found.trained_mm:g} against {found.released_mm:g} mm on the same 3)"
    assert (worse in str(refused.value)) == (not not_worse(found))


def test_a_demonstration_that_was_withdrawn_is_not_compared_with(database: Database):
    three = demos(database, *SWERVES_MM)
    first, second = cases.train(database, demos=three[:1]), cases.train(database, demos=three[1:2])
    cases.committed(database, withdraw_demo, three[0], "test")
    with database.reading() as session:
        pair = [versions.find_by_digest(session, one.sha256) for one in (first, second)]
        assert compare_versions(session, *pair).demos == (three[1],)
