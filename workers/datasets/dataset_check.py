"""Validates datasets in a child process, so that no long-lived process decodes strangers' files."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import json
import logging
import shutil
import tempfile
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

from psycopg.types.json import Jsonb

from biresnerf.wire.datasets import CheckReport
from biresnerf.wire.problems import JobError
from workers.database.database import Connection, Database
from workers.process.disk_space import EXIT_DISK
from workers.process.memory_limits import CHECK_VARIABLE, memory_limit, memory_shares
from workers.process.turns import Turns
from workers.process.waiting import retry_while_unavailable
from workers.records import shown_folder, shown_key
from workers.run.child import Child, log_tail
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import discard, forget

log = logging.getLogger(__name__)

CHECK_NICE = 5  # more urgent than a job: somebody waits for it

EXIT_INPUT_ERROR = 2
CHECKS = "checks"
IN_USE = "in-use"
SETTLED_S = 1.0
LOOK_S = 0.5  # between two looks at a check that another process makes
GIVE_BACK_S = 2.0
LOSSES_MAX = 2
# A check may take so long: for any set, for each file, and by their bytes.
ANY_S, FILE_S, BYTES_PER_S = 120.0, 10.0, 100e3
FATAL = JobError(
    code="check_crashed",
    detail=f"{LOSSES_MAX} processes were lost while they checked the files.",
    hint="Look for damaged or very large files.",
)


class Checker:
    """Checks ``finalizing`` datasets, one at a time in this process and each by one process only.

    Tenants take turns: many datasets of one hold up another's by one check.
    """

    def __init__(self, database: Database, files: FileStore, settings: Settings) -> None:
        self._database, self._files, self._settings = database, files, settings
        self._turns = Turns(1)  # decoding a thousand photos is enough work for one machine

    async def check(self, dataset_id: str) -> None:
        """Returns once the dataset is not ``finalizing`` any more, after our check or another process's."""
        token = uuid.uuid4()
        owned = await retry_while_unavailable(
            lambda: self._database.fetch("SELECT tenant FROM datasets WHERE id = %s", dataset_id)
        )
        if not owned:
            return
        while True:
            async with self._turns.turn(owned[0]["tenant"]):
                losses = await retry_while_unavailable(lambda: self._take(dataset_id, token))
                if losses is not None and losses >= LOSSES_MAX:
                    await retry_while_unavailable(
                        lambda: self._database.run(_record, dataset_id, token, FATAL)
                    )
                elif losses is not None:
                    await self._check(dataset_id, token)
            rows = await retry_while_unavailable(
                lambda: self._database.fetch("SELECT state FROM datasets WHERE id = %s", dataset_id)
            )
            if not rows or rows[0]["state"] != "finalizing":
                return
            await asyncio.sleep(LOOK_S)

    async def unfinished(self) -> tuple[str, ...]:
        """Ids of ``finalizing`` datasets that no process checks; removes folders of processes that died."""
        await asyncio.to_thread(_sweep, self._settings.scratch_dir / CHECKS)
        rows = await self._database.fetch(
            "SELECT id FROM datasets WHERE state = 'finalizing'"
            " AND coalesce(check_until < clock_timestamp(), true) ORDER BY created_at"
        )
        return tuple(row["id"] for row in rows)

    async def _take(self, dataset_id: str, token: uuid.UUID) -> int | None:
        """Take or renew the lease; tells how many were lost who had it before, or none where it is another's.

        A lease, not a lock: who is frozen or cut off loses it.
        """
        rows = await self._database.fetch(
            "UPDATE datasets SET check_token = %s, check_until = clock_timestamp() + make_interval(secs => %s),"
            " check_losses = check_losses + (check_token IS NOT NULL AND check_token <> %s)::int"
            " WHERE id = %s AND state = 'finalizing'"
            " AND (check_token = %s OR check_until IS NULL OR check_until < clock_timestamp())"
            " RETURNING check_losses",
            *(token, 2 * self._settings.beat_s, token, dataset_id, token),
        )
        return int(rows[0]["check_losses"]) if rows else None

    async def _check(self, dataset_id: str, token: uuid.UUID) -> None:
        rows = await retry_while_unavailable(
            lambda: self._database.fetch(
                "SELECT key, path FROM dataset_files WHERE dataset_id = %s", dataset_id
            )
        )
        renewing = asyncio.create_task(self._renew(dataset_id, token))
        shown = shown_key(dataset_id)
        try:
            # Until the outcome is recorded: this process may be killed, or the dataset deleted, before that.
            await retry_while_unavailable(
                lambda: self._database.run(discard, shown, after_s=self._settings.upload_expiry_s)
            )
            files = [(row["key"], row["path"]) for row in rows]
            outcome = await check_files(self._files, files, self._settings, shown)
        except BaseException:  # a full disk, a shutdown: it was not the files that ended it
            await self._give_back(dataset_id, token)
            raise
        finally:
            renewing.cancel()
        await retry_while_unavailable(lambda: self._database.run(_record, dataset_id, token, outcome))

    async def _renew(self, dataset_id: str, token: uuid.UUID) -> None:
        while True:
            await asyncio.sleep(self._settings.beat_s / 2)
            with contextlib.suppress(Unavailable):  # the next time will do
                if await self._take(dataset_id, token) is None:
                    # Taken for lost, but only frozen or cut off. (No row where the dataset is gone.)
                    await self._database.fetch(
                        "UPDATE datasets SET check_losses = greatest(check_losses - 1, 0)"
                        " WHERE id = %s AND state = 'finalizing'",
                        dataset_id,
                    )
                    return

    async def _give_back(self, dataset_id: str, token: uuid.UUID) -> None:
        with contextlib.suppress(Unavailable, TimeoutError):
            async with asyncio.timeout(GIVE_BACK_S):
                await self._database.fetch(
                    "UPDATE datasets SET check_token = NULL, check_until = NULL"
                    " WHERE id = %s AND check_token = %s",
                    *(dataset_id, token),
                )


