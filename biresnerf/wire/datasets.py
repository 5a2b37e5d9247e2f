"""Datasets, their files, and uploads."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal
from urllib.parse import quote

from pydantic import ConfigDict, Field, StringConstraints

from biresnerf.options.given_poses import PoseQuestion
from biresnerf.options.presets import PRESET_IF_LEFT_OUT, PresetName
from biresnerf.report import IntrinsicsSource
from biresnerf.wire.base import NO_CONTROLS, Links, Page, Record
from biresnerf.wire.problems import JobError

DatasetState = Literal["open", "finalizing", "ready", "rejected", "expired"]
UploadKind = Literal["archive", "file", "signed"]
Row = tuple[float, float, float, float]
UploadState = Literal["receiving", "received", "stored", "rejected"]


class ManifestEntry(Record):
    """A file that the client is going to send."""

    path: str
    size: int | None = Field(None, ge=0, lt=2**53)
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")


class CheckReport(Record):
    """What the check of a dataset found."""

    images: int = Field(examples=[60])
    with_pose: int = Field(examples=[60])
    without_pose: int = Field(examples=[0])
    poses: Literal["missing", "partial", "given"] = Field(examples=["given"])
    cameras: int = Field(examples=[1])
    camera_models: tuple[str, ...] = Field(examples=[["OPENCV"]], description="COLMAP's names.")
    intrinsics: tuple[IntrinsicsSource, ...] = Field(
        examples=[["given"]], description="Where those of the cameras come from."
    )
    format: str = Field(examples=["nerfstudio"])
    masks: int = Field(examples=[0])
    transparency: bool = Field(description="Whether images have an alpha channel.")
    warnings: tuple[str, ...] = Field(examples=[[]])
    pose_question: PoseQuestion | None = Field(
        None,
        examples=[None],
        description="Whether the given poses are meant in another way; null: it seems not.",
    )
    expected_s: dict[PresetName, tuple[float, float]] = Field(
        {},
        examples=[{"fast": (95.0, 95.0), "balanced": (230.0, 690.0)}],
        description="The least and the most seconds that a job with each preset is expected to take on the idle "
        "machine that checked it: the same number twice where earlier jobs there measured all of it.",
    )
    preset: PresetName = Field(
        "fast", description=f"Of a job that names none, on that machine: {PRESET_IF_LEFT_OUT}."
    )


class CheckProgress(Record):
    """How far the check of a dataset is."""

    photos_read: int = Field(examples=[12])
    photos: int = Field(examples=[60], description="All that it will read, frames of videos included.")


class DatasetLinks(Links):
    """Paths of the parts of a dataset."""

    files: str
    archive: str
    uploads: str
    finalize: str


class DatasetView(Record):
    """A set of uploaded files."""

    id: str = Field(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    tenant: str = Field("local", description="The owner.")
    name: str = Field(examples=["kitchen"])
    state: DatasetState = Field(examples=["ready"])
    files: int = Field(0, examples=[61])
    bytes: int = Field(0, examples=[48_211_034])
    missing: tuple[str, ...] = Field((), description="Manifest paths not received yet.")
    report: CheckReport | None = Field(
        None, description="What the check found; null unless the dataset is ready."
    )
    checked: CheckProgress | None = Field(
        None,
        examples=[None],
        description="How far the check is; null unless it runs and has found how many photos there are.",
    )
    error: JobError | None = Field(None, examples=[None])
    created_at: datetime
    expires_at: datetime | None = Field(
        None,
        description="When its files are deleted unless it is used; null while a job uses it, or if they are kept.",
    )
    revision: int = Field(0, examples=[63])
    links: DatasetLinks = Field(
        default_factory=lambda fields: DatasetLinks.below(dataset_url(fields.get("id", "")))
    )


class DatasetList(Page[DatasetView]):
    """A page of datasets, newest first."""


class NewDataset(Record):
    """An empty dataset to create."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "kitchen"}]})

    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=NO_CONTROLS)] = "dataset"
    manifest: list[ManifestEntry] = Field(
        default=[],
        max_length=100_000,
        description="The files that will be sent; the response lists those that are missing.",
    )


class MaskPlace(Record):
    """Where the readers find a photo's mask: a file of the dataset, or one that may be added to a copy of it."""

    path: str = Field(examples=["images/dynamic_mask_0001.png"])
    inverted: bool = Field(
        examples=[True], description="Only its black pixels count; else all others do, and black ones do not."
    )


