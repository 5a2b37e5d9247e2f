"""What goes over the wire: the engine's records with links, and the bodies that clients send."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from biresnerf.config import PresetName, RefineOptions
from workers.records import (
    Artifact,
    DatasetFile,
    DatasetRecord,
    Job,
    JobState,
    ManifestEntry,
    PriorityName,
)
from workers.tenants import TenantShare
from workers.webhook_records import JobWebhook

Label = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f]*$")]
Labels = Annotated[dict[Label, Label], Field(max_length=20)]


class Wire(BaseModel):
    """Base of all bodies."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class NewDataset(Wire):
    """An empty dataset to create."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "kitchen"}]})

    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]*$")] = (
        "dataset"
    )
    manifest: list[ManifestEntry] = Field(
        default=[],
        max_length=100_000,
        description="What is going to be sent; the answer lists what is missing.",
    )


class NewJob(Wire):
    """A refinement to run."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"dataset_id": "ds_01", "options": {"preset": "fast"}, "labels": {"run": "a"}}]
        }
    )

    dataset_id: str = Field(max_length=100)
    options: RefineOptions = RefineOptions()
    labels: Labels = {}
    webhook: JobWebhook | None = Field(None, description="Who is told of this job, besides all webhooks.")
    priority: PriorityName = Field(
        "normal", description="Before or after other jobs; `high` only where the operator allows it."
    )


class JobTexts(Wire):
    """The text fields of the one-shot form."""

    options: RefineOptions = RefineOptions()
    labels: Labels = {}
    webhook: JobWebhook | None = Field(None, description="Who is told of this job, besides all webhooks.")


class JobLinks(Wire):
    """Where the parts of a job are."""

    self: str
    dataset: str
    events: str
    artifacts: str
    report: str
    images: str
    logs: str
    exports: str
    cancel: str
    fork: str


class JobView(Job):
    """A job with links."""

    links: JobLinks

    @classmethod
    def of(cls, job: Job) -> JobView:
        """The job as the wire has it."""
        here = job_url(job.id)
        links = JobLinks(
            self=here,
            dataset=dataset_url(job.dataset_id),
            events=f"{here}/events",
            artifacts=f"{here}/artifacts",
            report=f"{here}/report",
            images=f"{here}/images",
            logs=f"{here}/logs",
            exports=f"{here}/exports",
            cancel=f"{here}/cancel",
            fork=f"{here}/fork",
        )
        return cls(**dict(job), links=links)


class JobList(Wire):
    """A page of jobs, newest first."""

    items: list[JobView]
    next_cursor: str | None = Field(None, description="Opaque; null on the last page.")


class ArtifactView(Wire):
    """One file of a result."""

    name: str
    size: int
    sha256: str
    media_type: str
    preview: bool = Field(
        False, description="It shows a job that is not over; another one will take its place."
    )
    href: str

    @classmethod
    def of(cls, job_id: str, artifact: Artifact) -> ArtifactView:
        """The artifact as the wire has it."""
        return cls(
            **artifact.model_dump(include={"name", "size", "sha256", "media_type"}),
            preview=artifact.preview,
            href=f"{job_url(job_id)}/artifacts/{quote(artifact.name)}",
        )


class ArtifactList(Wire):
    """All files of a result, by name."""

    items: list[ArtifactView]


class DatasetLinks(Wire):
    """Where the parts of a dataset are."""

    self: str
    files: str
    archive: str
    uploads: str
    finalize: str


class DatasetView(DatasetRecord):
    """A dataset with links."""

    links: DatasetLinks

    @classmethod
    def of(cls, dataset: DatasetRecord) -> DatasetView:
        """The dataset as the wire has it."""
        here = dataset_url(dataset.id)
        links = DatasetLinks(
            self=here,
            files=f"{here}/files",
            archive=f"{here}/archive",
            uploads=f"{here}/uploads",
            finalize=f"{here}/finalize",
        )
        return cls(**dict(dataset), links=links)


class DatasetList(Wire):
    """A page of datasets, newest first."""

    items: list[DatasetView]
    next_cursor: str | None = None


class FileView(Wire):
    """One file of a dataset."""

    path: str
    size: int
    sha256: str
    created_at: datetime

    @classmethod
    def of(cls, file: DatasetFile) -> FileView:
        """The file as the wire has it."""
        return cls(**file.model_dump(exclude={"key"}))


class FileList(Wire):
    """A page of a dataset's files, by path."""

    items: list[FileView]
    next_cursor: str | None = None


class OptionsView(Wire):
    """What may be asked for: the JSON Schema of `options`, and every preset with all values filled in."""

    json_schema: dict[str, Any]
    presets: dict[PresetName, RefineOptions]


class SizeLimits(Wire):
    """What the service takes."""

    max_files: int
    max_file_bytes: int
    max_dataset_bytes: int
    max_archive_bytes: int
    max_unpacked_bytes: int
    max_archive_ratio: float
    job_timeout_s: float
    check_timeout_s: float


class Info(Wire):
    """What this service is."""

    name: Literal["biresnerf"] = "biresnerf"
    version: str
    limits: SizeLimits
    archives: list[str]
    job_counts: dict[JobState, int]
    share: TenantShare = Field(description="What you may use, and what you use. A limit of 0 is none.")


class Health(Wire):
    """The answer of a healthy process."""

    status: Literal["ok"] = "ok"


def job_url(job_id: str) -> str:
    """The job's path."""
    return f"/v1/jobs/{quote(job_id, safe='')}"


def dataset_url(dataset_id: str) -> str:
    """The dataset's path."""
    return f"/v1/datasets/{quote(dataset_id, safe='')}"