async def _record(
    connection: Connection, dataset_id: str, token: uuid.UUID, outcome: CheckReport | JobError
) -> None:
    """Write the outcome down, unless another process has the lease by now."""
    found = Jsonb(outcome.model_dump(mode="json"))
    ours = await connection.row(
        "UPDATE datasets SET state = %s, report = %s, error = %s, revision = revision + 1,"
        " check_token = NULL, check_until = NULL"
        " WHERE id = %s AND state = 'finalizing' AND check_token = %s RETURNING id",
        *(("rejected", None, found) if isinstance(outcome, JobError) else ("ready", found, None)),
        *(dataset_id, token),
    )
    if ours and isinstance(outcome, CheckReport):
        await forget(connection, shown_key(dataset_id))


async def check_files(
    files: FileStore, members: Sequence[tuple[str, str]], settings: Settings, shown: str
) -> CheckReport | JobError:
    """Run the check program on the files, given as (key, path). Its crash or timeout rejects them too.

    What pages show of a good set is stored below the key ``shown``.

    Where it is killed (perhaps by the kernel, because another process took too much memory) it is tried once more.

    Raises:
        OSError: the disk is full, which says nothing about the files.
        Unavailable: the store is away.
    """
    parent = settings.scratch_dir / CHECKS
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=parent))
    lock = (folder / IN_USE).open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the kernel frees it, however we die
        dataset = folder / "input"
        await files.stage(members, dataset)
        outcome, killed = await _run(dataset, folder / "log.txt", settings)
        if killed:
            log.warning("the check of %d files was killed; trying once more", len(members))
            outcome, _ = await _run(dataset, folder / "log.txt", settings)
        if isinstance(outcome, CheckReport):
            made = shown_folder(dataset)
            for path in sorted(path for path in made.rglob("*") if path.is_file()):
                await files.put_path(f"{shown}/{path.relative_to(made).as_posix()}", path)
        return outcome
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.close()


def _sweep(parent: Path) -> None:
    """Remove folders of processes that were killed."""
    for folder in parent.iterdir() if parent.is_dir() else ():
        with contextlib.suppress(OSError):  # in use, or gone by now
            if time.time() - folder.stat().st_mtime < SETTLED_S:
                continue  # perhaps made, and not locked yet
            if (folder / IN_USE).exists():
                with (folder / IN_USE).open() as lock:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)


def _enough_s(dataset: Path) -> float:
    """Seconds that honest files take at most, also on a busy machine: a few of them hold no place for minutes."""
    sizes = [path.stat().st_size for path in dataset.rglob("*") if path.is_file()]
    return ANY_S + FILE_S * len(sizes) + sum(sizes) / BYTES_PER_S


async def _run(dataset: Path, errors: Path, settings: Settings) -> tuple[CheckReport | JobError, bool]:
    """The outcome, and whether a signal ended the program. Raises `OSError` where it found no room to write."""
    memory = memory_shares(memory_limit(), settings.processes).check
    variables = {"OMP_NUM_THREADS": "1", CHECK_VARIABLE: str(memory)}
    child = await Child.start(settings.check_command, dataset, errors, variables, CHECK_NICE)
    limit_s = min(settings.check_timeout_s, await asyncio.to_thread(_enough_s, dataset))
    try:
        async with asyncio.timeout(limit_s):
            output = b"".join([line async for line in child.lines()])
            status = await child.wait()
    except TimeoutError:
        detail = f"The check took longer than {limit_s:.4g} s."
        error = JobError(code="check_timeout", detail=detail, hint="Send fewer or smaller images.")
        return error, False
    finally:
        child.kill()
        await child.wait()
    if status == EXIT_DISK:
        raise OSError(errno.ENOSPC, "no room for the check of a dataset")
    try:
        answer = json.loads(output)
        if status == 0:
            return CheckReport.model_validate(answer["report"]), False
        if status == EXIT_INPUT_ERROR:
            return JobError(**answer["error"]), False
    except (ValueError, TypeError, KeyError) as error:
        log.error("the check program's answer is unreadable: %s", error)
    detail = f"The check of the files ended unexpectedly (status {status})."
    return JobError(code="check_crashed", detail=detail, log_tail=log_tail(errors)), status < 0
