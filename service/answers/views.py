"""The engine's records as the wire has them: without what only the engine knows."""

from __future__ import annotations

from urllib.parse import quote

from biresnerf.wire.datasets import FileView, UploadView
from biresnerf.wire.jobs import job_url
from biresnerf.wire.results import ArtifactView
from workers.records import Artifact, DatasetFile, Upload


def artifact_view(job_id: str, artifact: Artifact) -> ArtifactView:
    """One file of a result."""
    return ArtifactView(
        **artifact.model_dump(include={"name", "size", "sha256", "media_type"}),
        preview=artifact.preview,
        href=f"{job_url(job_id)}/artifacts/{quote(artifact.name)}",
    )


def file_view(file: DatasetFile) -> FileView:
    """One file of a dataset."""
    return FileView(**file.model_dump(exclude={"key"}))


def upload_view(upload: Upload) -> UploadView:
    """Bytes on their way into a dataset."""
    return UploadView(**upload.model_dump(exclude={"folder"}))
