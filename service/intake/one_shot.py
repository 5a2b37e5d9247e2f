"""Submits a job with one multipart request: archive in, dataset checked, job queued."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncGenerator
from pathlib import Path

from fastapi import Request
from starlette.datastructures import Headers
from starlette.formparsers import MultiPartException, MultiPartParser

from biresnerf.wire.jobs import JobTexts, JobView
from service.http.access import Caller
from service.http.problems import ProblemError, wrong_field
from service.intake.archive_import import file_sha256, import_archive
from service.intake.dataset_finalize import begin_check, finish_check
from service.intake.json_body import load_json, validate
from service.intake.uploads import limited_body
from workers.process.locked_folders import locked_folder
from workers.settings.errors import EngineError

# Limits of all text fields with the form's delimiters, and of one text field.
_FORM_BYTES, _TEXT_BYTES = 2**20, 2**18
TEXTS = tuple(JobTexts.model_fields)
# Plain text; the other text fields are JSON.
PLAIN = ("priority", "deadline_at")
ARCHIVE = "archive"


class _FormParser(MultiPartParser):
    """Writes the form's file to ``target``; the base class uses the temporary folder, which may be small."""

    def __init__(self, content_type: str, body: AsyncGenerator[bytes, None], target: Path) -> None:
        headers = Headers({"content-type": content_type})
        super().__init__(headers, body, max_files=1, max_fields=len(TEXTS), max_part_size=_TEXT_BYTES)
        self._target = target
        self.complete = False

    def on_headers_finished(self) -> None:
        super().on_headers_finished()
        if self._current_part.file is not None:
            self._current_part.file.file = self._target.open("w+b")

    def on_end(self) -> None:
        self.complete = True


async def read_form(content_type: str, body: AsyncGenerator[bytes, None], target: Path) -> dict[str, str]:
    """The text fields of a form; writes its archive to ``target``.

    Raises:
        ProblemError: ``malformed_body``; ``invalid_request``: a field is unknown, repeated or no text, or there is no
            archive.
    """
    parser = _FormParser(content_type, body, target)
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise ProblemError("malformed_body", f"The form is malformed: {error.message}") from None
    await form.close()
    if not parser.complete:
        raise ProblemError("malformed_body", "The form is cut short: its end mark is missing.")
    fields = form.multi_items()
    for name, value in fields:
        pointer = "#/" + re.sub(r"[^\w.-]", "?", name)[:100]
        if isinstance(value, str) != (name in TEXTS) or name not in (ARCHIVE, *TEXTS):
            known = ", ".join(sorted(TEXTS))
            raise wrong_field(pointer, f"There is no such field; there are the file `archive`, and {known}.")
        if len(form.getlist(name)) > 1:
            raise wrong_field(pointer, "The field occurs twice.")
    if ARCHIVE not in form:
        raise wrong_field(f"#/{ARCHIVE}", "The form has no file field `archive`.")
    return {name: value for name, value in fields if isinstance(value, str)}


async def submit_form(caller: Caller, request: Request, idempotency_key: str | None) -> tuple[JobView, bool]:
    """Submits the form: `archive`, and text fields, which hold JSON except those of `PLAIN`.

    Returns the job and whether it is new. A repeated request with the same key is recognised by the archive's digest,
    before anything is unpacked. If the job cannot be submitted, its dataset is deleted. Needs the scope
    ``datasets:write``.
    """
    caller.require("datasets:write")
    limit = caller.service.settings.max_archive_bytes + _FORM_BYTES
    body = limited_body(request, limit, caller.service.disk_budget)
    with caller.sending():
        async with locked_folder(caller.service.staging_dir) as folder:
            texts = _texts(await read_form(request.headers["content-type"], body, folder / ARCHIVE))
            return await _submit_received(caller, folder / ARCHIVE, texts, idempotency_key)


async def _submit_received(
    caller: Caller, archive: Path, texts: JobTexts, idempotency_key: str | None
) -> tuple[JobView, bool]:
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


def _texts(form: dict[str, str]) -> JobTexts:
    given = {name: text.strip() for name, text in form.items() if text.strip()}
    values = {name: text if name in PLAIN else load_json(text) for name, text in given.items()}
    return validate(values, JobTexts)
