"""What can be asked about jobs and their results."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, TypeAlias

from biresnerf.client.calls import Call, Flow, Session, ask
from biresnerf.client.pages import collect
from biresnerf.options.formats import ExportName
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.report import Report
from biresnerf.wire.base import LABEL_LENGTH, LABELS_MOST
from biresnerf.wire.jobs import (
    CancelJob,
    ForkJob,
    JobList,
    JobState,
    JobView,
    LogLine,
    NewExport,
    NewJob,
    PriorityName,
    WantedStage,
    job_url,
)
from biresnerf.wire.results import ArtifactList, ArtifactView, ImageList, NewShare, ShareView
from biresnerf.wire.webhooks import JobWebhook

OptionsLike: TypeAlias = RefineOptions | Mapping[str, Any] | None
LOG_LINES = 1000


def chosen(options: OptionsLike) -> RefineOptions:
    """Options from what a caller may give; raises `InputError` ``invalid_options``."""
    return options if isinstance(options, RefineOptions) else parse_options(dict(options or {}))


def with_name(labels: Mapping[str, str], name: str) -> dict[str, str]:
    """The labels with what people know the job by in lists, where that is not said and there is room for it."""
    return dict(labels) if len(labels) >= LABELS_MOST else {"name": name[:LABEL_LENGTH], **labels}


def create_job(
    session: Session,
    dataset_id: str,
    options: OptionsLike = None,
    *,
    labels: Mapping[str, str] | None = None,
    priority: PriorityName = "normal",
    webhook: JobWebhook | None = None,
    idempotency_key: str | None = None,
) -> Flow[JobView]:
    """Queues a refinement of a dataset; with the same key it is queued once, however often it is asked for."""
    body = NewJob(
        dataset_id=dataset_id,
        options=chosen(options),
        labels=dict(labels or {}),
        webhook=webhook,
        priority=priority,
    )
    return (yield from queued(session, body, idempotency_key))


def key_of(body: NewJob) -> str:
    """An idempotency key that is the same wherever the same is asked for."""
    asked = json.dumps(body.model_dump(mode="json", exclude_unset=True), sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()[:32]


def queued(session: Session, body: NewJob, key: str | None) -> Flow[JobView]:
    """The job that the key stands for, queued now or before."""
    return (yield from _create(session, "/v1/jobs", body, key))


def _create(session: Session, path: str, body: NewJob | ForkJob, key: str | None) -> Flow[JobView]:
    headers = {"Idempotency-Key": key or uuid.uuid4().hex}
    call = Call("POST", path, json=body.model_dump(mode="json", exclude_unset=True), headers=headers)
    answer = yield from ask(session, call)
    return answer.model(JobView)


def job(session: Session, job_id: str) -> Flow[JobView]:
    """The job now."""
    answer = yield from ask(session, Call("GET", job_url(job_id)))
    return answer.model(JobView)


def jobs(
    session: Session,
    *,
    state: JobState | None = None,
    label: tuple[str, str] | None = None,
    created_after: datetime | None = None,
    limit: int | None = None,
) -> Flow[list[JobView]]:
    """Refinements, the newest first."""
    params = {
        **({"state": state} if state else {}),
        **({"label": ":".join(label)} if label else {}),
        **({"created_after": created_after.astimezone().isoformat()} if created_after else {}),
    }
    return (
        yield from collect(
            session, Call("GET", "/v1/jobs", params), lambda answer: answer.model(JobList), limit
        )
    )


def cancel(session: Session, job_id: str, *, keep_partial: bool = False) -> Flow[JobView]:
    """Asks for the job's end, with the best poses so far as its result where they are to be kept."""
    body = CancelJob(keep_partial=keep_partial).model_dump()
    answer = yield from ask(session, Call("POST", f"{job_url(job_id)}/cancel", json=body))
    return answer.model(JobView)


def fork(
    session: Session,
    job_id: str,
    options: OptionsLike = None,
    *,
    from_stage: WantedStage = "auto",
    labels: Mapping[str, str] | None = None,
    idempotency_key: str | None = None,
) -> Flow[JobView]:
    """Queues a job with some other options, that takes over the work of a stage of this one."""
    body = ForkJob(options=chosen(options), from_stage=from_stage, labels=dict(labels or {}))
    return (yield from _create(session, f"{job_url(job_id)}/fork", body, idempotency_key))


def delete_job(session: Session, job_id: str) -> Flow[None]:
    """Deletes a job that is over, with its results and its exports."""
    yield from ask(session, Call("DELETE", job_url(job_id)))


def export(session: Session, job_id: str, formats: Sequence[ExportName]) -> Flow[JobView]:
    """Has the result written in further forms; gives the job that does it, or has done it before."""
    body = NewExport(formats=list(formats)).model_dump()
    answer = yield from ask(session, Call("POST", f"{job_url(job_id)}/exports", json=body))
    return answer.model(JobView)


def exports(session: Session, job_id: str) -> Flow[list[JobView]]:
    """All exports of the job, the oldest first."""
    answer = yield from ask(session, Call("GET", f"{job_url(job_id)}/exports"))
    return answer.model(JobList).items


def log(session: Session, job_id: str, *, after: int = 0, limit: int = LOG_LINES) -> Flow[list[LogLine]]:
    """What the job's process wrote, from after that line on."""
    params: dict[str, str | int] = {"after": after, "limit": limit, "format": "ndjson"}
    answer = yield from ask(session, Call("GET", f"{job_url(job_id)}/logs", params))
    # By "\n" alone: a line's text may hold marks that other rules take for the end of a line.
    written = answer.content.decode().split("\n")
    return [LogLine.model_validate_json(line, extra="ignore") for line in written if line]


def report(session: Session, job_id: str) -> Flow[Report]:
    """The account of a finished job: verdict, evidence, images, cameras."""
    answer = yield from ask(session, Call("GET", f"{job_url(job_id)}/report"))
    return answer.model(Report)


def images(session: Session, job_id: str, *, sort: str = "", limit: int | None = None) -> Flow[ImageList]:
    """What the report says of each image, sorted by a column (``-`` before it: the largest first)."""
    params: dict[str, str | int] = {**({"sort": sort} if sort else {}), **({"limit": limit} if limit else {})}
    answer = yield from ask(session, Call("GET", f"{job_url(job_id)}/images", params))
    return answer.model(ImageList)


def artifacts(session: Session, job_id: str) -> Flow[list[ArtifactView]]:
    """The files of the job's result and of its exports; previews while it runs."""
    answer = yield from ask(session, Call("GET", f"{job_url(job_id)}/artifacts"))
    return answer.model(ArtifactList).items


def share(session: Session, job_id: str, name: str, *, valid_s: int = 3600) -> Flow[ShareView]:
    """A link to one file that needs no key; ``href`` is whole."""
    body = NewShare(name=name, valid_s=valid_s).model_dump()
    answer = yield from ask(session, Call("POST", f"{job_url(job_id)}/shares", json=body))
    made = answer.model(ShareView)
    return made.model_copy(update={"href": session.url + made.href})
