"""A small image set with noisy poses, to try the service with."""

from __future__ import annotations

import asyncio
import logging
import shutil
import signal
import sys
import tempfile
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse

from biresnerf.errors import BiresnerfError
from service.http.access import ReadCaller
from workers.process.die_with_parent import dying_with_parent

logger = logging.getLogger(__name__)
router = APIRouter(tags=["service"])
# As in the quick start: small enough to make and refine while one waits, large enough for feature matches.
SAMPLE = ("--views", "32", "--size", "160", "--noise", "0.12", "--seed", "3")
_making = asyncio.Lock()


@router.get(
    "/v1/sample",
    response_class=FileResponse,
    responses={
        200: {"description": "A zip.", "content": {"application/zip": {"schema": {"type": "string"}}}}
    },
)
async def get_sample(caller: ReadCaller) -> FileResponse:
    """A zip of a synthetic image set: a still life whose poses are turned at random, by 10° on average."""
    path = caller.service.settings.data_dir / "sample.zip"
    async with _making:
        if not path.is_file():
            await _make(path)
    return FileResponse(path, media_type="application/zip", filename="sample.zip")


async def _make(path: Path) -> None:
    """Renders the set in a child process; its libraries must not be loaded here."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="sample-", dir=path.parent))
    try:
        command = [
            sys.executable,
            "-P",
            "-m",
            "biresnerf.command_line",
            "make-scene",
            str(folder / "set"),
            *SAMPLE,
        ]
        child = await asyncio.create_subprocess_exec(
            *dying_with_parent(command, signal_number=signal.SIGKILL),
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        _, said = await child.communicate()
        if child.returncode != 0:
            logger.error("the sample could not be made: %s", said.decode(errors="replace")[-2000:])
            raise BiresnerfError("The sample could not be made.")  # clients read no paths of the server
        archive = await asyncio.to_thread(shutil.make_archive, str(folder / "set"), "zip", folder / "set")
        Path(archive).replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
