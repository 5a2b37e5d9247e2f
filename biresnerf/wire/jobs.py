"""Jobs, their history, and the requests to submit, fork, cancel and export them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self, TypedDict
from urllib.parse import quote

from pydantic import ConfigDict, Field, model_validator

from biresnerf.options.formats import ExportName, PosesOf, formats
from biresnerf.options.option import ONCE
from biresnerf.options.refine_options import RefineOptions
from biresnerf.report import VerdictName
from biresnerf.stages import ReusableStage, Stage
from biresnerf.wire.base import NO_CONTROLS, Labels, Links, Page, Record, Time
from biresnerf.wire.datasets import dataset_url
from biresnerf.wire.deliveries import DeliveredFile, DeliverTo
from biresnerf.wire.problems import JobError
from biresnerf.wire.webhooks import JobWebhook

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled", "expired"]
FINAL_JOB_STATES: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled", "expired"})
PriorityName = Literal["low", "normal", "high"]
JobKind = Literal["refine", "export"]

EventType = Literal[
    "queued",
    "started",
    "stage",
    "checkpoint",
    "preview",
    "attempt_crashed",
    "retried_smaller",
    "requeued",
    "split",
    "part_over",
    "cancel_requested",
    "succeeded",
    "failed",
    "cancelled",
    "expired",
    "files_expired",
]
WantedStage = Literal["auto", "seeding", "coarse"]
DEADLINE_MOST_S = 30 * 86_400  # the latest deadline, from the submission


class JobProgress(Record):
    """Progress of the running attempt. ``fraction`` never decreases within an attempt."""

    fraction: float = Field(0.0, examples=[0.31], ge=0.0, le=1.0)
    step: int = Field(0, examples=[620])
    steps_total: int = Field(0, examples=[2000])
    eta_s: float | None = Field(None, examples=[71.5])


class JobUse(Record):
    """What the finished attempts of a job used, however they ended."""

    processor_s: float = Field(
        0.0,
        examples=[412.5],
        description="User and system seconds of their processes. Of a lost worker: until its last sign.",
    )
    wall_s: float = Field(
        0.0, examples=[230.1], description="How long they took, from the claim to the stored result."
    )
    gpu_s: float = Field(
        0.0, examples=[0.0], description="How long they took on slots with a GPU; exports need none."
    )


class JobParts(Record):
    """Into how many jobs a job has split itself, and how many of them are over."""

    parts: int = Field(examples=[8])
    over: int = Field(examples=[3])
    failed: int = Field(0, description="Of those that are over, without a result.")


class JobLinks(Links):
    """Paths of the parts of a job."""

    dataset: str
    events: str
    artifacts: str
    report: str
    images: str
    logs: str
    exports: str
    parts: str
    cancel: str
    deliver: str
    fork: str


class JobView(Record):
    """A job. ``revision`` grows with every change (use it as a weak ETag)."""

    id: str = Field(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field("local", description="The owner.")
    key_id: str | None = Field(
        None,
        examples=["key_01JD8Y3V1QKZ5M0C7W2N4T6XAB"],
        description="The API key that submitted it; null without one.",
    )
    kind: JobKind = Field("refine", description="`export` writes the result of `parent` in further forms.")
    parent: str | None = Field(
        None,
        description="The job whose result an export writes, or that has split itself into this and others.",
    )
    parts: JobParts | None = Field(None, description="Null unless the job has split itself.")
    forked_from: str | None = Field(None, description="The job that this one was forked from.")
    forked_stage: ReusableStage | None = Field(
        None, description="The stage of that job whose result was reused."
    )
    fixed_from: str | None = Field(
        None,
        description="The job whose poses and lenses the photos that both have keep; the others join its frame.",
    )
    batch_id: str | None = Field(None, description="The batch that it was submitted in.")
    dataset_id: str = Field(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    state: JobState = Field(examples=["running"])
    stage: Stage | None = Field(None, examples=["coarse"])
    progress: JobProgress = JobProgress()
    use: JobUse = JobUse()
    priority: PriorityName = "normal"
    queue_position: int | None = Field(None, description="1 is next; null unless queued.")
    attempt: int = Field(0, examples=[1])
    cancel_requested: bool = False
    created_at: datetime
    start_by: datetime | None = Field(
        None, description="If it has not started by then, it ends as `expired`; null if it may wait."
    )
    deadline_at: datetime | None = Field(
        None, description="If it runs then, it is stopped, and keeps its best poses so far."
    )
    started_at: datetime | None = None
    finished_at: datetime | None = None
    expires_at: datetime | None = Field(
        None, description="When its files are deleted; null until the job has ended, or if they are kept."
    )
    options: dict[str, Any] = Field(
        examples=[{"preset": "fast"}], description="RefineOptions as requested; of an export, its formats."
    )
    resolved_options: dict[str, Any] | None = Field(
        None,
        examples=[{"preset": "fast", "steps": 3000, "device": "cpu"}],
        description="ResolvedOptions: every option as the latest attempt used it, filled in from preset, method and "
        "the worker's device. Null until the job runs.",
    )
    smaller: dict[str, Any] = Field(
        {},
        description="Options that replace the original ones in the retry after the first attempt ran out of memory.",
    )
    partial: bool = Field(
        False, description="The files are from a job that was stopped: its best poses so far."
    )
    metrics: dict[str, float] = Field({}, examples=[{"loss": 0.012, "psnr": 19.2}])
    message: str = ""
    verdict: VerdictName | None = Field(
        None,
        description="Whether refinement helped; set once the job has succeeded. The report has the evidence.",
    )
    error: JobError | None = Field(None, examples=[None])
    thumbnail: str | None = Field(
        None,
        description="The artifact with a small picture of the result, or of the latest preview while the job runs.",
    )
    delivered: tuple[DeliveredFile, ...] = Field(
        (), description="Files that are sent to addresses of the owner's once the job is over."
    )
    labels: dict[str, str] = Field({}, examples=[{"run": "a"}])
    revision: int = Field(0, examples=[17])
    # Before 2.14, pydantic calls this for fields that failed, too.
    links: JobLinks = Field(
        default_factory=lambda fields: JobLinks.below(
            job_url(fields.get("id", "")), dataset=dataset_url(fields.get("dataset_id", ""))
        )
    )

    @property
    def final(self) -> bool:
        """Whether the job has ended."""
        return self.state in FINAL_JOB_STATES


class JobEvent(Record):
    """One entry of a job's gapless history; ``seq`` starts at 1 (use it as the SSE id)."""

    seq: int
    at: datetime
    attempt: int
    type: EventType
    data: dict[str, Any] = Field({})


