"""Validates a dataset in a child process, so that no long-lived process decodes strangers' files."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workers.child import Child, log_tail
from workers.files import FileStore
from workers.records import JobError
from workers.settings import Settings

log = logging.getLogger(__name__)

EXIT_INPUT_ERROR = 2


@dataclass(frozen=True)
class Verdict:
    """``error`` is none for a good dataset; ``report`` is what the check found out."""

    report: dict[str, Any]
    error: JobError | None


async def check_files(files: FileStore, members: Sequence[tuple[str, str]], settings: Settings) -> Verdict:
    """Run the check program on the files, given as (key, path). Its crash or timeout is a rejection too."""
    parent = settings.scratch_dir / "checks"
    parent.mkdir(parents=True, exist_ok=True)
    for old in parent.iterdir():  # of processes that were killed
        if time.time() - old.stat().st_mtime > 2 * settings.check_timeout_s:
            shutil.rmtree(old, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(dir=parent))
    try:
        dataset = folder / "input"
        await files.stage(members, dataset)
        return await _run(dataset, folder / "log.txt", settings)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


async def _run(dataset: Path, errors: Path, settings: Settings) -> Verdict:
    child = await Child.start(settings.check_command, dataset, errors, {"OMP_NUM_THREADS": "1"})
    try:
        async with asyncio.timeout(settings.check_timeout_s):
            said = b"".join([line async for line in child.lines()])
            status = await child.wait()
    except TimeoutError:
        detail = f"The check took longer than {settings.check_timeout_s:g} s."
        return Verdict(
            {}, JobError(code="check_timeout", detail=detail, mend="Send fewer or smaller images.")
        )
    finally:
        child.kill()
        await child.wait()
    try:
        answer = json.loads(said)
        if status == 0:
            return Verdict(dict(answer["report"]), None)
        if status == EXIT_INPUT_ERROR:
            return Verdict({}, JobError(**answer["error"]))
    except (ValueError, TypeError, KeyError) as error:
        log.error("the check program's answer is unreadable: %s", error)
    detail = f"The check of the files ended unexpectedly (status {status})."
    return Verdict({}, JobError(code="check_crashed", detail=detail, log_tail=log_tail(errors)))
