"""What goes over the wire about uploads on their way, and about links to results."""

from __future__ import annotations

from datetime import datetime
from urllib.parse import quote

from pydantic import ConfigDict, Field

from service.schemas import Wire
from workers.records import JobError, Upload, UploadKind, UploadState


class UploadView(Wire):
    """Bytes on their way into a dataset."""

    id: str
    dataset_id: str
    kind: UploadKind
    path: str | None = Field(None, description="The file's path; null for an archive.")
    size: int
    sha256: str | None = None
    state: UploadState
    received: int = Field(description="Bytes that are safe; the next byte to send has this number.")
    error: JobError | None = Field(None, description="Why it was rejected.")
    created_at: datetime
    expires_at: datetime = Field(description="It is given up then, unless it goes on.")

    @classmethod
    def of(cls, upload: Upload) -> UploadView:
        """The upload as the wire has it."""
        return cls(**upload.model_dump(exclude={"folder"}))


class FileToSend(Wire):
    """A file that the client is going to send to the store itself."""

    path: str = Field(max_length=4096)
    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class NewSignedUploads(Wire):
    """Files to send to the store itself."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"files": [{"path": "a.jpg", "size": 12, "sha256": "0" * 64}]}]}
    )

    files: list[FileToSend] = Field(min_length=1, max_length=1000)


class SignedUpload(Wire):
    """Where to send one file: the bytes as the body of a PUT, without a key."""

    upload: UploadView
    url: str


class SignedUploads(Wire):
    """The addresses, in the order of the files."""

    items: list[SignedUpload]


class NewShare(Wire):
    """A link to make."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "transforms.json", "valid_s": 3600}]})

    name: str = Field(max_length=1000, description="The file, as the list of artifacts names it.")
    valid_s: int = Field(3600, ge=1, le=30 * 86_400, description="How long the link is good.")


class ShareView(Wire):
    """A link to one file that needs no key."""

    name: str
    href: str
    expires_at: datetime


def upload_url(upload_id: str) -> str:
    """The upload's path."""
    return f"/v1/uploads/{quote(upload_id, safe='')}"
