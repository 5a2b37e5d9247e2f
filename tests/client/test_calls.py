"""How the client waits, tries again and reads, without a service."""

from __future__ import annotations

import email.utils
import inspect
import itertools
import json
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import biresnerf
from biresnerf.client import AsyncClient, Client, JobNotOver, ServiceError
from biresnerf.client.calls import Answer, Patience, Session
from biresnerf.client.errors import retry_after_s
from biresnerf.client.events import SILENCE_S, Following
from biresnerf.client.job_calls import with_name
from biresnerf.wire.jobs import ForkJob, JobView


def public(kind: type) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")}


def test_both_clients_have_the_same_methods_with_the_same_arguments() -> None:
    assert public(Client) == public(AsyncClient)
    for name in public(Client) - {"run"}:
        one, other = (inspect.signature(getattr(kind, name)) for kind in (Client, AsyncClient))
        assert list(one.parameters.values())[1:] == list(other.parameters.values())[1:], name
        assert getattr(Client, name).__doc__, name


def test_a_type_checker_finds_the_type_of_every_argument_and_answer() -> None:
    assert (Path(biresnerf.__file__).parent / "py.typed").is_file()
    for kind, name in itertools.product((Client, AsyncClient), public(Client)):
        signature = inspect.signature(getattr(kind, name))
        untyped = [p.name for p in list(signature.parameters.values())[1:] if p.annotation is p.empty]
        assert (untyped, signature.return_annotation is signature.empty) == ([], False), name


def test_a_method_shows_its_own_arguments() -> None:
    with Client("http://127.0.0.1:9") as client:
        assert list(inspect.signature(client.job).parameters) == ["job_id"]
        assert client.job.__name__ == "job"


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "ftp://x", "", "http://"])
def test_an_address_that_is_none_is_refused_before_anything_is_sent(url: str) -> None:
    with pytest.raises(ServiceError) as caught:
        Client(url)
    assert caught.value.code == "bad_url"
    assert caught.value.users_fault


def test_retry_after_is_seconds_or_a_date() -> None:
    assert retry_after_s("7") == 7.0
    in_a_minute = email.utils.formatdate(time.time() + 60, usegmt=True)
    assert retry_after_s(in_a_minute) == pytest.approx(60, abs=2)
    assert retry_after_s("Wed, 21 Oct 2015 07:28:00 GMT") == 0.0
    assert (retry_after_s("soon"), retry_after_s(None)) == (None, None)


def busy(wait_s: float | None = None, status: int = 503) -> ServiceError:
    return ServiceError("unavailable", "Not now.", status=status, retry_after_s=wait_s)


def test_pauses_grow_to_a_limit_and_begin_anew_after_progress() -> None:
    patience = Patience(Session("http://x", 1000.0, met=True))
    assert [patience.after(busy()) for _ in range(6)] == [0.5, 1.0, 2.0, 4.0, 8.0, 8.0]
    patience.renew()
    assert patience.after(busy()) == 0.5


def test_a_service_that_says_when_is_asked_then_and_one_that_says_too_late_is_not() -> None:
    told = []
    session = Session(
        "http://x", 10.0, on_pause=lambda error, pause: told.append((error.code, pause)), met=True
    )
    assert Patience(session).after(busy(3.0)) == 3.0
    assert told == [("unavailable", 3.0)]
    with pytest.raises(ServiceError):
        Patience(session).after(busy(11.0))


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
    patience = Patience(Session("http://x", 60.0, met=True))
    if worth_it:
        assert patience.after(error, again=again) > 0  # type: ignore[arg-type]
    else:
        with pytest.raises(ServiceError):
            patience.after(error, again=again)  # type: ignore[arg-type]


@pytest.mark.parametrize("content", [b"<!doctype html>", b'{"detail": "Not here"}', b"null"])
def test_what_another_program_answers_is_no_answer(content: bytes) -> None:
    with pytest.raises(ServiceError) as caught:
        Answer(200, {}, content).model(JobView)
    assert (caught.value.code, caught.value.retryable) == ("unexpected_answer", False)


