"""`AsyncClient`: does what flows ask for without blocking an event loop (asyncio's or trio's)."""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

import anyio
import anyio.to_thread
import httpx

from biresnerf.client import dataset_calls, downloads, job_calls, sending, service_calls, submitting
from biresnerf.client.calls import (
    Answer,
    Call,
    Effect,
    FilePart,
    Flow,
    Pause,
    Session,
    Stream,
    Together,
    Work,
)
from biresnerf.client.errors import ServiceError
from biresnerf.client.events import Following, Happening
from biresnerf.client.http import CHUNK_BYTES, answer_of, broken, redirected, request_of, settings
from biresnerf.errors import BiresnerfError
from biresnerf.wire.jobs import JobView

P = ParamSpec("P")
T = TypeVar("T")


def _method(
    flow: Callable[Concatenate[Session, P], Flow[T]],
) -> Callable[Concatenate[AsyncClient, P], Awaitable[T]]:
    """The flow as a method whose outcome is awaited."""

    @functools.wraps(flow)
    async def method(client: AsyncClient, /, *arguments: P.args, **options: P.kwargs) -> T:
        return await client.run(flow(client.session, *arguments, **options))

    return method


class AsyncClient:
    """Talks to one service. Use as an asynchronous context manager.

    The same methods as `biresnerf.client.Client` has, to be awaited; callbacks are called on the event loop.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        patience_s: float = 60.0,
        on_pause: Callable[[ServiceError, float], None] | None = None,
    ) -> None:
        """``on_pause`` hears why, and how many seconds, is waited before something is tried again."""
        self.url = url.rstrip("/")
        self.session = Session(self.url, patience_s, on_pause)
        self._http = httpx.AsyncClient(**settings(self.url, api_key))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends all connections."""
        await self._http.aclose()

    ready = _method(service_calls.ready)
    info = _method(service_calls.info)
    options = _method(service_calls.options)

    create_dataset = _method(dataset_calls.create_dataset)
    dataset = _method(dataset_calls.dataset)
    datasets = _method(dataset_calls.datasets)
    dataset_files = _method(dataset_calls.dataset_files)
    send_missing = _method(sending.send_missing)
    send_archive = _method(sending.send_archive)
    finalize = _method(dataset_calls.finalize)
    delete_dataset = _method(dataset_calls.delete_dataset)

    submit = _method(submitting.submit)
    create_job = _method(job_calls.create_job)
    job = _method(job_calls.job)
    jobs = _method(job_calls.jobs)
    cancel = _method(job_calls.cancel)
    fork = _method(job_calls.fork)
    delete_job = _method(job_calls.delete_job)
    log = _method(job_calls.log)

    artifacts = _method(job_calls.artifacts)
    download = _method(downloads.download)
    download_all = _method(downloads.download_all)
    report = _method(job_calls.report)
    images = _method(job_calls.images)
    share = _method(job_calls.share)
    export = _method(job_calls.export)
    exports = _method(job_calls.exports)

    create_webhook = _method(service_calls.create_webhook)
    webhook = _method(service_calls.webhook)
    webhooks = _method(service_calls.webhooks)
    change_webhook = _method(service_calls.change_webhook)
    delete_webhook = _method(service_calls.delete_webhook)
    rotate_webhook_secret = _method(service_calls.rotate_webhook_secret)
    test_webhook = _method(service_calls.test_webhook)
    deliveries = _method(service_calls.deliveries)
    delivery = _method(service_calls.delivery)
    redeliver = _method(service_calls.redeliver)

    async def events(
        self, job_id: str, *, after: int = 0, timeout_s: float | None = None
    ) -> AsyncIterator[Happening]:
        """What happens to the job until it is over: each event after that number once, and how far it is.

        Lost connections are taken up again where they broke off, and a service that is away is waited for.

        Raises:
            JobNotOver: it is not over after ``timeout_s``.
        """
        following = Following(self.session, job_id, after, timeout_s)
        while not following.over:
            call = following.connect()
            try:
                async with self._opened(call) as response:
                    async for chunk in response.aiter_raw():
                        for happening in following.take(chunk):
                            yield happening
                        if following.connect_again:
                            break
                pause_s = following.ended()
            except httpx.TransportError as error:
                pause_s = following.broken(broken(self.url, call, error))
            except ServiceError as error:
                pause_s = following.broken(error)
            await anyio.sleep(pause_s)

    async def wait(
        self,
        job_id: str,
        on_progress: Callable[[JobView], None] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> JobView:
        """The job once it is over, however it ended; ``on_progress`` hears how far it is.

        Raises:
            JobNotOver: it is not over after ``timeout_s``.
        """
        async for happening in self.events(job_id, timeout_s=timeout_s):
            if on_progress is not None and (job := happening.job) is not None:
                on_progress(job)
        return await self.job(job_id)

    async def run(self, flow: Flow[T]) -> T:
        """Does what the flow asks for, to its end."""
        result: Any = None
        error: Exception | None = None
        try:
            while True:
                effect = flow.send(result) if error is None else flow.throw(error)
                result, error = None, None
                try:
                    result = await self._do(effect)
                except (BiresnerfError, OSError) as failure:
                    error = failure
        except StopIteration as end:
            answer: T = end.value
            return answer
        finally:
            flow.close()

    async def _do(self, effect: Effect) -> Any:
        match effect:
            case Call():
                return await self._call(effect)
            case Stream():
                return await self._pour(effect)
            case Pause():
                return await anyio.sleep(effect.seconds)
            case Work():
                return await anyio.to_thread.run_sync(effect.do)
            case Together():
                return await self._together(effect)

    async def _call(self, call: Call) -> Answer:
        content = _chunks(call.content) if call.content is not None else None
        try:
            response = await self._http.request(**request_of(call, content))
        except httpx.TransportError as error:
            raise broken(self.url, call, error) from None
        self.session.met = True
        return answer_of(response)

    async def _pour(self, stream: Stream) -> None:
        call: Call | None = stream.call
        try:
            while call is not None:
                async with self._opened(call) as response:
                    call = redirected(call, response)
                    if call is None:
                        stream.sink.begin(response.status_code)
                        async for chunk in response.aiter_raw():
                            stream.sink.take(chunk)
        except httpx.TransportError as error:
            raise broken(self.url, stream.call, error) from None

    @asynccontextmanager
    async def _opened(self, call: Call) -> AsyncIterator[httpx.Response]:
        async with self._http.stream(**request_of(call, None)) as response:
            self.session.met = True
            if response.status_code >= 400:
                await response.aread()
                answer_of(response)
            yield response

    async def _together(self, several: Together) -> None:
        failures: list[Exception] = []
        waiting = iter(several.flows)

        async def lane() -> None:
            for flow in waiting:
                try:
                    await self.run(flow)
                except (BiresnerfError, OSError) as failure:
                    failures.append(failure)
                    several.stop.set()
                    tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            for _ in range(several.lanes):
                tasks.start_soon(lane)
        if failures:
            raise failures[0]


async def _chunks(part: FilePart) -> AsyncIterator[bytes]:
    async with await anyio.open_file(part.path, "rb") as source:
        await source.seek(part.start)
        while chunk := await source.read(CHUNK_BYTES):
            yield chunk
            part.on_bytes(len(chunk))
