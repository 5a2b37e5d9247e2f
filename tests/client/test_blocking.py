"""The blocking client against the asynchronous one, and what Ctrl-C and callbacks do to it."""

from __future__ import annotations

import _thread
import inspect
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest

import biresnerf
from biresnerf.client import AsyncClient, Client, ServiceError
from biresnerf.client.uploads import LocalFile
from biresnerf.wire.datasets import DatasetView
from tests.client.fake_service import URL, client_of, event_stream

JOB_URL = f"{URL}/v1/jobs/job_1"


def public(kind: type) -> set[str]:
    return {name for name in dir(kind) if not name.startswith("_")}


def test_both_clients_have_the_same_methods_with_the_same_arguments() -> None:
    assert public(Client) == public(AsyncClient)
    for name in public(Client):
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


Answer = Callable[[httpx.Request], httpx.Response] | Callable[[httpx.Request], Awaitable[httpx.Response]]


@contextmanager
def blocking(answer: Answer) -> Iterator[Client]:
    with Client(URL) as client:
        client._client._http = client_of(answer)._http  # type: ignore[arg-type]
        client._client._policy.answered = True
        yield client


async def busy(request: httpx.Request) -> httpx.Response:
    """Nothing comes back."""
    stuck.set()
    try:
        await anyio.sleep(600)
    finally:
        ended.set()
    raise AssertionError


stuck, ended = threading.Event(), threading.Event()


@pytest.fixture(autouse=True)
def nothing_yet() -> None:
    stuck.clear()
    ended.clear()


def test_ctrl_c_ends_a_call_at_once_and_the_client_goes_on() -> None:
    answers: list[Answer] = [busy, lambda _: httpx.Response(204)]

    async def answer(request: httpx.Request) -> httpx.Response:
        found = answers.pop(0)(request)
        return await found if inspect.isawaitable(found) else found

    def interrupt() -> None:
        stuck.wait(60)
        os.kill(os.getpid(), signal.SIGINT)

    with blocking(answer) as client:
        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            client.job("job_1")
        thread.join()
        assert ended.wait(60)  # not left behind on the event loop
        client.delete_job("job_1")


def test_ctrl_c_just_before_a_wait_begins_is_noticed() -> None:
    """Its handler has set a flag that Python reads between two instructions, but no signal ends the wait."""

    def interrupt() -> None:
        stuck.wait(60)
        time.sleep(0.5)  # until the call waits
        _thread.interrupt_main()

    with blocking(busy) as client:
        threading.Thread(target=interrupt).start()
        with pytest.raises(KeyboardInterrupt):
            client.job("job_1")
        assert ended.wait(60)


def test_ctrl_c_while_a_call_starts_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    with blocking(busy) as client:
        start = client._start

        def interrupted(*given: Any) -> Any:
            start(*given)
            assert stuck.wait(60)
            raise KeyboardInterrupt

        monkeypatch.setattr(client, "_start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            client.job("job_1")
        assert ended.wait(60)


def test_closing_a_client_ends_what_another_thread_waits_for() -> None:
    failures: list[BaseException] = []

    def ask() -> None:
        try:
            client.job("job_1")
        except BaseException as error:  # noqa: BLE001
            failures.append(error)

    with blocking(busy) as client:
        thread = threading.Thread(target=ask)
        thread.start()
        assert stuck.wait(60)
    thread.join(60)
    assert not thread.is_alive()
    assert len(failures) == 1


def lacking(*names: str) -> DatasetView:
    return DatasetView.model_construct(id="ds_1", missing=names)


def test_callbacks_run_in_the_calling_thread_and_may_use_the_client(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    file = LocalFile.at("a", tmp_path / "a")
    seen: list[tuple[int, str]] = []

    def answer(request: httpx.Request) -> httpx.Response:
        return httpx.Response(204)

    with blocking(answer) as client:
        dataset = lacking("a")

        def count(more: int) -> None:
            client.delete_job("job_1")
            seen.append((more, threading.current_thread().name))

        assert client.send_missing(dataset, [file], count) == 1
    assert seen == [(3, threading.current_thread().name)]


def test_an_error_in_a_callback_ends_the_call_before_the_next_request(tmp_path: Path) -> None:
    asked = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.url.path)
        return httpx.Response(204)

    for name in "abcdefgh":
        (tmp_path / name).write_bytes(name.encode())
    files = [LocalFile.at(path.name, path) for path in sorted(tmp_path.iterdir())]

    def stop(more: int) -> None:
        raise ZeroDivisionError

    with blocking(answer) as client:
        with pytest.raises(ZeroDivisionError):
            client.send_missing(lacking(*"abcdefgh"), files, stop)
        assert len(asked) <= 4  # those that were sent in parallel
        client.delete_job("job_1")


def test_events_are_a_plain_iterator_that_can_be_left(tmp_path: Path) -> None:
    async def content() -> object:
        yield b'event: progress\ndata: {"state": "running"}\n\n'
        try:
            await anyio.sleep(60)
        finally:
            ended.set()

    def answer(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, headers={"Content-Type": "text/event-stream"}, content=content())

    with blocking(answer) as client:
        for event in client.events("job_1"):
            assert event.kind == "progress"
            break
        assert ended.wait(10)


def test_events_raise_what_goes_wrong() -> None:
    with blocking(lambda _: event_stream(b'event: progress\ndata: {"state": "running"}\n\n')) as client:
        client._client._policy.patience_s = 0.1
        events = client.events("job_1", timeout_s=0.3)
        assert next(events).kind == "progress"
        with pytest.raises(TimeoutError):
            list(events)


def test_several_threads_share_a_client() -> None:
    together = threading.Barrier(4, timeout=10)

    async def answer(request: httpx.Request) -> httpx.Response:
        await anyio.to_thread.run_sync(together.wait)  # until all four are asked
        return httpx.Response(503, headers={"Retry-After": "3600"})

    failures = []

    def ask() -> None:
        try:
            client.job("job_1")
        except ServiceError as error:
            failures.append(error.status)

    with blocking(answer) as client:
        threads = [threading.Thread(target=ask) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
    assert failures == [503] * 4


@pytest.mark.parametrize(
    "end", ["", "client.close()", "client.close(); client.close()", "del client", "raise SystemExit(0)"]
)
def test_a_process_ends_whether_its_client_was_closed_or_not(end: str) -> None:
    program = (
        f"from biresnerf.client import Client\nclient = Client('http://127.0.0.1:9')\nclient.ready()\n{end}"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