STREAM = (
    "retry: 700\n\n"
    ": still here\n\n"
    'id: 3\nevent: started\ndata: {"seq": 3, "said": "a\u2028b\u0085c\rd"}\n\n'.replace("\r", "\\r")
    + 'event: progress\ndata: {"state": "running"}\n\n'
    'event: progress\ndata: {"state": "succeeded"}\n\n'
    'id: 4\r\nevent: succeeded\r\ndata: {"seq": 4}\r\n\r\n'
).encode()


@given(cuts=st.lists(st.integers(0, len(STREAM)), max_size=8))
def test_a_stream_reads_the_same_however_its_bytes_are_cut(cuts: list[int]) -> None:
    following = Following(Session("http://x", 1.0), "job_1", 0)
    marks = [0, *sorted(cuts), len(STREAM)]
    found = [h for a, b in itertools.pairwise(marks) for h in following.take(STREAM[a:b])]
    assert [(h.kind, h.data) for h in found] == [
        ("started", {"seq": 3, "said": "a\u2028b\u0085c\rd"}),
        ("progress", {"state": "running"}),
        ("progress", {"state": "succeeded"}),
        ("succeeded", {"seq": 4}),
    ]
    assert following.over
    assert following.connect().headers["Last-Event-ID"] == "4"


def test_a_stream_that_breaks_before_its_last_event_is_taken_up_again() -> None:
    following = Following(Session("http://x", 60.0, met=True), "job_1", 0)
    data = json.dumps({"state": "succeeded"})
    list(following.take(f"id: 7\nevent: stage\ndata: {{}}\n\nevent: progress\ndata: {data}\n\n".encode()))
    assert following.broken(ServiceError("unreachable", "x")) > 0
    assert not following.over
    assert following.connect().headers["Last-Event-ID"] == "7"
    # Ended in order, there was no event left to come.
    list(following.take(f"event: progress\ndata: {data}\n\n".encode()))
    assert (following.ended(), following.over) == (0.0, True)


def test_following_with_a_time_limit_never_waits_longer_for_a_silent_service() -> None:
    def following(timeout_s: float | None) -> Following:
        return Following(Session("http://x", 60.0, met=True), "job_1", 0, timeout_s)

    assert following(None).connect().answer_s == following(1000.0).connect().answer_s == SILENCE_S
    assert 19.0 < following(20.0).connect().answer_s <= 20.0
    soon = following(0.05)
    assert soon.connect().answer_s <= 0.05
    assert soon.ended() <= 0.05
    time.sleep(0.05)
    for happens in (soon.connect, soon.ended, lambda: soon.broken(ServiceError("unreachable", "x"))):
        with pytest.raises(JobNotOver, match=r"job_1 is not over after 0\.05 s") as caught:
            happens()
    assert isinstance(caught.value, TimeoutError)


def test_a_job_that_ended_in_time_is_over_however_late_that_is_read() -> None:
    following = Following(Session("http://x", 60.0, met=True), "job_1", 0, 0.05)
    following.connect()
    time.sleep(0.05)
    assert [h.kind for h in following.take(STREAM)][-1] == "succeeded"
    assert (following.connect_again, following.ended()) == (False, 0.0)


def test_a_connection_that_may_be_silent_for_too_long_is_made_anew_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = time.monotonic()
    following = Following(Session("http://x", 60.0, met=True), "job_1", 0, 60.0)
    following.connect()
    assert not following.connect_again
    monkeypatch.setattr(time, "monotonic", lambda: now + 50.0)
    assert following.connect_again
    assert following.connect().answer_s <= 10.01
    assert not following.connect_again


@pytest.mark.parametrize("count", [0, 19, 20])
def test_a_job_is_named_unless_its_labels_are_all_taken(count: int) -> None:
    own = {f"label {number}": "x" for number in range(count)}
    labels = ForkJob(labels=with_name(own, "n" * 300)).labels
    assert own.items() <= labels.items()
    assert ("name" in labels) == (count < 20)
    assert with_name({"name": "mine"}, "other") == {"name": "mine"}
