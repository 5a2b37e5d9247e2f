"""The installation at work, as its operator sees it."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from biresnerf.stages import Stage
from biresnerf.wire.base import Record
from biresnerf.wire.jobs import JobKind, PriorityName


class PriorityCount(Record):
    """Jobs of one priority that are not over."""

    priority: PriorityName
    waiting: int = Field(0, examples=[3])
    held: int = Field(0, examples=[1], description="They wait for their tenant's limit.")
    running: int = Field(0, examples=[2])
    oldest_at: datetime | None = Field(None, description="When the oldest that waits was submitted.")


class RunningJob(Record):
    """A job that a slot works on."""

    id: str = Field(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field(examples=["anna"])
    kind: JobKind
    attempt: int = Field(examples=[1])
    stage: Stage | None = Field(examples=["coarse"])
    fraction: float = Field(examples=[0.31])
    since: datetime | None = Field(description="When this attempt began.")


class SlotView(Record):
    """A worker slot: it runs one refinement at a time, and one export beside it."""

    host: str = Field(examples=["gpu-1"])
    name: str = Field(examples=["gpu0"])
    kind: Literal["cpu", "gpu"] = Field(examples=["gpu"])
    alive: bool = Field(examples=[True], description="Its last heartbeat is younger than BIRESNERF_STALL_S.")
    beat_at: datetime
    jobs: tuple[RunningJob, ...]


class FailedJob(Record):
    """A job that failed, and why."""

    id: str = Field(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field(examples=["anna"])
    finished_at: datetime
    code: str | None = Field(examples=["out_of_memory"])
    detail: str | None = Field(examples=["The job needs more memory than the machine has."])


class OperatorView(Record):
    """Queue, slots, sizes and the latest failures, of all tenants, seen at one moment."""

    at: datetime
    queue: tuple[PriorityCount, ...]
    slots: tuple[SlotView, ...] = Field(
        description="Those that are registered; a dead one until its jobs are taken back."
    )
    stored_bytes: int = Field(examples=[1_288_490_188], description="Datasets, uploads and results.")
    database_bytes: int = Field(examples=[41_943_040])
    upload_room_bytes: int = Field(
        0,
        examples=[53_687_091_200],
        description="Free on the disks of the web process that answers, without the reserve.",
    )
    trash: int = Field(examples=[2], description="Folders of files that wait for deletion.")
    webhooks_pending: int = Field(examples=[0])
    failures: tuple[FailedJob, ...] = Field(description="The newest first.")
