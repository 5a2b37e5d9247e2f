"""The result of a job: its files, links to them, and a row per image."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field

from biresnerf.report import ImageReport
from biresnerf.wire.base import NO_CONTROLS, Record


class ResultFile(Record):
    """One file of a result, or the log of a failed job."""

    name: str = Field(
        examples=["transforms.json"],
        description="Path relative to the result, for example renders/orbit.mp4.",
    )
    size: int = Field(examples=[41_305])
    sha256: str = Field(examples=["9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"])
    media_type: str = Field(examples=["application/json"])


class ArtifactView(ResultFile):
    """One file of a result, with its path."""

    preview: bool = Field(False, description="A preview of a running job; the next one replaces it.")
    href: str = Field(examples=["/v1/jobs/job_01JD8Y3V1QKZ5M0C7W2N4T6XAB/artifacts/transforms.json"])


class ArtifactList(Record):
    """All files of a result, by name."""

    items: list[ArtifactView]


class ImageRow(ImageReport):
    """The report of one image, with the change of its PSNR."""

    delta_psnr: float | None = Field(
        None, examples=[3.5], description="trial_psnr_after - trial_psnr_before."
    )


class ImageList(Record):
    """The images of a result."""

    partial: bool = Field(description="The job was stopped before it was complete.")
    items: list[ImageRow]


IMAGE_COLUMNS = frozenset(ImageRow.model_fields) - {"exposure"}


class NewShare(Record):
    """A link to create."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "transforms.json", "valid_s": 3600}]})

    name: str = Field(
        max_length=1000,
        pattern=NO_CONTROLS,
        description="The name of the file in the list of artifacts.",
    )
    valid_s: int = Field(3600, ge=1, le=30 * 86_400, description="How long the link is valid.")


class ShareView(Record):
    """A link to one file; it needs no API key."""

    name: str = Field(examples=["transforms.json"])
    href: str = Field(
        examples=[
            "/v1/shared/job_01JD8Y3V1QKZ5M0C7W2N4T6XAB/transforms.json?expires=1795291200&signature=kq0h…"
        ]
    )
    expires_at: datetime


class NewLink(Record):
    """A link to the page of a job."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"valid_s": 86_400}]})

    valid_s: int = Field(7 * 86_400, ge=60, le=90 * 86_400, description="How long it is valid.")


class LinkView(Record):
    """A link that shows one job, read-only, without an API key."""

    id: str = Field(examples=["lnk_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    job_id: str = Field(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    created_at: datetime
    expires_at: datetime


class NewLinkView(LinkView):
    """A link just created, with its secret."""

    token: str = Field(
        examples=["brl_5T0QAZ81M2_kq0h…"],
        description="Shown once. Sent as a Bearer token it reads this job alone.",
    )
    page: str = Field(
        examples=["/#/shared/job_01JD8Y3V1QKZ5M0C7W2N4T6XAB/brl_5T0QAZ81M2_kq0h…"],
        description="The page's address, relative to the service. Browsers do not send the part after #.",
    )


class LinkList(Record):
    """The active links to a job."""

    items: tuple[LinkView, ...]
