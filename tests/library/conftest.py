from collections.abc import Iterator
from pathlib import Path

import pytest

from skills.db.session import Database
from tests import backends
from tests.library import cases

# Files, and tests of other files, whose SQL may behave differently on PostgreSQL. All others run on it at night.
ON_BOTH_BY_DAY = {
    *("test_library", "test_erasing", "test_consent"),
    # backups that are restored
    "test_a_demonstration_erased_after_the_backup_leaves_nothing_served",
    "test_a_deleted_recording_that_is_used_again_does_not_block_a_restore",
    "test_a_key_that_was_revoked_stays_revoked",
    "test_the_service_keeps_the_list_up_while_it_runs",
    # outcomes
    "test_the_newest_mark_counts_and_every_mark_says_who_and_why",
    "test_demonstrations_are_listed_by_outcome_with_one_statement",
    "test_a_mark_withdraws_the_releases_that_rest_on_it",
    "test_a_mark_made_while_a_style_is_learnt",
    # cached recordings
    "test_a_large_content_is_stored_in_chunks",
    "test_a_recording_that_is_erased_while_it_is_read_is_not_cached",
    "test_concurrent_first_uses_leave_one_entry",
    "test_erasing_a_surgeon_keeps_anothers_episode_of_one_dataset",
    # datasets
    "test_two_workers_and_a_second_attempt_store_one_dataset",
    "test_consent_withdrawn_during_the_job_stores_nothing",
    "test_everybody_who_can_be_seen_consents",
    "test_erasing_a_surgeon_deletes_the_datasets_with_them",
    "test_erasing_during_the_job_stores_nothing",
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        here = item.path.parent == Path(__file__).parent and "postgresql" in item.name
        if here and not ON_BOTH_BY_DAY & {item.path.stem, item.name.partition("[")[0]}:
            item.add_marker(pytest.mark.nightly)


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a new database with the catalogue and kestrel, on either back end."""
    url = backends.fresh(request.param, tmp_path)
    database = Database(url)
    cases.add_surgeon(database)
    yield database
    database.close()
    backends.drop(url)
