"""Submits a job with one multipart request: archive in, dataset checked, job queued."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

from fastapi import Request

from biresnerf.wire.jobs import JobTexts, JobView
from service.http.access import Caller
from service.http.problems import wrong_field
from service.intake.archive_import import file_sha256, import_archive
from service.intake.dataset_finalize import begin_check, finish_check
from service.intake.json_body import load_json, validate
from service.intake.uploads import Form, limited_body, staging_folder
from workers.settings.errors import EngineError

# For the text fields and the delimiters of the form.
_FORM_BYTES = 2**20
TEXTS = tuple(JobTexts.model_fields)
# Plain text; the other text fields are JSON.
PLAIN = ("priority", "deadline_at")


async def submit_form(caller: Caller, request: Request, idempotency_key: str | None) -> tuple[JobView, bool]:
    """Submits the form: `archive`, and the texts as JSON but for those of `PLAIN`.

    Returns the job and whether it is new. A repeated request with the same key is recognised by the archive's digest,
    before anything is unpacked. If the job cannot be submitted, its dataset is deleted. Needs the scope
    ``datasets:write``.
    """
    caller.require("datasets:write")
    limit = caller.service.settings.max_archive_bytes + _FORM_BYTES
    body = limited_body(request, limit, caller.service.disk_budget)
    with caller.sending():
        async with staging_folder(caller.service.staging_dir) as folder:
            form = Form("archive", TEXTS, folder / "archive")
            await form.read(request.headers["content-type"], body)
            return await _submit_received(caller, folder / "archive", form, idempotency_key)


async def _submit_received(
    caller: Caller, archive: Path, form: Form, idempotency_key: str | None
) -> tuple[JobView, bool]:
    if not form.has_file:
        raise wrong_field("#/archive", "The form has no file field `archive`.")
    texts = _texts(form)
    digest = await asyncio.to_thread(file_sha256, archive)
    if idempotency_key is not None:
        known = await caller.jobs.repeated(digest, texts, idempotency_key)
        if known is not None:
            return known, False
    datasets = caller.datasets
    dataset = await datasets.create("one-shot")
    used = False
    try:
        await import_archive(caller.service, dataset.id, archive)
        await begin_check(caller, dataset.id)
        await finish_check(caller, dataset.id)
        job, used = await caller.jobs.submit(
            dataset.id, **dict(texts), idempotency_key=idempotency_key, request_digest=digest
        )
        return job, used
    finally:
        if not used:
            with contextlib.suppress(EngineError):
                await datasets.delete(dataset.id)


def _texts(form: Form) -> JobTexts:
    given = {name: text.strip() for name, text in form.texts.items() if text.strip()}
    values = {name: text if name in PLAIN else load_json(text) for name, text in given.items()}
    return validate(values, JobTexts)
