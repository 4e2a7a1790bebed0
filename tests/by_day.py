"""The tests that run on PostgreSQL by day, too, and parameters and examples of which some run by day.

A test whose parameter names PostgreSQL is marked `nightly`, unless its file or its name is in `ON_BOTH`: there the SQL,
the locks or the notifications of PostgreSQL decide the result. All others run on SQLite by day and on both at night.
"""

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import settings

ON_BOTH = {
    # the tables, transactions and queries themselves
    *("test_base", "test_changes", "test_query_plans", "test_session", "test_tables"),
    *("test_erasing", "test_a_revoked_key_is_told_no_more_and_signs_of_life_come_meanwhile"),
    "test_the_same_upload_eight_times_at_once_is_one_demonstration",
    "test_the_same_training_eight_times_at_once_is_one_job",
    "test_a_job_performed_twice_makes_one_version",
    "test_a_try_that_was_ended_stores_nothing_more",
    "test_erasure_leaves_no_row_and_events_without_a_name",
    "test_an_upload_that_dies_anywhere_leaves_nothing_to_see_and_is_swept",
    "test_an_erased_surgeons_jobs_are_gone_at_once_and_swept_later",
    "test_a_deleted_recording_is_gone_at_once_and_swept_later",
    # the life of a job; what follows from it runs on PostgreSQL at night
    "test_one_worker",
    "test_whoever_listens_hears_each_stroke_of_the_bell",
    "test_what_is_served_stored_and_answered_obeys_the_invariant",
    # consent
    "test_the_question_is_answered_alike_in_python_and_in_sql",
    "test_consent_withdrawn_during_training_stores_and_releases_nothing",
    "test_in_a_batch_consent_withdrawn_after_its_part_began_is_seen",
    "test_withdrawn_consent_withdraws_releases_and_renewal_restores_none",
    "test_withdrawn_consent_withdraws_a_surgeons_combined_and_other_styles",
    "test_exports_need_export_consent_and_training_needs_training_consent",
    "test_a_consent_acts_at_once_in_both_directions",
    "test_a_surgeon_named_at_the_upload_is_asked_at_every_door",
    "test_erasing_a_surgeon_leaves_their_seconds_for_no_use",
    # releases that other processes are notified of
    "test_a_release_or_withdrawal_in_one_process_takes_effect_in_another",
    "test_also_while_the_line_that_tells_of_changes_is_cut",
    "test_under_load_nothing_is_served_after_its_end_is_acknowledged",
    "test_a_withdrawal_closes_the_session_with_the_reason",
    "test_an_erasure_and_the_end_of_consent_close_the_session",
    "test_a_new_release_is_told_and_changes_nothing",
    # migrations
    "test_up_makes_exactly_the_tables_of_the_models",
    "test_a_migration_that_fails_half_way_leaves_nothing",
    "test_two_services_that_start_together_migrate_once",
    # the history
    "test_the_triggers_note_every_logged_table",
    "test_what_the_service_wrote_is_whole_and_signed",
    "test_signing_and_writing_do_not_wait_for_each_other",
    "test_a_row_written_past_the_service_is_not_logged_for_its_author",
    "test_an_older_copy_that_was_put_back_is_not_served",
    "test_another_key_serves_and_writes_nothing",
    "test_columns_added_to_every_logged_table_keep_every_history",
    # backups that are restored
    "test_a_demonstration_erased_after_the_backup_leaves_nothing_served",
    "test_the_service_keeps_the_list_up_while_it_runs",
    # outcomes
    "test_the_newest_mark_counts_and_every_mark_says_who_and_why",
    "test_a_mark_made_while_a_style_is_learnt",
    # cached recordings
    "test_a_recording_that_is_erased_while_it_is_read_is_not_cached",
    "test_concurrent_first_uses_leave_one_entry",
    # datasets
    "test_two_workers_and_a_second_attempt_store_one_dataset",
    "test_consent_withdrawn_during_the_job_stores_nothing",
    "test_erasing_during_the_job_stores_nothing",
}


def some(values: Iterable[Any], of: int) -> list[Any]:
    """Return parameters of a test, a tuple for several: every `of`-th value runs by day, all of them at night."""
    each = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*one, marks=[pytest.mark.nightly] * (at % of > 0)) for at, one in enumerate(each)]


def examples(at_night: int) -> settings:
    """Return the settings of a law: so many random examples at night, a fifth of them by day, the same in every run."""
    return settings(max_examples=max(at_night // 5, 5) if settings.default.derandomize else at_night)


def mark(items: list[pytest.Item]) -> None:
    """Mark the tests on PostgreSQL that run at night only."""
    for item in items:
        test, _, parameters = item.name.partition("[")
        if "postgresql" in parameters and not ON_BOTH & {item.path.stem, test}:
            item.add_marker(pytest.mark.nightly)
