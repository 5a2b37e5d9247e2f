"""Requests about datasets; `uploads` sends their files."""

from __future__ import annotations

from collections.abc import Sequence

from biresnerf.client.errors import ServiceError
from biresnerf.client.transport import Call, Transport, looks, parse
from biresnerf.wire.datasets import (
    DatasetList,
    DatasetState,
    DatasetView,
    FileAddress,
    FileList,
    FileView,
    ManifestEntry,
    NewDataset,
    NewFetches,
    UploadList,
    UploadView,
    dataset_url,
)

_ADDRESSES_AT_ONCE = 100  # a body of them is limited to 1 MiB


class DatasetCalls(Transport):
    """Requests about datasets."""

    async def create_dataset(self, name: str, manifest: Sequence[ManifestEntry] = ()) -> DatasetView:
        """Creates a dataset. Its ``missing`` lists the files of the manifest that have to be sent."""
        body = NewDataset(name=name, manifest=list(manifest)).model_dump(mode="json")
        # Sent twice, it creates a second dataset that stays empty and expires: no harm.
        return parse(await self._ask(Call("POST", "/v1/datasets", json=body)), DatasetView)

    async def dataset(self, dataset_id: str) -> DatasetView:
        """The dataset, with the results of its check once it is ready."""
        return parse(await self._ask(Call("GET", dataset_url(dataset_id))), DatasetView)

    async def datasets(
        self, *, state: DatasetState | None = None, limit: int | None = None
    ) -> list[DatasetView]:
        """Datasets, newest first."""
        params = {"state": state} if state else {}
        return await self._collect(Call("GET", "/v1/datasets", params), DatasetList, limit)

    async def dataset_files(self, dataset_id: str, *, limit: int | None = None) -> list[FileView]:
        """The files received, sorted by path."""
        return await self._collect(Call("GET", f"{dataset_url(dataset_id)}/files"), FileList, limit)

    async def fetch_files(self, dataset_id: str, files: Sequence[FileAddress]) -> list[UploadView]:
        """Has the service fetch files into a dataset; `finalize` waits for them."""
        made: list[UploadView] = []
        for start in range(0, len(files), _ADDRESSES_AT_ONCE):
            part = NewFetches(files=list(files[start : start + _ADDRESSES_AT_ONCE]))
            # Sent twice, they are fetched twice: no harm.
            call = Call("POST", f"{dataset_url(dataset_id)}/fetches", json=part.model_dump(mode="json"))
            made += parse(await self._ask(call), UploadList).items
        return made

    async def fetches(self, dataset_id: str) -> list[UploadView]:
        """Which of these files are not in the dataset yet, and which were rejected."""
        return list(
            parse(await self._ask(Call("GET", f"{dataset_url(dataset_id)}/fetches")), UploadList).items
        )

    async def finalize(self, dataset_id: str) -> DatasetView:
        """Has the dataset checked and returns it once it is ready.

        Raises:
            ServiceError: the check found something wrong.
        """
        call = Call("POST", f"{dataset_url(dataset_id)}/finalize", headers={"Prefer": "respond-async"})
        found = parse(await self._ask(call), DatasetView)
        async for _ in looks():
            if found.state != "finalizing":
                break
            found = await self.dataset(dataset_id)
        if found.state == "rejected":
            if found.error is None:
                raise ServiceError("dataset_invalid", "The service rejected the dataset.", status=422)
            raise ServiceError.of(found.error, status=422)
        return found

    async def delete_dataset(self, dataset_id: str) -> None:
        """Deletes the dataset and its files. All its jobs have to be deleted first."""
        await self._ask(Call("DELETE", dataset_url(dataset_id)))
