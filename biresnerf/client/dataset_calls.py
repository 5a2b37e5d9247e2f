"""What can be asked about datasets; `sending` fills them."""

from __future__ import annotations

from collections.abc import Sequence

from biresnerf.client.calls import Call, Flow, Pause, Session, ask
from biresnerf.client.errors import ServiceError
from biresnerf.client.pages import collect
from biresnerf.wire.datasets import (
    DatasetList,
    DatasetState,
    DatasetView,
    FileList,
    FileView,
    ManifestEntry,
    NewDataset,
    dataset_url,
)

_POLL_S, _LONGEST_POLL_S = 0.2, 3.0


def create_dataset(session: Session, name: str, manifest: Sequence[ManifestEntry] = ()) -> Flow[DatasetView]:
    """A dataset; ``missing`` of it says which files of the manifest have to be sent."""
    body = NewDataset(name=name, manifest=list(manifest)).model_dump(mode="json")
    # Asked for twice, there would be a second one, empty until it expires: no harm.
    answer = yield from ask(session, Call("POST", "/v1/datasets", json=body))
    return answer.model(DatasetView)


def dataset(session: Session, dataset_id: str) -> Flow[DatasetView]:
    """The dataset, with what the check found once it is ready."""
    answer = yield from ask(session, Call("GET", dataset_url(dataset_id)))
    return answer.model(DatasetView)


def datasets(
    session: Session, *, state: DatasetState | None = None, limit: int | None = None
) -> Flow[list[DatasetView]]:
    """Datasets, the newest first."""
    params = {"state": state} if state else {}
    return (
        yield from collect(
            session, Call("GET", "/v1/datasets", params), lambda answer: answer.model(DatasetList), limit
        )
    )


def dataset_files(session: Session, dataset_id: str, *, limit: int | None = None) -> Flow[list[FileView]]:
    """The files received, by path."""
    call = Call("GET", f"{dataset_url(dataset_id)}/files")
    return (yield from collect(session, call, lambda answer: answer.model(FileList), limit))


def finalize(session: Session, dataset_id: str) -> Flow[DatasetView]:
    """Has the dataset checked; gives it once it is ready. Raises `ServiceError` with what is wrong with it."""
    call = Call("POST", f"{dataset_url(dataset_id)}/finalize", headers={"Prefer": "respond-async"})
    found = (yield from ask(session, call)).model(DatasetView)
    pause_s = _POLL_S
    while found.state == "finalizing":
        yield Pause(pause_s)
        pause_s = min(1.5 * pause_s, _LONGEST_POLL_S)
        found = yield from dataset(session, dataset_id)
    if found.state == "rejected":
        if found.error is None:
            raise ServiceError("dataset_invalid", "The service rejected the dataset.", status=422)
        raise ServiceError.of(found.error, status=422)
    return found


def delete_dataset(session: Session, dataset_id: str) -> Flow[None]:
    """Deletes the dataset and its files. Its jobs, finished ones too, have to be deleted first."""
    yield from ask(session, Call("DELETE", dataset_url(dataset_id)))
