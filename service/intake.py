"""From an uploaded archive to the files of a dataset."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

from service.confined import Limits, run_confined
from service.dependencies import Service
from service.problems import ProblemError
from service.unpack import UnpackRequest
from workers.records import DatasetRecord

RATIO_MAX = 200.0
_CHUNK = 2**20
# Python, zlib and the table of contents of an archive with as many entries as we take.
_UNPACK_MEMORY_BYTES = 1536 * 2**20
# What stands for the whole input when it lies in the only folder of an archive.
_KEPT_FOLDERS = {"images"}


async def take_archive(service: Service, dataset_id: str, archive: Path, into: Path) -> DatasetRecord:
    """Unpacks ``archive`` in a child, into the empty folder ``into``; then stores what came out.

    Nothing is stored unless the whole archive is good.

    Raises:
        ProblemError: what is wrong with the archive, and with which entry.
    """
    settings = service.settings
    dataset = await service.stores.datasets.get(dataset_id)
    if dataset.state != "open":
        raise ProblemError(
            "dataset_not_open", f"The dataset is {dataset.state}.", mend="Create a new dataset."
        )
    request = UnpackRequest(
        archive=archive,
        into=into,
        files_max=settings.max_files - dataset.files,
        bytes_max=min(settings.max_unpacked_bytes, settings.max_dataset_bytes - dataset.bytes),
        file_bytes_max=settings.max_file_bytes,
        ratio_max=RATIO_MAX,
    )
    limits = Limits(
        seconds=settings.check_timeout_s,
        memory_bytes=_UNPACK_MEMORY_BYTES,
        file_bytes=settings.max_file_bytes + 2**20,
    )
    await run_confined("service.unpack", request, limits)
    root = await asyncio.to_thread(content_root, into)
    for path in await asyncio.to_thread(_files_below, root):
        name = path.relative_to(root).as_posix()
        await service.stores.datasets.add_file(dataset_id, name, _chunks(path))
    return await service.stores.datasets.get(dataset_id)


def content_root(folder: Path) -> Path:
    """The folder that holds the data: single folders that merely wrap everything are passed through."""
    while True:
        children = list(folder.iterdir())
        if len(children) != 1 or not children[0].is_dir() or children[0].name.lower() in _KEPT_FOLDERS:
            return folder
        folder = children[0]


def _files_below(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file())


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while chunk := await asyncio.to_thread(file.read, _CHUNK):
            yield chunk
