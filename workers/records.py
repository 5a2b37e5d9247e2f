"""What a job and a dataset look like to everybody outside the engine. Frozen, JSON-ready, torch-free."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from biresnerf.progress import ReusableStage, Stage
from biresnerf.report import VerdictName

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled", "expired"]
PriorityName = Literal["low", "normal", "high"]
PRIORITIES: dict[PriorityName, int] = {"low": -1, "normal": 0, "high": 1}
DatasetState = Literal["open", "finalizing", "ready", "rejected", "expired"]
FINAL_JOB_STATES: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled", "expired"})

LOG_NAME, POSES_NAME, REPORT_NAME = (
    "log.txt",
    "poses.json",
    "report.json",
)  # files of a result that the engine knows
PREVIEW_FOLDER = "preview"  # of files that show how far a job is

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
    "cancel_requested",
    "succeeded",
    "failed",
    "cancelled",
    "expired",
]
FINAL_EVENTS: frozenset[EventType] = frozenset({"succeeded", "failed", "cancelled", "expired"})


class Record(BaseModel):
    """Base of everything that crosses a process border."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class JobProgress(Record):
    """How far the running attempt is. ``fraction`` never falls within one attempt."""

    fraction: float = Field(0.0, ge=0.0, le=1.0)
    step: int = 0
    steps_total: int = 0
    eta_s: float | None = None


class JobError(Record):
    """Why a job failed.

    ``code`` is the pipeline's own (InputError, RefinementError) or one of the engine's: ``timeout``,
    ``out_of_memory``, ``too_many_crashes``, ``engine_error``. ``log_tail`` is the end of what the job wrote to stderr.
    """

    code: str
    detail: str
    where: str = ""
    mend: str = ""
    retryable: bool = False
    log_tail: str = ""


class Job(Record):
    """A job as clients see it. ``revision`` grows with every change (use it as a weak ETag)."""

    id: str
    tenant: str = Field("local", description="Whose it is.")
    kind: JobKind = Field("refine", description="`export` writes the result of `parent` in further forms.")
    parent: str | None = Field(None, description="Of an export: the job whose result it writes.")
    forked_from: str | None = Field(None, description="The job that this one started from.")
    forked_stage: ReusableStage | None = Field(None, description="Whose work of that job it took over.")
    dataset_id: str
    state: JobState
    stage: Stage | None = None
    progress: JobProgress = JobProgress()
    priority: PriorityName = "normal"
    queue_position: int | None = Field(None, description="1 is next; none unless queued.")
    attempt: int = 0
    cancel_requested: bool = False
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    expires_at: datetime | None = Field(
        None, description="When its files go, once it is over; none where they are kept for ever."
    )
    options: dict[str, Any] = Field(description="Resolved RefineOptions; of an export, its formats.")
    smaller: dict[str, Any] = Field(
        {}, description="Options that a second try uses instead, after the first ran out of memory."
    )
    partial: bool = Field(
        False, description="The files are those of a job that was stopped: its best poses until then."
    )
    metrics: dict[str, float] = {}
    message: str = ""
    verdict: VerdictName | None = Field(
        None,
        description="Whether refinement helped, once the job has succeeded; the report has the evidence.",
    )
    error: JobError | None = None
    labels: dict[str, str] = {}
    revision: int = 0

    @property
    def final(self) -> bool:
        """Nothing will change any more."""
        return self.state in FINAL_JOB_STATES


def priority_name(number: int) -> PriorityName:
    """As clients say it."""
    return next(name for name, value in PRIORITIES.items() if value == number)


class JobEvent(Record):
    """One entry of a job's gapless history; ``seq`` starts at 1 (use it as the SSE id)."""

    seq: int
    at: datetime
    attempt: int
    type: EventType
    data: dict[str, Any] = {}


class JobUpdate(Record):
    """What a subscriber gets at every change: the job now, and the events since the last update."""

    job: Job
    events: tuple[JobEvent, ...] = ()


class Artifact(Record):
    """One file of a job's published result (or ``log.txt`` of a failed one). Read it by ``key``."""

    name: str = Field(description="Path relative to the result, for example renders/orbit.mp4.")
    key: str = Field(description="Key in the FileStore.")
    size: int
    sha256: str
    media_type: str

    @property
    def preview(self) -> bool:
        """Whether it shows a job that is not over yet; another one will take its place."""
        return self.name.startswith(f"{PREVIEW_FOLDER}/")


class LogLine(Record):
    """One line that a job's process wrote to standard error; ``n`` starts at 1 and has no gaps."""

    n: int
    at: datetime
    attempt: int
    text: str


class ManifestEntry(Record):
    """A file the client says it is going to send."""

    path: str
    size: int | None = Field(None, ge=0, lt=2**53)
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")


class DatasetRecord(Record):
    """A set of uploaded files. ``report`` is what the validation found (or why it was rejected)."""

    id: str
    tenant: str = Field("local", description="Whose it is.")
    name: str
    state: DatasetState
    files: int = 0
    bytes: int = 0
    missing: tuple[str, ...] = Field((), description="Manifest paths not received yet.")
    report: dict[str, Any] | None = None
    error: JobError | None = None
    created_at: datetime
    expires_at: datetime | None = Field(
        None, description="When its files go unless it is used; none while a job uses it, or never."
    )
    revision: int = 0


class DatasetFile(Record):
    """One file of a dataset. Read it by ``key``."""

    path: str
    key: str
    size: int
    sha256: str
    created_at: datetime


UploadKind = Literal["archive", "file", "signed"]
UploadState = Literal["receiving", "received", "stored", "rejected"]


class Upload(Record):
    """Bytes on their way into a dataset: an archive, one file, or one file that is sent to the store itself."""

    id: str
    dataset_id: str
    kind: UploadKind
    path: str | None = Field(None, description="The file's path; none for an archive.")
    size: int
    sha256: str | None = Field(None, description="As announced; what arrives must have it.")
    state: UploadState
    received: int = Field(description="Bytes that are safe; the next byte to send has this number.")
    error: JobError | None = Field(None, description="Why it was rejected.")
    created_at: datetime
    expires_at: datetime = Field(description="It is given up then, unless it goes on.")
    folder: str = Field(description="Where its pieces lie in the FileStore.")


T = TypeVar("T")


class Page(Record, Generic[T]):
    """One page of a listing; ``next_cursor`` is opaque and none at the end."""

    items: tuple[T, ...]
    next_cursor: str | None = None
