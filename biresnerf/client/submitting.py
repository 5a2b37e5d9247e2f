"""A folder of this machine as a job of a service: manifest first, only what is missing, checked, queued once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Literal

from biresnerf.client.calls import Flow, Session, Work
from biresnerf.client.dataset_calls import create_dataset, dataset, delete_dataset, finalize
from biresnerf.client.errors import ServiceError
from biresnerf.client.job_calls import OptionsLike, chosen, key_of, queued, with_name
from biresnerf.client.scene import look_at
from biresnerf.client.sending import LocalFile, send_missing
from biresnerf.wire.datasets import DatasetView
from biresnerf.wire.jobs import JobView, NewJob, PriorityName
from biresnerf.wire.webhooks import JobWebhook


@dataclass(frozen=True)
class Sending:
    """How far a submission is. ``dataset_id`` is what an interrupted one can be taken up again by (``resume``)."""

    step: Literal["reading", "sending", "checking", "queueing"]
    files: int = 0
    files_missing: int = 0
    bytes_missing: int = 0
    bytes_sent: int = 0
    dataset_id: str | None = None


OnSending = Callable[[Sending], None]


def submit(
    session: Session,
    path: Path,
    options: OptionsLike = None,
    *,
    name: str | None = None,
    labels: Mapping[str, str] | None = None,
    priority: PriorityName = "normal",
    webhook: JobWebhook | None = None,
    idempotency_key: str | None = None,
    resume: str | None = None,
    on_progress: OnSending = lambda _: None,
) -> Flow[JobView]:
    """Sends what the service lacks of a folder (or file with poses), has it checked, and queues a job.

    What the service will not take leaves nothing behind there. Where the connection stayed away, or the caller ends
    this, the dataset stays: the same submission again sends what still lacks, with ``resume`` into the same dataset; if
    its job was queued before the end came, that job is the answer.

    Args:
        name: of the dataset, and of the job where ``labels`` has no ``name``. Default: the folder's.
        resume: the dataset of a submission that was interrupted.

    Raises:
        InputError: the folder or the options cannot be used; nothing was sent then.
        ServiceError: the service refuses, or stays away.
    """
    wanted = chosen(options)
    on_progress(Sending("reading"))
    files: list[LocalFile] = yield Work(lambda: local_files(path))
    if resume is None:
        title = (name or _called(path.resolve()) or "scene")[:200]
        target = yield from create_dataset(session, title, [file.entry for file in files])
    else:
        target = yield from dataset(session, resume)
    try:
        ready = yield from _filled(session, target, files, on_progress)
        on_progress(Sending("queueing", len(files), dataset_id=target.id))
        body = NewJob(
            dataset_id=ready.id,
            options=wanted,
            labels=with_name(labels or {}, target.name),
            webhook=webhook,
            priority=priority,
        )
        return (yield from queued(session, body, idempotency_key or key_of(body)))
    except ServiceError as error:
        if error.users_fault and resume is None:
            yield from _forget(session, target, error)
        raise


def _called(path: Path) -> str:
    """The folder's name; that of a file with poses is the same in every set."""
    return (path.parent if path.is_file() else path).name


def local_files(path: Path) -> list[LocalFile]:
    """The files that make up the input at ``path``, read for their digests; raises `InputError`."""
    return [LocalFile.at(name, file) for name, file in look_at(path).files]


def _filled(
    session: Session, target: DatasetView, files: list[LocalFile], on_progress: OnSending
) -> Flow[DatasetView]:
    if target.state == "ready":  # of a submission that was interrupted at its end
        return target
    missing = set(target.missing)
    lacking = [file.size for file in files if file.name in missing]
    state = Sending("sending", len(files), len(lacking), sum(lacking), dataset_id=target.id)
    on_progress(state)
    sent, one_at_a_time = 0, Lock()

    def count(more: int) -> None:
        nonlocal sent
        with one_at_a_time:
            sent += more
            on_progress(replace(state, bytes_sent=sent))

    yield from send_missing(session, target, files, count)
    on_progress(replace(state, step="checking", bytes_sent=state.bytes_missing))
    return (yield from finalize(session, target.id))


def _forget(session: Session, target: DatasetView, why: ServiceError) -> Flow[None]:
    try:
        yield from delete_dataset(session, target.id)
    except ServiceError as error:
        why.add_note(f"The dataset {target.id} stayed on the service: {error}")