class LogLine(Record):
    """One line that a job's process wrote to standard error; ``n`` starts at 1 and has no gaps."""

    n: int
    at: datetime
    attempt: int
    text: str


class JobList(Page[JobView]):
    """A page of jobs, newest first."""


class JobTexts(Record):
    """The options of a new job besides its input; also the text fields of the one-shot form."""

    options: RefineOptions = RefineOptions()
    labels: Labels = Field({})
    webhook: JobWebhook | None = Field(
        None, description="Where messages about this job go, besides all other webhooks."
    )
    deliver: DeliverTo | None = Field(
        None,
        description="Where its files are sent once it is over. A repeated request with the same key keeps the first "
        "addresses.",
    )
    part_photos: int | None = Field(
        None,
        ge=20,
        le=10_000,
        description="A job on more photos splits itself into jobs on about so many each, which any workers run; it "
        "waits for them, and joins their results. Left out: as the operator has set.",
    )
    priority: PriorityName = Field(
        "normal", description="Before or after other jobs; `high` only where the operator allows it."
    )
    expires_in_queue_s: int | None = Field(
        None,
        ge=1,
        le=DEADLINE_MOST_S,
        description="Seconds from the submission. If the job has not started by then, it ends as `expired`.",
    )
    deadline_at: Time | None = Field(
        None,
        description="A time with an offset, at most 30 days ahead. If the job has not started by then, it ends as "
        "`expired`; if it has, it is stopped, and keeps its best poses so far.",
    )


class JobDetails(TypedDict, total=False):
    """What a new job may have beside its input, options and labels.

    Attributes:
        priority: before or after other jobs.
        webhook: where messages about it go.
        deliver: where its files are sent once it is over; see `biresnerf.client.bucket_target`.
        fixed_from: a job with a result of some of the photos: they keep its poses and lenses, others join its frame.
        part_photos: a job on more photos splits itself into parts of about so many.
        expires_in_queue_s: seconds from the submission, after which it is not started any more.
        deadline_at: when it is stopped, with its best poses so far.
    """

    priority: PriorityName
    webhook: JobWebhook | None
    deliver: DeliverTo | None
    fixed_from: str | None
    part_photos: int | None
    expires_in_queue_s: int | None
    deadline_at: datetime | None


class NewJob(JobTexts):
    """A refinement to run."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"dataset_id": "ds_01", "options": {"preset": "fast"}, "labels": {"run": "a"}}]
        }
    )

    dataset_id: str = Field(max_length=100, pattern=NO_CONTROLS)
    fixed_from: str | None = Field(
        None,
        max_length=100,
        pattern=NO_CONTROLS,
        description="A job with a result of some of the dataset's photos: these keep its poses and lenses, and "
        "the others join its frame.",
    )


class CancelJob(Record):
    """A request to cancel a job."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"keep_partial": True}]})

    keep_partial: bool = Field(
        False,
        description="Publish the best poses so far, with a report in state `partial`; otherwise only the log.",
    )


class ForkJob(Record):
    """The changes in a job that reuses the work of another."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"options": {"warmup_steps": 200}, "from_stage": "coarse"}]}
    )

    options: RefineOptions = Field(
        RefineOptions(), description="Options to change; all others stay as requested for the original job."
    )
    from_stage: WantedStage = Field(
        "auto",
        description="Which stage's result is reused: COLMAP's poses (`seeding`), poses and field at the end of stage 1 "
        "(`coarse`), or the latest that the options allow.",
    )
    labels: Labels = Field(default_factory=dict)


class NewExport(Record):
    """Formats to write a result in, beside those it has."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"formats": ["kitti", "pinhole"]}]})

    formats: Annotated[tuple[ExportName, ...], *ONCE] = Field(min_length=1, max_length=20)
    poses_of: PosesOf = Field(
        "camera",
        description="body: into body/, the poses of the robot's flange, phone or other body whose poses the input had, "
        "in formats of poses alone.",
    )

    @model_validator(mode="after")
    def _of_poses_alone(self) -> Self:
        seeing = [name for name in self.formats if not formats()[name].holds_bodies]
        if self.poses_of == "body" and seeing:
            raise ValueError(f"{', '.join(seeing)} would show what cameras see, not poses of a body alone")
        return self


def job_url(job_id: str) -> str:
    """The job's path."""
    return f"/v1/jobs/{quote(job_id, safe='')}"
