"""A small synchronous client of the API: what `biresnerf submit` and the demo speak through."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import httpx
from pydantic import BaseModel

from biresnerf.config import RefineOptions
from biresnerf.errors import BiresnerfError
from biresnerf.wire.datasets import DatasetView, ManifestEntry
from biresnerf.wire.jobs import FINAL_JOB_STATES, JobView, PriorityName
from biresnerf.wire.problems import Problem
from biresnerf.wire.results import ArtifactView

# The server's keep-alive comes every 15 s; three missed ones mean that the connection is dead.
_SILENCE_S = 50.0
_POLL_S = 0.5
Model = TypeVar("Model", bound=BaseModel)
Answer = TypeVar("Answer")


class ServiceError(BiresnerfError):
    """The service refused or failed; ``status`` is the HTTP status, 0 where it could not be reached."""

    def __init__(self, code: str, what: str, *, status: int = 0, where: str = "", mend: str = "") -> None:
        self.code, self.what, self.status, self.where, self.mend = code, what, status, where, mend
        super().__init__(" ".join(part for part in (f"{where}:" if where else "", what, mend) if part))

    @property
    def retryable(self) -> bool:
        """Whether the same request may succeed later: nobody answered, or the service asks to wait."""
        return self.status in {0, 408, 429, 502, 503, 504, 507} and self.code != "stopped"

    @property
    def users_fault(self) -> bool:
        """Whether the request itself has to change."""
        return 400 <= self.status < 500 and self.status not in {408, 429}


class Happening(NamedTuple):
    """One message of a job's event stream. ``data`` is a job for ``progress``, else an event."""

    kind: str
    data: dict[str, Any]


class _Bearer(httpx.Auth):
    """Shows the key to its own service alone, wherever a link or a redirection leads."""

    def __init__(self, home: httpx.URL, api_key: str) -> None:
        self._home, self._header = home, f"Bearer {api_key}"

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response]:
        url, home = request.url, self._home
        if (url.scheme, url.host, url.port) == (home.scheme, home.host, home.port):
            request.headers["Authorization"] = self._header
        yield request


