"""Requests about jobs and their results."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, TypeAlias, Unpack

from biresnerf.client.transport import Call, Transport, parse
from biresnerf.comparison.conclusion import Comparison
from biresnerf.options.formats import ExportName, PosesOf
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.report import Report
from biresnerf.wire.base import LABEL_LENGTH, LABELS_MOST
from biresnerf.wire.batches import BatchView, NewBatch, batch_url
from biresnerf.wire.deliveries import DeliverTo
from biresnerf.wire.jobs import (
    CancelJob,
    ForkJob,
    JobDetails,
    JobList,
    JobState,
    JobView,
    LogLine,
    NewExport,
    NewJob,
    WantedStage,
    job_url,
)
from biresnerf.wire.results import ArtifactList, ArtifactView, ImageList, NewShare, ShareView
from biresnerf.wire.webhooks import BatchWebhook

OptionsLike: TypeAlias = RefineOptions | Mapping[str, Any] | None
_LOG_LINES = 1000


class JobCalls(Transport):
    """Requests about jobs and their results."""

    async def create_job(
        self,
        dataset_id: str,
        options: OptionsLike = None,
        *,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        **details: Unpack[JobDetails],
    ) -> JobView:
        """Queues a refinement of a dataset. Requests with the same key queue it once and return the same job."""
        body = NewJob(
            dataset_id=dataset_id,
            options=as_options(options),
            labels=dict(labels or {}),
            **details,
        )
        return await self._queue("/v1/jobs", body, idempotency_key)

    async def create_batch(
        self,
        jobs: Sequence[NewJob],
        *,
        webhook: BatchWebhook | None = None,
        idempotency_key: str | None = None,
    ) -> BatchView:
        """Queues all of the jobs, or none. Requests with the same key queue them once and return the same batch."""
        body = NewBatch(jobs=tuple(jobs), webhook=webhook).model_dump(mode="json", exclude_unset=True)
        headers = {"Idempotency-Key": idempotency_key or uuid.uuid4().hex}
        return parse(await self._ask(Call("POST", "/v1/batches", json=body, headers=headers)), BatchView)

    async def batch(self, batch_id: str) -> BatchView:
        """The batch as it is now."""
        return parse(await self._ask(Call("GET", batch_url(batch_id))), BatchView)

    async def cancel_batch(self, batch_id: str, *, keep_partial: bool = False) -> BatchView:
        """Asks for the jobs of a batch to end, as `cancel` does."""
        body = CancelJob(keep_partial=keep_partial).model_dump()
        return parse(await self._ask(Call("POST", f"{batch_url(batch_id)}/cancel", json=body)), BatchView)

    async def _queue(self, path: str, body: NewJob | ForkJob, key: str | None) -> JobView:
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        asked = body.model_dump(mode="json", exclude_unset=True)
        return parse(await self._ask(Call("POST", path, json=asked, headers=headers)), JobView)

    async def job(self, job_id: str) -> JobView:
        """The job as it is now."""
        return parse(await self._ask(Call("GET", job_url(job_id))), JobView)

    async def jobs(
        self,
        *,
        state: JobState | None = None,
        label: tuple[str, str] | None = None,
        created_after: datetime | None = None,
        limit: int | None = None,
    ) -> list[JobView]:
        """Refinements, newest first."""
        params = {
            **({"state": state} if state else {}),
            **({"label": ":".join(label)} if label else {}),
            **({"created_after": created_after.astimezone().isoformat()} if created_after else {}),
        }
        return await self._collect(Call("GET", "/v1/jobs", params), JobList, limit)

    async def cancel(self, job_id: str, *, keep_partial: bool = False) -> JobView:
        """Asks for the job to end; with ``keep_partial`` its best poses so far become its result."""
        body = CancelJob(keep_partial=keep_partial).model_dump()
        return parse(await self._ask(Call("POST", f"{job_url(job_id)}/cancel", json=body)), JobView)

    async def fork(
        self,
        job_id: str,
        options: OptionsLike = None,
        *,
        from_stage: WantedStage = "auto",
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
    ) -> JobView:
        """Queues a job with some options changed, which reuses the work of a stage of this one."""
        body = ForkJob(options=as_options(options), from_stage=from_stage, labels=dict(labels or {}))
        return await self._queue(f"{job_url(job_id)}/fork", body, idempotency_key)

    async def delete_job(self, job_id: str) -> None:
        """Deletes a job that is over, with its results and exports."""
        await self._ask(Call("DELETE", job_url(job_id)))

    async def export(
        self, job_id: str, formats: Sequence[ExportName], *, poses_of: PosesOf = "camera"
    ) -> JobView:
        """Has the result written in further formats; returns the job that does so, or did so before."""
        body = NewExport(formats=list(formats), poses_of=poses_of).model_dump(exclude_defaults=True)
        return parse(await self._ask(Call("POST", f"{job_url(job_id)}/exports", json=body)), JobView)

    async def exports(self, job_id: str) -> list[JobView]:
        """All exports of the job, oldest first."""
        return list(parse(await self._ask(Call("GET", f"{job_url(job_id)}/exports")), JobList).items)

    async def parts(self, job_id: str) -> list[JobView]:
        """The jobs that a job on a large set has split itself into, in order."""
        return list(parse(await self._ask(Call("GET", f"{job_url(job_id)}/parts")), JobList).items)

    async def deliver(self, job_id: str, to: DeliverTo) -> JobView:
        """Has files of the job sent to addresses, now or once it is over; ``delivered`` says what became of them."""
        call = Call("POST", f"{job_url(job_id)}/deliver", json=to.model_dump(mode="json"))
        return parse(await self._ask(call), JobView)

    async def log(self, job_id: str, *, after: int = 0, limit: int = _LOG_LINES) -> list[LogLine]:
        """What the job's process has written, from the line after number ``after``."""
        params: dict[str, str | int] = {"after": after, "limit": limit, "format": "ndjson"}
        answer = await self._ask(Call("GET", f"{job_url(job_id)}/logs", params))
        # Not splitlines(): the text of a line may hold other characters that it splits at.
        lines = answer.content.decode().split("\n")
        return [LogLine.model_validate_json(line, extra="ignore") for line in lines if line]

    async def report(self, job_id: str) -> Report:
        """The report of a finished job: verdict, evidence, images, cameras."""
        return parse(await self._ask(Call("GET", f"{job_url(job_id)}/report")), Report)

    async def compare(self, job_id: str, other_id: str) -> Comparison:
        """Which of two jobs' results is better, the first one's or the other's, and by what; or why that is unknown."""
        answer = await self._ask(Call("GET", f"{job_url(job_id)}/comparison/{other_id}"))
        return parse(answer, Comparison)

    async def images(self, job_id: str, *, sort: str = "", limit: int | None = None) -> ImageList:
        """The report's figures of each image, sorted by a column (largest first with ``-`` before its name)."""
        params: dict[str, str | int] = {
            **({"sort": sort} if sort else {}),
            **({"limit": limit} if limit else {}),
        }
        return parse(await self._ask(Call("GET", f"{job_url(job_id)}/images", params)), ImageList)

    async def artifacts(self, job_id: str) -> list[ArtifactView]:
        """The files of the job's result and its exports; previews while it runs."""
        return parse(await self._ask(Call("GET", f"{job_url(job_id)}/artifacts")), ArtifactList).items

    async def share(self, job_id: str, name: str, *, valid_s: int = 3600) -> ShareView:
        """A link to one file that needs no key; ``href`` is a complete address."""
        body = NewShare(name=name, valid_s=valid_s).model_dump()
        made = parse(await self._ask(Call("POST", f"{job_url(job_id)}/shares", json=body)), ShareView)
        return made.model_copy(update={"href": self.url + made.href})


def as_options(options: OptionsLike) -> RefineOptions:
    """The options, checked; raises `InputError` ``invalid_options``."""
    return options if isinstance(options, RefineOptions) else parse_options(dict(options or {}))


def with_name(labels: Mapping[str, str], name: str) -> dict[str, str]:
    """The labels with ``name``, by which lists show the job, unless they have one or are too many already."""
    return dict(labels) if len(labels) >= LABELS_MOST else {"name": name[:LABEL_LENGTH], **labels}


def idempotency_key_of(body: NewJob) -> str:
    """A key that is the same for the same request, from any process; signed addresses differ each time."""
    asked = json.dumps(body.model_dump(mode="json", exclude_unset=True, exclude={"deliver"}), sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()[:32]
