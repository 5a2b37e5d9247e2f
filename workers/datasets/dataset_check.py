"""Validates datasets in a child process, so that no long-lived process decodes strangers' files."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import logging
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from psycopg.rows import DictRow
from psycopg.types.json import Jsonb

from biresnerf.machine import memory_limit
from biresnerf.wire.datasets import CheckProgress, CheckReport
from biresnerf.wire.problems import JobError
from workers.database.claimed_work import lease_renewed
from workers.database.database import Connection, Database, Statement
from workers.database.losses import LOSSES_MAX, LostTooOften, at_an_end, counted
from workers.process.disk_space import EXIT_DISK
from workers.process.locked_folders import locked_folder, sweep_folders
from workers.process.memory_limits import CHECK_VARIABLE, memory_shares
from workers.process.turns import Turns
from workers.process.waiting import retry_while_unavailable
from workers.records import shown_folder, shown_key
from workers.run.child import Child, log_tail
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import discard, forget

log = logging.getLogger(__name__)

CHECK_NICE = 5  # a user waits for it: more urgent than a job

EXIT_INPUT_ERROR = 2
CHECKS = "checks"
LOOK_S = 0.5  # poll interval while another process runs the check
TELL_S = 1.0  # between two reports of progress, which users watch
# Time limit of a check: per set, plus per file, plus by size.
ANY_S, FILE_S, BYTES_PER_S = 120.0, 10.0, 100e3
FATAL = JobError(
    code="check_crashed",
    detail=f"{LOSSES_MAX} processes were lost while they checked the files.",
    hint="Look for damaged or very large files.",
)


@dataclass
class Take:
    """This process's claim on the check of a dataset, and how many photos, of how many, it has read so far."""

    dataset_id: str
    token: uuid.UUID = field(default_factory=uuid.uuid4)
    photos_read: int = 0
    photos: int | None = None


class Checker:
    """Checks ``finalizing`` datasets, one at a time per process, and each in one process only.

    Tenants take turns: another tenant's many datasets delay a check by one.
    """

    def __init__(self, database: Database, files: FileStore, settings: Settings) -> None:
        self._database, self._files, self._settings = database, files, settings
        self._turns = Turns(1)  # decoding a thousand photos is enough work for one machine

    async def check(self, dataset_id: str) -> None:
        """Returns once the dataset is no longer ``finalizing``, whichever process checked it."""
        take = Take(dataset_id)
        owned = await self._rows("SELECT tenant FROM datasets WHERE id = %s", dataset_id)
        if not owned:
            return
        while True:
            async with self._turns.turn(owned[0]["tenant"]):
                if await retry_while_unavailable(lambda: self._take(take)):
                    await self._check(take)
            rows = await self._rows("SELECT state FROM datasets WHERE id = %s", dataset_id)
            if not rows or rows[0]["state"] != "finalizing":
                return
            await asyncio.sleep(LOOK_S)

    async def _rows(self, statement: Statement, *values: object) -> list[DictRow]:
        """The rows of a statement; waits for a database that is away."""
        return await retry_while_unavailable(lambda: self._database.fetch(statement, *values))

    async def unfinished(self) -> tuple[str, ...]:
        """Ids of ``finalizing`` datasets that no process checks; removes folders of processes that died."""
        await asyncio.to_thread(sweep_folders, self._settings.scratch_dir / CHECKS)
        rows = await self._database.fetch(
            "SELECT id FROM datasets WHERE state = 'finalizing'"
            " AND coalesce(check_until < clock_timestamp(), true) ORDER BY created_at"
        )
        return tuple(row["id"] for row in rows)

    async def _take(self, take: Take) -> bool:
        """Take or renew the lease and record the check's progress; returns whether the dataset is ours.

        A lease, not a lock: a process that is frozen or cut off loses it.
        """
        rows = await self._database.fetch(
            "UPDATE datasets SET check_token = %s, check_until = clock_timestamp() + make_interval(secs => %s),"
            " check_losses = CASE WHEN check_photos < %s THEN 0 ELSE check_losses END,"
            " check_photos = greatest(check_photos, %s), check_of = coalesce(%s, check_of)"
            " WHERE id = %s AND state = 'finalizing'"
            " AND (check_token = %s OR check_until IS NULL OR check_until < clock_timestamp()) RETURNING id",
            *(take.token, 2 * self._settings.beat_s, take.photos_read, take.photos_read, take.photos),
            *(take.dataset_id, take.token),
        )
        return bool(rows)

    async def _check(self, take: Take) -> None:
        dataset_id = take.dataset_id
        rows = await self._rows("SELECT key, path FROM dataset_files WHERE dataset_id = %s", dataset_id)
        shown = shown_key(dataset_id)
        try:
            async with lease_renewed(partial(self._take, take), 2 * self._settings.beat_s, TELL_S):
                # Until the outcome is recorded: this process may be killed, or the dataset deleted, before that.
                await retry_while_unavailable(
                    lambda: self._database.run(discard, shown, after_s=self._settings.upload_expiry_s)
                )
                files = [(row["key"], row["path"]) for row in rows]
                outcome = await self._outcome(files, shown, take)
        except BaseException:  # a full disk or a shutdown, not the files' fault
            await at_an_end(
                self._database,
                "UPDATE datasets SET check_token = NULL, check_until = NULL"
                " WHERE id = %s AND check_token = %s",
                *(dataset_id, take.token),
            )
            raise
        await retry_while_unavailable(lambda: self._database.run(_record, take, outcome))

    async def _outcome(
        self, members: Sequence[tuple[str, str]], shown: str, take: Take
    ) -> CheckReport | JobError:
        """Run the check program on the files, given as (key, path). A crash or timeout rejects them, too.

        Stores what pages show of a good set below the key ``shown``.

        If the program is killed (possibly by the kernel, for another process's memory use), it is run once more.

        Raises:
            OSError: the disk is full, which says nothing about the files.
            Unavailable: the store is away.
        """
        async with locked_folder(self._settings.scratch_dir / CHECKS) as folder:
            dataset, errors = folder / "input", folder / "log.txt"
            await self._files.stage(members, dataset, to_read_only=True)
            try:
                async with counted(self._database, "datasets.check_losses", take.dataset_id):
                    outcome, killed = await _run(dataset, errors, self._settings, take)
                    if killed:
                        log.warning("the check of %d files was killed; trying once more", len(members))
                        outcome, _ = await _run(dataset, errors, self._settings, take)
            except LostTooOften:
                return FATAL
            if isinstance(outcome, CheckReport):
                made = shown_folder(dataset)
                for path in sorted(path for path in made.rglob("*") if path.is_file()):
                    await self._files.put_path(f"{shown}/{path.relative_to(made).as_posix()}", path)
            return outcome


