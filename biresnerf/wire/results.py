"""What a job leaves behind: files, links to them, and a row for each image."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field

from biresnerf.report import ImageReport
from biresnerf.wire.base import Record


class ResultFile(Record):
    """One file of a result, or the log of a failed job."""

    name: str = Field(description="Path relative to the result, for example renders/orbit.mp4.")
    size: int
    sha256: str
    media_type: str


class ArtifactView(ResultFile):
    """One file of a result, and where it is."""

    preview: bool = Field(
        False, description="It shows a job that is not over; another one will take its place."
    )
    href: str


class ArtifactList(Record):
    """All files of a result, by name."""

    items: list[ArtifactView]


class ImageRow(ImageReport):
    """One image, and how much better its photo was predicted from the refined poses."""

    delta_psnr: float | None = Field(None, description="trial_psnr_after - trial_psnr_before.")


class ImageList(Record):
    """The images of a result."""

    partial: bool = Field(description="The job was stopped before its end.")
    items: list[ImageRow]


IMAGE_COLUMNS = frozenset(ImageRow.model_fields) - {"exposure"}


class NewShare(Record):
    """A link to make."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "transforms.json", "valid_s": 3600}]})

    name: str = Field(max_length=1000, description="The file, as the list of artifacts names it.")
    valid_s: int = Field(3600, ge=1, le=30 * 86_400, description="How long the link is good.")


class ShareView(Record):
    """A link to one file that needs no key."""

    name: str
    href: str
    expires_at: datetime