class CheckedPhoto(Record):
    """A photo of a checked set."""

    name: str = Field(examples=["images/0001.jpg"], description="As the set's file of poses calls it.")
    camera: int = Field(examples=[0], description="Index in `cameras`.")
    world_from_cam: tuple[Row, Row, Row] | None = Field(
        examples=[[[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, -3.1]]],
        description="The given pose: the upper three rows, OpenCV axes, in the input's world. Null: to be found.",
    )
    read_as_asked: tuple[Row, Row, Row] | None = Field(
        None,
        examples=[None],
        description="The given pose if the answer to the report's `pose_question` is yes.",
    )
    masked: bool = Field(examples=[False])
    path: str | None = Field(
        None,
        examples=["images/0001.jpg"],
        description="Its file in the dataset; null for a frame of a video.",
    )
    orientation: int = Field(
        1,
        ge=1,
        le=8,
        examples=[1],
        description="As in EXIF: how stored pixels are turned into those that pose, lens and mask are for.",
    )
    mask: MaskPlace | None = Field(None, description="Null for a frame of a video.")


class CheckedCamera(Record):
    """A lens with a sensor."""

    model: str = Field(examples=["OPENCV"], description="COLMAP's name.")
    width: int = Field(examples=[1600])
    height: int = Field(examples=[1200])
    params: tuple[float, ...] = Field(
        examples=[[1380.0, 1380.0, 800.0, 600.0, 0, 0, 0, 0]],
        description="In COLMAP's order, px of the full size.",
    )


class PhotoSheet(Record):
    """All photos, small, in the picture `photos.jpg`: photo i lies in row i // columns, in the middle of its cell."""

    columns: int = Field(examples=[7])
    cell_width: int = Field(examples=[96])
    cell_height: int = Field(examples=[72])


class PhotoList(Record):
    """The photos of a checked set with the given poses."""

    photos: tuple[CheckedPhoto, ...]
    cameras: tuple[CheckedCamera, ...]
    sheet: PhotoSheet | None = Field(description="Null for more than 4,000 photos.")


class FileView(Record):
    """One file of a dataset."""

    path: str = Field(examples=["images/0001.jpg"])
    size: int = Field(examples=[803_120])
    sha256: str = Field(examples=["9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"])
    created_at: datetime


class FileList(Page[FileView]):
    """A page of a dataset's files, by path."""


class UploadView(Record):
    """An upload into a dataset."""

    id: str = Field(examples=["up_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    dataset_id: str = Field(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])
    kind: UploadKind
    path: str | None = Field(None, description="The file's path; null for an archive.")
    size: int = Field(
        examples=[48_211_034], description="Of a fetched file, what is known of it while it is `receiving`."
    )
    sha256: str | None = None
    host: str | None = Field(
        None,
        examples=[None],
        description="The host that it is fetched from; null for bytes that the client sends.",
    )
    state: UploadState
    received: int = Field(
        examples=[16_777_216], description="Bytes received and stored: the offset of the next byte to send."
    )
    error: JobError | None = Field(None, examples=[None], description="Why it was rejected.")
    created_at: datetime
    expires_at: datetime = Field(description="When it is deleted if no more bytes arrive.")


class UploadList(Record):
    """Uploads of a dataset, oldest first."""

    items: tuple[UploadView, ...]


class FileAddress(Record):
    """Where the service is to fetch a file, or an archive of files."""

    url: str = Field(
        max_length=8000,
        repr=False,
        examples=["https://bucket.s3.amazonaws.com/set/0001.jpg?X-Amz-Signature=…"],
        description="https; it is forgotten once the file was fetched.",
    )
    path: str | None = Field(
        None, max_length=4096, examples=["0001.jpg"], description="Null: it is a zip, tar or tar.gz."
    )
    size: int | None = Field(None, ge=0, lt=2**53)
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")


class NewFetches(Record):
    """Files that the service is to fetch."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"files": [{"url": "https://photos.example.org/set.zip"}]}]}
    )

    files: list[FileAddress] = Field(min_length=1, max_length=1000)


class FileToSend(Record):
    """A file that the client will send directly to the store."""

    path: str = Field(max_length=4096)
    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class NewSignedUploads(Record):
    """Files to send directly to the store."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"files": [{"path": "a.jpg", "size": 12, "sha256": "0" * 64}]}]}
    )

    files: list[FileToSend] = Field(min_length=1, max_length=1000)


class SignedUpload(Record):
    """Where to send one file: PUT its bytes there; no key is needed."""

    upload: UploadView
    url: str = Field(examples=["https://s3.example.org/bucket/datasets/…/content?X-Amz-Signature=…"])


class SignedUploads(Record):
    """The signed URLs, in the order of the files."""

    items: list[SignedUpload]


def dataset_url(dataset_id: str) -> str:
    """The dataset's path."""
    return f"/v1/datasets/{quote(dataset_id, safe='')}"


def upload_url(upload_id: str) -> str:
    """The upload's path."""
    return f"/v1/uploads/{quote(upload_id, safe='')}"