class Client:
    """Talks to one service. Use as a context manager.

    Every method raises `ServiceError`.
    """

    def __init__(self, url: str, *, api_key: str | None = None, patience_s: float = 60.0) -> None:
        """``patience_s``: how long a service that cannot be reached is tried again while following a job."""
        self.url = url.rstrip("/")
        self._patience_s = patience_s
        timeout = httpx.Timeout(30.0, read=120.0, write=120.0)
        self._http = httpx.Client(
            base_url=self.url,
            timeout=timeout,
            headers={"Accept": "application/json"},
            auth=_Bearer(httpx.URL(self.url), api_key) if api_key else None,
        )

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def ready(self) -> bool:
        """Whether the service takes jobs now."""
        try:
            return self._http.get("/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def create_dataset(self, name: str, manifest: Sequence[ManifestEntry] = ()) -> DatasetView:
        """A dataset; ``missing`` of it says which files of the manifest have to be sent."""
        body = {"name": name, "manifest": [entry.model_dump() for entry in manifest]}
        return self.ask(DatasetView, "POST", "/v1/datasets", json=body)

    def finalize(self, dataset: DatasetView) -> DatasetView:
        """Has the dataset checked; returns it once it is ready."""
        headers = {"Prefer": "respond-async"}
        found = self.ask(DatasetView, "POST", dataset.links.finalize, headers=headers)
        while found.state == "finalizing":
            time.sleep(_POLL_S)
            found = self.ask(DatasetView, "GET", dataset.links.self)
        if found.state == "rejected":
            error = found.error
            if error is None:
                raise ServiceError("dataset_invalid", "The service rejected the dataset.", status=422)
            raise ServiceError(error.code, error.detail, status=422, where=error.where, mend=error.mend)
        return found

    def delete_dataset(self, dataset: DatasetView) -> None:
        """Deletes the dataset."""
        self.send("DELETE", dataset.links.self)

    def submit(
        self,
        dataset_id: str,
        options: RefineOptions,
        *,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        priority: PriorityName = "normal",
    ) -> JobView:
        """Queues a job."""
        body = {
            "dataset_id": dataset_id,
            "options": options.model_dump(mode="json", exclude_unset=True),
            "labels": dict(labels or {}),
            **({"priority": priority} if priority != "normal" else {}),
        }
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        return self.ask(JobView, "POST", "/v1/jobs", json=body, headers=headers)

    def job(self, job_id: str) -> JobView:
        """The job now."""
        return self.ask(JobView, "GET", f"/v1/jobs/{job_id}")

    def cancel(self, job: JobView) -> JobView:
        """Asks for the job's end."""
        return self.ask(JobView, "POST", job.links.cancel)

    def follow(self, job: JobView, *, after: int = 0) -> Iterator[Happening]:
        """What happens to the job until it is over, each event once.

        Lost connections are taken up again where they broke off, and a service that is away is waited for.
        """
        last, away_since, over = after, None, False
        while not over:
            try:
                for identity, happening in self._stream(job.links.events, last):
                    away_since = None
                    last = identity or last
                    over = over or happening.data.get("state") in FINAL_JOB_STATES
                    yield happening
            except (httpx.TransportError, ServiceError) as error:
                if isinstance(error, ServiceError) and error.users_fault:
                    raise
                away_since = away_since or time.monotonic()
                if time.monotonic() - away_since > self._patience_s:
                    raise _unreachable(self.url, error) from None
            if not over:
                time.sleep(_POLL_S)

    def _stream(self, path: str, after: int) -> Iterator[tuple[int, Happening]]:
        headers = {"Accept": "text/event-stream", "Last-Event-ID": str(after)}
        timeout = httpx.Timeout(30.0, read=_SILENCE_S)
        with self._http.stream("GET", path, headers=headers, timeout=timeout) as answer:
            if answer.status_code != 200:
                answer.read()
                raise _refusal(answer)
            fields: dict[str, str] = {}
            for line in answer.iter_lines():
                name, _, value = line.partition(":")
                if line:
                    fields[name] = value.removeprefix(" ")
                    continue
                if "data" in fields and "event" in fields:
                    yield int(fields.get("id", 0)), Happening(fields["event"], json.loads(fields["data"]))
                fields = {}

    def artifacts(self, job: JobView) -> list[ArtifactView]:
        """The files of the job's result."""
        answer = self.send("GET", job.links.artifacts)
        return [_known(ArtifactView, item) for item in answer.json()["items"]]

    def download(
        self, artifact: ArtifactView, target: Path, on_bytes: Callable[[int], None] | None = None
    ) -> None:
        """Writes the file whole or not at all; a broken connection goes on where it broke off."""
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.part")
        digest, size, tries = hashlib.sha256(), 0, 0
        try:
            with partial.open("wb") as out:
                while size < artifact.size:
                    try:
                        for chunk in self._bytes(artifact, size):
                            out.write(chunk)
                            digest.update(chunk)
                            size += len(chunk)
                            if on_bytes:
                                on_bytes(len(chunk))
                    except httpx.TransportError as error:
                        if (tries := tries + 1) > 5:
                            raise _unreachable(self.url, error) from None
                        time.sleep(_POLL_S * tries)
            if digest.hexdigest() != artifact.sha256:
                raise ServiceError("download_damaged", f"{artifact.name} arrived damaged; try again.")
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)

    def _bytes(self, artifact: ArtifactView, start: int) -> Iterator[bytes]:
        wanted = {"Accept": "*/*", "Accept-Encoding": "identity"}
        if start:
            wanted["Range"] = f"bytes={start}-"
        same = {"If-Range": f'"{artifact.sha256}"'} if start else {}
        with self._http.stream("GET", artifact.href, headers={**wanted, **same}) as answer:
            if answer.status_code != 307:
                yield from _content(answer, start)
                return
        # At the service's store, which has tags of its own; files of a result never change.
        with self._http.stream("GET", answer.headers["Location"], headers=wanted) as answer:
            yield from _content(answer, start)

    def patiently(self, attempt: Callable[[], Answer]) -> Answer:
        """What ``attempt`` returns, tried again while the service is away or asks to wait, within the patience."""
        failing_since = None
        while True:
            try:
                return attempt()
            except ServiceError as error:
                failing_since = failing_since or time.monotonic()
                if not error.retryable or time.monotonic() - failing_since > self._patience_s:
                    raise
            time.sleep(_POLL_S)

    def ask(self, model: type[Model], method: str, path: str, **arguments: Any) -> Model:
        """The answer as a model."""
        return _known(model, self.send(method, path, **arguments).json())

    def send(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """One request."""
        try:
            answer = self._http.request(method, path, **arguments)
        except httpx.TransportError as error:
            raise _unreachable(self.url, error) from None
        if answer.status_code >= 400:
            raise _refusal(answer)
        return answer


def _content(answer: httpx.Response, start: int) -> Iterator[bytes]:
    if answer.status_code != (206 if start else 200):
        answer.read()
        raise _refusal(answer)
    yield from answer.iter_raw()


def _known(model: type[Model], values: dict[str, Any]) -> Model:
    # A newer service may say more than this client knows.
    return model.model_validate({key: value for key, value in values.items() if key in model.model_fields})


def _refusal(answer: httpx.Response) -> ServiceError:
    try:
        problem = _known(Problem, answer.json())
    except ValueError:
        return ServiceError(
            "unexpected_answer",
            f"The service answered with status {answer.status_code}.",
            status=answer.status_code,
        )
    return ServiceError(
        problem.code,
        problem.detail,
        status=answer.status_code,
        where=problem.where or "",
        mend=problem.mend or "",
    )


def _unreachable(url: str, error: Exception) -> ServiceError:
    return ServiceError(
        "unreachable", f"No service answers at {url} ({error}).", mend="Start one: biresnerf up."
    )
