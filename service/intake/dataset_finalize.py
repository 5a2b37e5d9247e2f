"""Finalizes a dataset: freezes its files, starts the check, and waits for it."""

from __future__ import annotations

import asyncio

from biresnerf.errors import Fault, InputError
from biresnerf.wire.datasets import DatasetView
from biresnerf.wire.safe_paths import NameSet
from service.http.access import Caller
from service.http.problems import ProblemError, problem_of
from service.intake.archive_import import import_received


async def begin_check(caller: Caller, dataset_id: str) -> DatasetView:
    """Freezes the dataset and starts its check, which continues if the client disconnects.

    Raises:
        ProblemError: ``name_collision``; then the dataset stays open.
    """
    store = caller.datasets
    await store.get(dataset_id)  # raises unless it is the caller's own
    await import_received(caller.service, dataset_id)
    names, cursor = NameSet(), None
    while True:
        page = await store.files(dataset_id, cursor=cursor)
        for file in page.items:
            try:
                names.add(file.path)
            except InputError as error:
                raise problem_of(error) from None
        if (cursor := page.next_cursor) is None:
            break
    dataset = await store.finalize(dataset_id)
    if dataset.state == "finalizing":
        caller.service.keep_running(store.check(dataset_id), name=f"check {dataset_id}")
    return dataset


async def finish_check(caller: Caller, dataset_id: str) -> DatasetView:
    """Waits for the check's outcome; raises ``ProblemError`` with what it found wrong."""
    for task in list(caller.service.background):
        if task.get_name() == f"check {dataset_id}":
            await asyncio.shield(task)
    dataset = await caller.datasets.check(dataset_id)
    if dataset.state == "rejected":
        raise ProblemError.of(
            dataset.error or Fault(code="dataset_invalid", detail="The check rejected the dataset.")
        )
    return dataset
