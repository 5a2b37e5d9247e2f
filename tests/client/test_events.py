"""Following a job's stream of events, against a service in this process."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import anyio
import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.client import AsyncClient, JobNotOver, ServiceError, StreamEvent
from tests.client.fake_service import client_of, event_stream

STREAM = (
    "retry: 700\n\n"
    ": still here\n\n"
    'id: 3\nevent: started\ndata: {"seq": 3, "said": "a\u2028b\u0085c\rd"}\n\n'.replace("\r", "\\r")
    + 'event: progress\ndata: {"state": "running"}\n\n'
    'event: progress\ndata: {"state": "succeeded"}\n\n'
    'id: 4\r\nevent: succeeded\r\ndata: {"seq": 4}\r\n\r\n'
).encode()
FINAL_PROGRESS = b'event: progress\ndata: {"state": "succeeded"}\n\n'

pytestmark = pytest.mark.anyio


async def followed(client: AsyncClient, **how: float) -> list[StreamEvent]:
    async with client:
        return [event async for event in client.events("job_1", **how)]  # type: ignore[arg-type]


@given(cuts=st.lists(st.integers(0, len(STREAM)), max_size=8))
@settings(deadline=None, max_examples=40)
def test_a_stream_reads_the_same_however_its_bytes_are_cut(cuts: list[int]) -> None:
    marks = [0, *sorted(cuts), len(STREAM)]
    parts = [STREAM[a:b] for a, b in itertools.pairwise(marks)]
    found = anyio.run(followed, client_of(lambda _: event_stream(*parts)))
    assert [(event.kind, event.data) for event in found] == [
        ("started", {"seq": 3, "said": "a\u2028b\u0085c\rd"}),
        ("progress", {"state": "running"}),
        ("progress", {"state": "succeeded"}),
        ("succeeded", {"seq": 4}),
    ]


def streams(*answers: httpx.Response | Exception) -> tuple[Callable[..., httpx.Response], list[str]]:
    """A service that gives these answers in turn, and the ids that it was asked to go on from."""
    asked: list[str] = []
    rest = list(answers)

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.headers["Last-Event-ID"])
        given = rest.pop(0)
        if isinstance(given, Exception):
            raise given
        return given

    return answer, asked


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("biresnerf.client.events._PAUSE_S", 0.001)
    monkeypatch.setattr("biresnerf.client.retries._PAUSE_S", 0.001)


async def test_a_stream_that_breaks_before_its_last_event_is_taken_up_again() -> None:
    answer, asked = streams(
        event_stream(b"id: 7\nevent: stage\ndata: {}\n\n", FINAL_PROGRESS, httpx.ReadError("cut")),
        httpx.ConnectError("away"),
        event_stream(FINAL_PROGRESS, b'id: 8\nevent: succeeded\ndata: {"seq": 8}\n\n'),
    )
    found = await followed(client_of(answer))
    assert [event.kind for event in found] == ["stage", "progress", "progress", "succeeded"]
    assert asked == ["0", "7", "7"]


async def test_a_stream_that_ends_in_order_after_the_jobs_end_is_over() -> None:
    # All events were known before: none is left to come.
    answer, asked = streams(event_stream(FINAL_PROGRESS))
    assert [event.kind for event in await followed(client_of(answer), after=9)] == ["progress"]
    assert asked == ["9"]


async def test_a_stream_that_ends_before_the_job_is_connected_again() -> None:
    answer, asked = streams(
        event_stream(b'id: 2\nevent: progress\ndata: {"state": "running"}\n\n'), event_stream(FINAL_PROGRESS)
    )
    assert len(await followed(client_of(answer))) == 2
    assert asked == ["0", "2"]


async def test_half_a_message_is_none() -> None:
    answer, asked = streams(event_stream(b'id: 5\nevent: stage\ndata: {"a"'), event_stream(FINAL_PROGRESS))
    assert [event.kind for event in await followed(client_of(answer))] == ["progress"]
    assert asked == ["0", "0"]


async def test_a_service_that_stays_away_is_given_up_after_the_patience() -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("away")

    with pytest.raises(ServiceError, match="away"):
        await followed(client_of(answer, patience_s=0.05))


async def test_what_is_no_stream_of_events_is_another_program() -> None:
    with pytest.raises(ServiceError) as caught:
        await followed(client_of(lambda _: httpx.Response(200, html="<p>Log in</p>")))
    assert caught.value.code == "unexpected_answer"


async def test_following_with_a_time_limit_never_waits_longer_for_a_silent_service() -> None:
    async def silent(request: httpx.Request) -> httpx.Response:
        await anyio.sleep(60)
        raise AssertionError("waited for the service")

    with pytest.raises(JobNotOver, match=r"job_1 is not over after 0\.05 s") as caught:
        await followed(client_of(silent), timeout_s=0.05)  # type: ignore[arg-type]
    assert isinstance(caught.value, TimeoutError)


async def test_a_time_limit_holds_between_connections_and_within_one() -> None:
    async def silence() -> None:
        await anyio.sleep(60)

    async def content() -> object:
        yield b'event: progress\ndata: {"state": "running"}\n\n'
        await silence()

    def halting(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, headers={"Content-Type": "text/event-stream"}, content=content())

    def away(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("away")

    for answer in (halting, away):
        with anyio.fail_after(5), pytest.raises(JobNotOver):
            await followed(client_of(answer), timeout_s=0.05)


async def test_a_job_that_ended_in_time_is_over_however_late_that_is_read() -> None:
    kinds = []
    async with client_of(lambda _: event_stream(STREAM)) as client:
        async for event in client.events("job_1", timeout_s=0.05):
            kinds.append(event.kind)
            await anyio.sleep(0.06)
    assert kinds[-1] == "succeeded"
