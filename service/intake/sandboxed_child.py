"""Child programs that parse untrusted files, with limits on time, memory and disk.

The web process never parses an archive or an image. A child reads one JSON request from standard input and
writes one JSON line: ``{"result": ...}`` or ``{"error": a fault}``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import resource
import signal
import sys
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel, Field

from biresnerf.errors import Fault, InputError
from biresnerf.frozen_model import FrozenModel
from service.http.problems import ProblemError
from workers.process.die_with_parent import dying_with_parent

logger = logging.getLogger(__name__)

_ANSWER_BYTES_MAX = 16 * 2**20
# One thread: numpy's BLAS reserves address space per thread, which the memory limit counts.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class Limits(FrozenModel):
    """What a child may use."""

    seconds: float = Field(gt=0)
    memory_bytes: int = Field(gt=0, description="Address space, RLIMIT_AS.")
    file_bytes: int = Field(gt=0, description="Largest file it may write, RLIMIT_FSIZE.")


async def run_confined(module: str, request: BaseModel, limits: Limits) -> dict[str, Any]:
    """Runs ``python -m module`` on the request and returns its result.

    Raises:
        ProblemError: the child's error; ``validation_timeout``; ``validation_resources`` if it ran out of
            memory or was killed.
    """
    command = [sys.executable, "-P", "-m", module, limits.model_dump_json()]
    child = await asyncio.create_subprocess_exec(
        *dying_with_parent(command, signal_number=signal.SIGKILL, nice=5),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,
        # The child parses untrusted files, so it gets no database URL and no secret.
        env={**{k: v for k, v in os.environ.items() if not k.startswith("BIRESNERF_")}, **_ONE_THREAD},
        limit=_ANSWER_BYTES_MAX,
    )
    try:
        async with asyncio.timeout(limits.seconds):
            answer, log = await child.communicate(request.model_dump_json().encode())
    except TimeoutError:
        raise ProblemError(
            "validation_timeout",
            f"Reading the files was stopped after {limits.seconds:.0f} s.",
            hint="Send fewer or smaller images.",
        ) from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        await child.wait()
    return _read_answer(module, answer, log, child.returncode)


def _read_answer(module: str, answer: bytes, log: bytes, status: int | None) -> dict[str, Any]:
    try:
        content = json.loads(answer.splitlines()[-1])
    except (IndexError, ValueError):
        content = {}
    if status == 0 and "result" in content:
        result: dict[str, Any] = content["result"]
        return result
    if "error" in content:
        raise ProblemError.of(Fault.model_validate(content["error"]))
    logger.error("%s ended with status %s: %s", module, status, log[-2000:].decode(errors="replace"))
    raise ProblemError(
        "validation_resources",
        "Reading the files exceeded the memory limit or crashed the reader.",
        hint="Check for damaged or very large files.",
    )


def run_child(work: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Runs ``work`` in the child, with its limits. Call it under ``if __name__ == "__main__"``."""
    limits = Limits.model_validate_json(sys.argv[1])
    _confine(limits)
    request = json.loads(sys.stdin.buffer.read())
    # Output that libraries print must not mix with the answer.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    try:
        answer: dict[str, Any] = {"result": work(request)}
    except InputError as error:
        answer = {"error": error.fault.model_dump()}
    with os.fdopen(answer_to, "wb") as out:
        out.write(json.dumps(answer).encode() + b"\n")


def _confine(limits: Limits) -> None:
    for kind, amount in (
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_CPU, int(limits.seconds) + 1),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        limit = amount if hard == resource.RLIM_INFINITY else min(amount, hard)
        resource.setrlimit(kind, (limit, limit))
