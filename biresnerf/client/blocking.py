"""`Client`: the methods of `AsyncClient`, blocking. They run on an event loop in a thread of the client's own."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Awaitable, Callable, Iterator
from concurrent import futures
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeAlias, TypeVar, Unpack

import anyio
from anyio.from_thread import start_blocking_portal

from biresnerf.client.client import AsyncClient
from biresnerf.client.events import StreamEvent
from biresnerf.client.transport import ClientOptions

P = ParamSpec("P")
T = TypeVar("T")
WAIT_S = 1.0  # at most, before Ctrl-C is noticed
# From the event loop's thread to the calling thread; None is the last one.
_Messages: TypeAlias = SimpleQueue[Any]


def _blocking(
    method: Callable[Concatenate[AsyncClient, P], Awaitable[T]],
) -> Callable[Concatenate[Client, P], T]:
    """The same method of `Client`: same arguments, same documentation, same answer."""

    @functools.wraps(method)
    def blocking(client: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        return client._call(method, arguments, named)

    return blocking


class Client:
    """Talks to one service. Use as a context manager; may be used from several threads.

    Every method raises `ServiceError`. What fails for a moment is retried for ``patience_s``, with growing pauses or
    when the service asks for it; a request that creates something creates it once. Callbacks run in the calling
    thread, and may use the client. Ctrl-C, or an error in a callback, cancels the request under way.
    """

    def __init__(self, url: str, **options: Unpack[ClientOptions]) -> None:
        """See `AsyncClient`; ``on_pause`` is called in the client's own thread."""
        self._client = AsyncClient(url, **options)
        self.url = self._client.url
        stack = ExitStack()
        self._portal = stack.enter_context(start_blocking_portal())
        stack.callback(self._portal.call, self._portal.stop, True)  # ends what other threads still do
        stack.callback(self._portal.call, self._client.close)
        # Also when the client is dropped or the process exits: the loop's thread must not outlive them.
        self._close = weakref.finalize(self, stack.close)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes all connections."""
        self._close()

    ready = _blocking(AsyncClient.ready)
    info = _blocking(AsyncClient.info)
    options = _blocking(AsyncClient.options)
    usage = _blocking(AsyncClient.usage)
    operator = _blocking(AsyncClient.operator)

    create_dataset = _blocking(AsyncClient.create_dataset)
    dataset = _blocking(AsyncClient.dataset)
    datasets = _blocking(AsyncClient.datasets)
    dataset_files = _blocking(AsyncClient.dataset_files)
    send_missing = _blocking(AsyncClient.send_missing)
    send_archive = _blocking(AsyncClient.send_archive)
    fetch_files = _blocking(AsyncClient.fetch_files)
    fetches = _blocking(AsyncClient.fetches)
    finalize = _blocking(AsyncClient.finalize)
    delete_dataset = _blocking(AsyncClient.delete_dataset)

    send = _blocking(AsyncClient.send)
    submit = _blocking(AsyncClient.submit)
    create_job = _blocking(AsyncClient.create_job)
    job = _blocking(AsyncClient.job)
    jobs = _blocking(AsyncClient.jobs)
    wait = _blocking(AsyncClient.wait)
    cancel = _blocking(AsyncClient.cancel)
    deliver = _blocking(AsyncClient.deliver)
    fork = _blocking(AsyncClient.fork)
    delete_job = _blocking(AsyncClient.delete_job)
    log = _blocking(AsyncClient.log)
    create_batch = _blocking(AsyncClient.create_batch)
    batch = _blocking(AsyncClient.batch)
    wait_for_batch = _blocking(AsyncClient.wait_for_batch)
    cancel_batch = _blocking(AsyncClient.cancel_batch)

    artifacts = _blocking(AsyncClient.artifacts)
    download = _blocking(AsyncClient.download)
    download_all = _blocking(AsyncClient.download_all)
    result = _blocking(AsyncClient.result)
    report = _blocking(AsyncClient.report)
    compare = _blocking(AsyncClient.compare)
    images = _blocking(AsyncClient.images)
    share = _blocking(AsyncClient.share)
    export = _blocking(AsyncClient.export)
    exports = _blocking(AsyncClient.exports)
    parts = _blocking(AsyncClient.parts)

    create_webhook = _blocking(AsyncClient.create_webhook)
    webhook = _blocking(AsyncClient.webhook)
    webhooks = _blocking(AsyncClient.webhooks)
    change_webhook = _blocking(AsyncClient.change_webhook)
    delete_webhook = _blocking(AsyncClient.delete_webhook)
    rotate_webhook_secret = _blocking(AsyncClient.rotate_webhook_secret)
    test_webhook = _blocking(AsyncClient.test_webhook)
    deliveries = _blocking(AsyncClient.deliveries)
    delivery = _blocking(AsyncClient.delivery)
    redeliver = _blocking(AsyncClient.redeliver)

    def events(self, job_id: str, *, after: int = 0, timeout_s: float | None = None) -> Iterator[StreamEvent]:
        messages: _Messages = SimpleQueue()

        async def forward() -> None:
            async for event in self._client.events(job_id, after=after, timeout_s=timeout_s):
                messages.put(event)

        future = self._start(forward, messages)
        try:
            while (event := _next(messages)) is not None:
                yield event
            future.result()
        finally:
            future.cancel()

    events.__doc__ = AsyncClient.events.__doc__

    def _call(
        self, method: Callable[..., Awaitable[T]], arguments: tuple[Any, ...], named: dict[str, Any]
    ) -> T:
        messages: _Messages = SimpleQueue()

        def relayed(value: Any) -> Any:
            return functools.partial(_relay, messages, value) if callable(value) else value

        work = functools.partial(
            method,
            self._client,
            *(relayed(value) for value in arguments),
            **{name: relayed(value) for name, value in named.items()},
        )
        scope = self._portal.call(anyio.CancelScope)

        async def cancellable() -> list[T]:
            with scope:
                return [await work()]
            return []

        future: Future[list[T]] | None = None
        try:
            future = self._start(cancellable, messages)
            while (message := _next(messages)) is not None:
                callback, returned = message
                callback()
                self._portal.start_task_soon(returned.set)
        except BaseException:
            # Not by the future: Ctrl-C may come while the work starts, before there is one.
            self._portal.start_task_soon(scope.cancel)
            if future is not None:
                futures.wait([future])  # until its files and connections are closed
            raise
        return future.result()[0]

    def _start(self, work: Callable[[], Awaitable[T]], messages: _Messages) -> Future[T]:
        """Runs ``work`` on the event loop; puts None in the queue at its end."""

        async def run() -> T:
            try:
                return await work()
            finally:
                messages.put(None)

        return self._portal.start_task_soon(run)


async def _relay(messages: _Messages, callback: Callable[..., object], *facts: object) -> None:
    """Has the calling thread run the callback, and waits until it returns."""
    returned = anyio.Event()
    messages.put((functools.partial(callback, *facts), returned))
    await returned.wait()


def _next(messages: _Messages) -> Any:
    """The next message. Python loses a signal that comes just before a wait begins until it ends: none is long."""
    while True:
        with suppress(Empty):
            return messages.get(timeout=WAIT_S)
