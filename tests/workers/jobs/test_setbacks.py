"""When a job whose attempts end too early may not be tried again, and what its owner reads then."""

from __future__ import annotations

import pytest

from workers.jobs.setbacks import SETBACKS, crashed_too_often, used_up


@pytest.mark.parametrize("most", [1, 3])
def test_a_job_has_so_many_crashes_three_times_as_many_lost_workers_and_ten_times_as_many_attempts(most: int):
    assert not used_up(10 * most - 1, most - 1, 3 * most - 1, most)
    assert used_up(1, most, 0, most)
    assert used_up(1, 0, 3 * most, most)
    assert used_up(10 * most, 0, 0, most)


def test_an_attempt_that_ended_for_want_of_disk_or_store_counts_as_no_crash():
    assert {cause: setback.counts for cause, setback in SETBACKS.items()} == {
        "worker_lost": "loss",
        "killed": "crash",
        "error": "crash",
        "disk_full": None,
        "store_away": None,
    }


@pytest.mark.parametrize("cause", SETBACKS)
def test_the_owner_reads_what_ended_the_last_attempt(cause):
    error = crashed_too_often(3, cause, "the end of the log")
    assert "3 times" in error.detail
    assert SETBACKS[cause].what in error.detail
    assert (error.hint, error.log_tail) == (SETBACKS[cause].hint, "the end of the log")
    assert crashed_too_often(1, None).detail.startswith("The job was started once ")
