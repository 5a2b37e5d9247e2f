"""What the engine keeps to itself, and what clients see of its records."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from biresnerf.wire.datasets import FileList, FileView
from biresnerf.wire.jobs import JobProgress, JobView
from workers.records import Artifact, DatasetFile, Upload, record_from_row

NOW = datetime(2026, 1, 31, tzinfo=UTC)
FILE = {
    "path": "a.jpg",
    "size": 3,
    "sha256": "0" * 64,
    "created_at": NOW,
    "key": "datasets/ds_1/secret/a.jpg",
}
JOB: dict[str, Any] = {
    "id": "job_1",
    "dataset_id": "ds_1",
    "state": "queued",
    "created_at": NOW,
    "options": {},
}


def test_no_answer_tells_where_a_file_is_stored() -> None:
    file = DatasetFile.model_validate(FILE)
    listed = FileList(items=[file])
    for text in (file.model_dump_json(), listed.model_dump_json()):
        assert "a.jpg" in text
        assert "secret" not in text
    assert set(FileView.model_fields) == set(file.model_dump())


def test_an_upload_does_not_tell_its_folder() -> None:
    upload = Upload(
        id="up_1",
        dataset_id="ds_1",
        kind="archive",
        size=3,
        state="receiving",
        received=0,
        created_at=NOW,
        expires_at=NOW,
        folder="datasets/ds_1/uploads/up_1",
    )
    assert "folder" not in upload.model_dump()


def test_the_database_keeps_the_key_of_an_artifact() -> None:
    stored = Artifact(name="a.json", key="jobs/job_1/a.json", size=1, sha256="", media_type="text/plain")
    assert Artifact.model_validate(stored.model_dump()) == stored


def test_a_record_takes_its_own_columns_of_a_row_and_nothing_else() -> None:
    row = {**FILE, "dataset_id": "ds_1", "revision": 4}
    assert record_from_row(DatasetFile, row) == DatasetFile.model_validate(FILE)


def test_a_given_value_replaces_the_column_of_its_name() -> None:
    job = record_from_row(JobView, {**JOB, "priority": -1}, priority="low", progress=JobProgress(step=3))
    assert (job.priority, job.progress.step) == ("low", 3)


def test_a_job_links_to_its_parts_however_its_id_is_spelled() -> None:
    links = JobView(**{**JOB, "id": "job/1"}).links
    assert (links.self, links.dataset, links.events) == (
        "/v1/jobs/job%2F1",
        "/v1/datasets/ds_1",
        "/v1/jobs/job%2F1/events",
    )


def test_a_client_keeps_the_links_that_the_service_sent() -> None:
    sent = JobView(**JOB).model_dump(mode="json")
    sent["links"]["events"] = "/behind/a/proxy"
    assert JobView.model_validate(sent).links.events == "/behind/a/proxy"