async def _record(connection: Connection, take: Take, outcome: CheckReport | JobError) -> None:
    """Record the outcome, unless another process has the lease by now."""
    found = Jsonb(outcome.model_dump(mode="json"))
    ours = await connection.row(
        "UPDATE datasets SET state = %s, report = %s, error = %s, revision = revision + 1,"
        " check_token = NULL, check_until = NULL"
        " WHERE id = %s AND state = 'finalizing' AND check_token = %s RETURNING id",
        *(("rejected", None, found) if isinstance(outcome, JobError) else ("ready", found, None)),
        *(take.dataset_id, take.token),
    )
    if ours and isinstance(outcome, CheckReport):
        await forget(connection, shown_key(take.dataset_id))


def _enough_s(dataset: Path) -> float:
    """Most seconds that honest files take, even on a busy machine, so that small sets get a short limit."""
    sizes = [path.stat().st_size for path in dataset.rglob("*") if path.is_file()]
    return ANY_S + FILE_S * len(sizes) + sum(sizes) / BYTES_PER_S


def _note_progress(take: Take, said: bytes) -> None:
    """Note the progress that a line of the program reports; nothing if the line is about something else."""
    with contextlib.suppress(ValueError, TypeError, KeyError):
        progress = CheckProgress.model_validate_json(said)
        take.photos_read, take.photos = max(take.photos_read, progress.photos_read), progress.photos


async def _run(
    dataset: Path, errors: Path, settings: Settings, take: Take
) -> tuple[CheckReport | JobError, bool]:
    """The outcome, and whether a signal ended the program. Raises `OSError` if the disk was full."""
    memory = memory_shares(memory_limit(), settings.processes).check
    variables = {"OMP_NUM_THREADS": "1", CHECK_VARIABLE: str(memory)}
    child = await Child.start(settings.check_command, dataset, errors, variables, CHECK_NICE)
    output = b""
    limit_s = min(settings.check_timeout_s, await asyncio.to_thread(_enough_s, dataset))
    try:
        async with asyncio.timeout(limit_s):
            async for output in child.lines():  # the last line is the answer
                _note_progress(take, output)
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
