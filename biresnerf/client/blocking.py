"""`Client`: does what flows ask for, one thing after another, or on several threads where they say so."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

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
from biresnerf.client.http import CHUNK_BYTES, answer_of, broken, redirected, request_of, settings, stopped
from biresnerf.errors import BiresnerfError
from biresnerf.wire.jobs import JobView

P = ParamSpec("P")
T = TypeVar("T")


def _method(flow: Callable[Concatenate[Session, P], Flow[T]]) -> Callable[Concatenate[Client, P], T]:
    """The flow as a method that waits for its outcome."""

    @functools.wraps(flow)
    def method(client: Client, /, *arguments: P.args, **options: P.kwargs) -> T:
        return client.run(flow(client.session, *arguments, **options))

    return method


class Client:
    """Talks to one service. Use as a context manager.

    Every method raises `ServiceError`. What fails for a moment is tried again, with growing pauses or as the service
    asks, for ``patience_s``; what creates something is asked for so that it is created once.
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
        self._http = httpx.Client(**settings(self.url, api_key))

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends all connections."""
        self._http.close()

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

    def events(self, job_id: str, *, after: int = 0, timeout_s: float | None = None) -> Iterator[Happening]:
        """What happens to the job until it is over: each event after that number once, and how far it is.

        Lost connections are taken up again where they broke off, and a service that is away is waited for.

        Raises:
            JobNotOver: it is not over after ``timeout_s``.
        """
        following = Following(self.session, job_id, after, timeout_s)
        while not following.over:
            call = following.connect()
            try:
                with self._opened(call) as response:
                    for chunk in response.iter_raw():
                        yield from following.take(chunk)
                        if following.connect_again:
                            break
                pause_s = following.ended()
            except httpx.TransportError as error:
                pause_s = following.broken(broken(self.url, call, error))
            except ServiceError as error:
                pause_s = following.broken(error)
            time.sleep(pause_s)

    def wait(
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
        for happening in self.events(job_id, timeout_s=timeout_s):
            if on_progress is not None and (job := happening.job) is not None:
                on_progress(job)
        return self.job(job_id)

    def run(self, flow: Flow[T], stop: Event | None = None) -> T:
        """Does what the flow asks for, to its end; ``stop`` ends it early."""
        result: Any = None
        error: Exception | None = None
        try:
            while True:
                effect = flow.send(result) if error is None else flow.throw(error)
                result, error = None, None
                try:
                    result = self._do(effect, stop)
                except (BiresnerfError, OSError) as failure:
                    error = failure
        except StopIteration as end:
            answer: T = end.value
            return answer
        finally:
            flow.close()

    def _do(self, effect: Effect, stop: Event | None) -> Any:
        if stop is not None and stop.is_set():
            raise stopped()
        match effect:
            case Call():
                return self._call(effect)
            case Stream():
                return self._pour(effect, stop)
            case Pause():
                return stop.wait(effect.seconds) if stop is not None else time.sleep(effect.seconds)
            case Work():
                return effect.do()
            case Together():
                return self._together(effect)

    def _call(self, call: Call) -> Answer:
        content = _chunks(call.content) if call.content is not None else None
        try:
            response = self._http.request(**request_of(call, content))
        except httpx.TransportError as error:
            raise broken(self.url, call, error) from None
        self.session.met = True
        return answer_of(response)

    def _pour(self, stream: Stream, stop: Event | None) -> None:
        call: Call | None = stream.call
        try:
            while call is not None:
                with self._opened(call) as response:
                    call = redirected(call, response)
                    if call is None:
                        stream.sink.begin(response.status_code)
                        for chunk in response.iter_raw():
                            stream.sink.take(chunk)
                            if stop is not None and stop.is_set():
                                raise stopped()
        except httpx.TransportError as error:
            raise broken(self.url, stream.call, error) from None

    @contextmanager
    def _opened(self, call: Call) -> Iterator[httpx.Response]:
        with self._http.stream(**request_of(call, None)) as response:
            self.session.met = True
            if response.status_code >= 400:
                response.read()
                answer_of(response)
            yield response

    def _together(self, several: Together) -> None:
        with ThreadPoolExecutor(several.lanes) as lanes:
            running = [lanes.submit(self.run, flow, several.stop) for flow in several.flows]
            try:
                done, _ = wait(running, return_when=FIRST_EXCEPTION)
                for one in done:
                    one.result()
            finally:
                several.stop.set()  # where one failed, or Ctrl-C came, the others end at their next piece
                for one in running:
                    one.cancel()


def _chunks(part: FilePart) -> Iterator[bytes]:
    with part.path.open("rb") as source:
        source.seek(part.start)
        while chunk := source.read(CHUNK_BYTES):
            if part.stop.is_set():
                raise stopped()
            yield chunk
            part.on_bytes(len(chunk))
