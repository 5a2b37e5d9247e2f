"""Batches: jobs that are submitted together, with one status and one message at their end."""

from __future__ import annotations

from datetime import datetime
from urllib.parse import quote

from pydantic import ConfigDict, Field

from biresnerf.report import VerdictName
from biresnerf.wire.base import Links, Record
from biresnerf.wire.jobs import JobState, NewJob
from biresnerf.wire.webhooks import BatchWebhook

BATCH_MOST = 100


class NewBatch(Record):
    """Jobs to submit together: all of them, or none."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"jobs": [{"dataset_id": "ds_01"}, {"dataset_id": "ds_02"}]}]}
    )

    jobs: tuple[NewJob, ...] = Field(min_length=1, max_length=BATCH_MOST)
    webhook: BatchWebhook | None = Field(
        None, description="Where the message `batch.finished` goes, besides all other webhooks."
    )


class BatchJob(Record):
    """What a batch shows of each of its jobs."""

    id: str = Field(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    dataset_id: str = Field(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    labels: dict[str, str] = Field(examples=[{"name": "kitchen"}])
    state: JobState = Field(examples=["succeeded"])
    partial: bool
    verdict: VerdictName | None = Field(None, examples=["improved"])


class BatchLinks(Links):
    """Paths of the parts of a batch."""

    cancel: str


class BatchView(Record):
    """A batch. It is deleted with its last job."""

    id: str = Field(examples=["bat_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field("local", description="The owner.")
    created_at: datetime
    finished_at: datetime | None = Field(None, description="When its last job ended; null before.")
    counts: dict[JobState, int] = Field(examples=[{"running": 1, "succeeded": 1}])
    jobs: tuple[BatchJob, ...] = Field(description="In the order of the request, but for deleted ones.")
    links: BatchLinks = Field(
        default_factory=lambda fields: BatchLinks.below(batch_url(fields.get("id", "")))
    )

    @property
    def final(self) -> bool:
        """Whether all jobs have ended."""
        return self.finished_at is not None


def batch_url(batch_id: str) -> str:
    """The batch's path."""
    return f"/v1/batches/{quote(batch_id, safe='')}"
