"""Requests and their failures, against a service in this process."""

from __future__ import annotations

import anyio
import httpx
import pytest

from biresnerf.client import Client, ServiceError
from biresnerf.client.job_calls import with_name
from biresnerf.client.transport import parse, run_together
from biresnerf.wire.jobs import ForkJob, JobView
from tests.client.fake_service import client_of

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "ftp://x", "", "http://"])
def test_an_address_that_is_none_is_refused_before_anything_is_sent(url: str) -> None:
    with pytest.raises(ServiceError) as caught:
        Client(url)
    assert caught.value.code == "bad_url"
    assert caught.value.users_fault


@pytest.mark.parametrize("content", [b"<!doctype html>", b'{"detail": "Not here"}', b"null"])
def test_what_another_program_answers_is_no_answer(content: bytes) -> None:
    with pytest.raises(ServiceError) as caught:
        parse(httpx.Response(200, content=content), JobView)
    assert (caught.value.code, caught.value.retryable) == ("unexpected_answer", False)


async def test_listings_are_read_page_by_page_and_no_further_than_wanted() -> None:
    asked = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(dict(request.url.params))
        return httpx.Response(200, json={"items": [], "next_cursor": "c2" if len(asked) == 1 else None})

    async with client_of(answer) as client:
        assert await client.datasets(limit=300) == []
    assert asked == [{"limit": "200"}, {"limit": "200", "cursor": "c2"}]


async def test_a_request_is_sent_again_where_that_is_harmless_and_only_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("biresnerf.client.retries._PAUSE_S", 0.001)
    asked = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.path)
        if asked.count(request.url.path) < 3:
            raise httpx.ReadError("broken")
        return httpx.Response(204)

    async with client_of(answer) as client:
        await client.delete_job("job_1")
        with pytest.raises(ServiceError, match="No service answers"):
            await client.test_webhook("whk_1")
    assert asked == ["/v1/jobs/job_1"] * 3 + ["/v1/webhooks/whk_1/test"]


async def test_a_service_that_never_answered_is_not_waited_for() -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused")

    with anyio.fail_after(0.4):
        async with client_of(answer, answered=False) as client:
            with pytest.raises(ServiceError, match="refused"):
                await client.job("job_1")


async def test_the_first_failure_cancels_the_rest_and_is_raised_bare() -> None:
    done = []

    async def fails() -> None:
        await anyio.sleep(0.01)
        raise ServiceError("one", "First.")

    async def goes_on() -> None:
        await anyio.sleep(60)
        done.append("never")

    with anyio.fail_after(5), pytest.raises(ServiceError, match=r"First\."):
        await run_together([goes_on, fails, goes_on, goes_on, goes_on])
    assert done == []


@pytest.mark.parametrize("count", [0, 19, 20])
def test_a_job_is_named_unless_its_labels_are_all_taken(count: int) -> None:
    own = {f"label {number}": "x" for number in range(count)}
    labels = ForkJob(labels=with_name(own, "n" * 300)).labels
    assert own.items() <= labels.items()
    assert ("name" in labels) == (count < 20)
    assert with_name({"name": "mine"}, "other") == {"name": "mine"}
