"""When and how long the client waits before it tries again, without a service."""

from __future__ import annotations

import email.utils
import time

import pytest

from biresnerf.client import ServiceError
from biresnerf.client.retries import Retries, RetryPolicy
from biresnerf.wire.retry_after import retry_after_s


def test_retry_after_is_seconds_or_a_date() -> None:
    assert retry_after_s("7") == 7.0
    in_a_minute = email.utils.formatdate(time.time() + 60, usegmt=True)
    assert retry_after_s(in_a_minute) == pytest.approx(60, abs=2)
    assert retry_after_s("Wed, 21 Oct 2015 07:28:00 GMT") == 0.0
    assert (retry_after_s("soon"), retry_after_s(None)) == (None, None)


def busy(wait_s: float | None = None, status: int = 503) -> ServiceError:
    return ServiceError("unavailable", "Not now.", status=status, retry_after_s=wait_s)


def test_pauses_grow_to_a_limit_and_begin_anew_after_progress() -> None:
    retries = Retries(RetryPolicy(1000.0, answered=True))
    assert [retries.pause_after(busy()) for _ in range(6)] == [0.5, 1.0, 2.0, 4.0, 8.0, 8.0]
    retries.progressed()
    assert retries.pause_after(busy()) == 0.5


def test_a_service_that_says_when_is_asked_then_and_one_that_says_too_late_is_not() -> None:
    told = []
    policy = RetryPolicy(10.0, on_pause=lambda error, pause: told.append((error.code, pause)), answered=True)
    assert Retries(policy).pause_after(busy(3.0)) == 3.0
    assert told == [("unavailable", 3.0)]
    with pytest.raises(ServiceError):
        Retries(policy).pause_after(busy(11.0))


@pytest.mark.parametrize(
    ("error", "again", "worth_it"),
    [
        (busy(), "always", True),
        (busy(status=429), "undone", True),  # refused: nothing was done
        (busy(status=502), "always", True),
        (busy(status=502), "undone", False),  # it may have been done
        (ServiceError("unreachable", "x"), "always", True),
        (ServiceError("unreachable", "x"), "undone", False),
        (ServiceError("unreachable", "x", untouched=True), "undone", True),
        (ServiceError("idempotency_in_progress", "x", status=409), "always", True),
        (ServiceError("result_not_ready", "x", status=409), "always", False),
        (ServiceError("not_found", "x", status=404), "always", False),
        (ServiceError("internal_error", "x", status=500), "always", False),
    ],
)
def test_what_is_tried_again(error: ServiceError, again: str, worth_it: bool) -> None:
    retries = Retries(RetryPolicy(60.0, answered=True))
    if worth_it:
        assert retries.pause_after(error, again=again) > 0  # type: ignore[arg-type]
    else:
        with pytest.raises(ServiceError):
            retries.pause_after(error, again=again)  # type: ignore[arg-type]
