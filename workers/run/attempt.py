"""One attempt at one job: stage the files, run the process, deliver its reports, record the end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import shutil
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from biresnerf.errors import Fault
from biresnerf.machine import GROUPS, PROC, group_files
from biresnerf.options.refine_options import OPTIONS, RefineOptions, ResolvedOptions, parse_options
from biresnerf.progress import Progress
from biresnerf.report import Verdict, VerdictName
from biresnerf.wire.problems import JobError
from workers.database.database import Database
from workers.jobs.claim import Claim, Fenced
from workers.jobs.job_states import Requeue, is_whole
from workers.jobs.ledger import Ledger
from workers.jobs.setbacks import Cause, crashed_too_often, used_up
from workers.process.disk_space import EXIT_DISK, refused_to_write
from workers.process.waiting import first_done, retry_while_unavailable
from workers.records import CRASH_NAME, EXIT_SPLIT, LOG_NAME, SPLIT_NAME, Artifact
from workers.run.child import Child, log_tail
from workers.run.courier import Courier
from workers.run.results import store_result
from workers.run.staging import stage_job
from workers.settings.errors import LimitReached, Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore

log = logging.getLogger(__name__)

StopReason = Literal["cancel", "shutdown"]
EXIT_ERRORS = {2: "InputError", 3: "RefinementError"}  # deterministic: another attempt would end the same
EXIT_MEMORY = 4
# Ends of a process that the kernel may have killed for lack of memory: its own, and the error of a killed child.
KILLED, CHILD_KILLED = -signal.SIGKILL, "seeding_crashed"
# Ours to fix, not the user's: a checkpoint of an older version, for example. The job starts over.
STALE_CHECKPOINT = {"output_not_resumable", "checkpoint_invalid"}
PARTS = TypeAdapter(tuple[RefineOptions, ...])
LOG_ALONE = "-log"  # ends the name of the folder of a cancelled attempt of which only the log is kept
DISCARDED_GRACE_S = 2.0  # for a cancelled job of which no partial result is wanted


@dataclass(frozen=True)
class Ending:
    """How an attempt ended: with its job, stopped from outside, or too early.

    ``again_in_s``: seconds until the queue offers the job again; None if it has ended.
    """

    how: Literal["succeeded", "failed", "cancelled", "stopped", "setback", "split"]
    again_in_s: float | None = None


class Attempt:
    """Runs a claimed job in ``folder`` (fresh, local, ours). `ask_stop` may be called at any time."""

    def __init__(
        self,
        database: Database,
        files: FileStore,
        settings: Settings,
        claim: Claim,
        folder: Path,
        variables: Mapping[str, str],
    ) -> None:
        self._claim, self._settings, self._files = claim, settings, files
        self._database, self._variables = database, variables
        self._ledger = Ledger(database, claim, settings.stall_s)
        self._folder, self._output, self._log = folder, folder / "output", folder / LOG_NAME
        self._stop_reason: StopReason | None = None
        self._stop = asyncio.Event()
        self._child: Child | None = None
        self._timed_out = False
        self._resolved: ResolvedOptions | None = None
        self._oom_kills = OomKills()
        self._oom_kills_before: int | None = None

    def ask_stop(self, reason: StopReason) -> None:
        """End soon: the process writes a checkpoint and exits. A cancellation outweighs a shutdown."""
        if self._stop_reason != "cancel":
            self._stop_reason = reason
        self._stop.set()

    async def run(self) -> Ending:
        """Run to the end. Raises `Fenced`.

        Our own failures count as a crash of the attempt, unless disk or store are to blame.
        """
        noting = asyncio.create_task(self._note_use_again())
        try:
            return await self._run()
        except Fenced:
            # Nothing refers to what was stored meanwhile, and the trash of this job may have been emptied already.
            for prefix in (self._result_prefix, f"{self._result_prefix}{LOG_ALONE}"):
                await self._files.delete_prefix(prefix)
            raise
        finally:
            noting.cancel()
            shutil.rmtree(self._folder, ignore_errors=True)

    async def _note_use_again(self) -> None:
        with contextlib.suppress(Fenced):  # the attempt's next write ends it
            while True:
                await asyncio.sleep(self._settings.beat_s)
                await self._note_use()

    async def _note_use(self) -> None:
        used_s = await asyncio.to_thread(self._child.processor_s) if self._child else 0.0
        await self._ledger.note_use(used_s)

    async def _run(self) -> Ending:
        try:
            status = await self._run_process()
            await self._note_use()
            return await self._conclude(status)
        except Unavailable:
            return await self._wait("store_away")
        except Exception as error:
            full = isinstance(error, LimitReached) and error.code == "storage_full"
            if full or refused_to_write(error):
                return await self._wait("disk_full")
            log.exception("attempt %s of %s failed on our side", self._claim.name, self._claim.job_id)
            return await self._crashed("error", "an error on the worker's side")

    async def _give_back(self, how: Requeue, again_in_s: float = 0.0) -> Ending:
        if not await self._ledger.give_back(how):
            return Ending("cancelled")
        return Ending("stopped" if how.setback is None else "setback", again_in_s)

    async def _fail(self, error: JobError, artifacts: list[Artifact]) -> Ending:
        if await self._ledger.fail(error, artifacts):
            return Ending("failed")
        return await self._end_cancelled()

    async def _end_cancelled(self) -> Ending:
        """End as cancelled, with the partial result if one is wanted and there, else with the log."""
        keep = self._claim.name
        artifacts = await self._store() if await self._ledger.wants_partial() else []
        if not is_whole(artifacts):
            # In a folder of its own: what is in the other goes, whatever came there before the cancellation.
            keep += LOG_ALONE
            prefix = f"{self._result_prefix}{LOG_ALONE}"
            artifacts = await store_result(self._files, prefix, self._output, self._log, log_only=True)
        await self._ledger.cancelled(artifacts, keep)
        return Ending("cancelled")

    async def _wait(self, cause: Cause) -> Ending:
        """Give the job back until there is room, or the store answers."""
        log.warning("job %s goes back to the queue: %s", self._claim.job_id, cause)
        return await self._give_back(Requeue("requeued", {"why": cause}, cause), self._settings.stall_s / 4)

    @property
    def _result_prefix(self) -> str:
        return f"jobs/{self._claim.job_id}/results/{self._claim.name}"

    async def _run_process(self) -> int | None:
        """The exit status of the process; None if a stop came before its start."""
        # Restarted if database or store go away, which is no fault of the job.
        staging = asyncio.create_task(
            retry_while_unavailable(
                lambda: stage_job(self._database, self._files, self._settings, self._claim, self._folder)
            )
        )
        await first_done(staging, self._stop.wait())
        if not staging.done():
            staging.cancel()
            return None
        await staging
        self._oom_kills_before = self._oom_kills.count()
        # Temporary files of a killed job are deleted with its folder.
        variables = {**self._variables, "TMPDIR": str(self._folder / "tmp")}
        child = self._child = await Child.start(
            self._settings.job_command, self._folder, self._log, variables, nice=self._settings.job_nice
        )
        courier = Courier(self._ledger, self._files, self._output, self._log)
        carrying = asyncio.create_task(courier.run())
        pumping = asyncio.create_task(self._pump(child, courier))
        ended = asyncio.create_task(child.wait())
        try:
            async with asyncio.timeout(self._settings.job_timeout_s):
                await first_done(ended, carrying, self._stop.wait())
        except TimeoutError:
            self._timed_out = True
        try:
            if carrying.done():
                await carrying  # Fenced
            if not ended.done():
                await child.stop(await self._grace_s())
            status = await ended
            await pumping
            courier.close(last_checkpoint=self._stop_reason != "cancel")
            await carrying
            return status
        finally:
            child.kill()
            for task in (carrying, pumping, ended):
                task.cancel()

    async def _grace_s(self) -> float:
        """How long the process may take to end."""
        grace_s = self._settings.stop_grace_s
        if self._stop_reason != "cancel":
            return grace_s
        wanted = await self._ledger.wants_partial()
        return min(grace_s, self._settings.cancel_grace_s if wanted else DISCARDED_GRACE_S)

    async def _pump(self, child: Child, courier: Courier) -> None:
        async for line in child.lines():
            try:
                progress = Progress.model_validate_json(line)
                self._resolved = progress.options or self._resolved
                courier.offer(progress)
            except ValidationError:
                with self._log.open("ab") as file:  # a library printed something
                    file.write(line)

    async def _conclude(self, status: int | None) -> Ending:
        if status == 0:
            artifacts = await self._store(enough=lambda: self._stop_reason == "cancel")
            if await self._ledger.publish(artifacts, *self._reported_result()):
                return Ending("succeeded")
            return await self._end_cancelled()
        if status == EXIT_SPLIT:
            parts = PARTS.validate_json((self._folder / SPLIT_NAME).read_bytes())
            asked = [options.model_dump(mode="json", exclude_unset=True) for options in parts]
            return Ending("split" if await self._ledger.split(asked) else "cancelled")
        self._log_crash()
        if status == EXIT_MEMORY or (status in (KILLED, *EXIT_ERRORS) and self._killed_for_memory(status)):
            return await self._ran_out_of_memory()
        if status in EXIT_ERRORS:
            error = self._reported_error()
            if error.code in STALE_CHECKPOINT and self._claim.checkpoint is not None:
                return await self._crashed("error", error.detail, forget_checkpoint=True)
            return await self._fail(error, await self._store(log_only=True))
        if self._stop_reason == "cancel":
            return await self._end_cancelled()
        if self._stop_reason == "shutdown":
            return await self._give_back(Requeue("requeued", {"why": "shutdown"}))
        if status == EXIT_DISK:
            return await self._wait("disk_full")
        if self._timed_out:
            error = JobError(
                code="timeout",
                detail=f"The job took longer than {self._settings.job_timeout_s:g} s.",
                hint="Ask for fewer steps or smaller images, or raise BIRESNERF_JOB_TIMEOUT_S.",
                log_tail=log_tail(self._log),
            )
            return await self._fail(error, await self._store())
        return await self._crashed("killed" if status == KILLED else "error", f"exit status {status}")

    async def _crashed(self, cause: Cause, how: str, *, forget_checkpoint: bool = False) -> Ending:
        tail = log_tail(self._log)
        if await self._may_try_again():
            data = {"how": how, "log_tail": tail}
            return await self._give_back(
                Requeue("attempt_crashed", data, cause, forget_checkpoint=forget_checkpoint)
            )
        error = crashed_too_often(self._claim.attempt, cause, tail)
        return await self._fail(error, await self._store(log_only=True))

    async def _may_try_again(self) -> bool:
        crashes = await self._ledger.crashes() + 1
        return not used_up(self._claim.attempt, crashes, 0, self._settings.max_attempts)

    def _log_crash(self) -> None:
        """Log the process's report of a crash, for the operator alone."""
        with contextlib.suppress(OSError):
            text = (self._folder / CRASH_NAME).read_text(errors="replace")
            log.error("the process of job %s failed:\n%s", self._claim.job_id, text)

    def _killed_for_memory(self, status: int) -> bool:
        """Whether this process ended like a killed one and the kernel has killed one meanwhile."""
        if self._stop_reason is not None or self._timed_out:
            return False
        if status != KILLED and self._reported_error().code != CHILD_KILLED:
            return False
        now = self._oom_kills.count()
        return now is not None and now > (self._oom_kills_before or 0)

    async def _ran_out_of_memory(self) -> Ending:
        """Retry with smaller options, from the start: checkpoints have the sizes that were too large."""
        tail = log_tail(self._log)
        smaller: dict[str, Any] = {}
        if self._claim.kind == "refine":
            # Until the process reports its options, assume a CPU, whose defaults are smaller than a GPU's.
            smaller = smaller_options(self._resolved or parse_options(self._claim.options).resolved("cpu"))
        if smaller and not self._claim.smaller and await self._may_try_again():
            data = {"why": "out_of_memory", "options": smaller, "log_tail": tail}
            return await self._give_back(
                Requeue("retried_smaller", data, "killed", forget_checkpoint=True, smaller=smaller)
            )
        error = out_of_memory(self._claim.smaller, tail)
        return await self._fail(error, await self._store(log_only=True))

    def _reported_result(self) -> tuple[VerdictName | None, tuple[str, ...]]:
        """The report's verdict, if any, and the codes of its faults."""
        if self._claim.kind != "refine":
            return None, ()
        try:
            report = json.loads((self._output / "report.json").read_bytes())
            passed = report.get("verdict")
            verdict = None if passed is None else Verdict.model_validate(passed).verdict
            return verdict, tuple(Fault.model_validate(fault).code for fault in report.get("faults", ()))
        except (OSError, ValueError) as error:
            log.error("no verdict of %s: %s", self._claim.job_id, error)
            return None, ()

    def _reported_error(self) -> JobError:
        """What the process wrote to ``error.json`` before it exited with 2 or 3."""
        tail = log_tail(self._log)
        try:
            reported = json.loads((self._folder / "error.json").read_text())
            return JobError(**reported, log_tail=tail)
        except (OSError, ValueError, TypeError) as error:
            detail = f"The job failed and its error report could not be read ({error})."
            return JobError(code="engine_error", detail=detail, log_tail=tail)

    async def _store(
        self, *, log_only: bool = False, enough: Callable[[], bool] = lambda: False
    ) -> list[Artifact]:
        """Store the output and the log under this attempt's prefix."""
        return await store_result(
            self._files, self._result_prefix, self._output, self._log, log_only=log_only, enough=enough
        )


def smaller_options(options: ResolvedOptions) -> dict[str, Any]:
    """The options to change so that a second try needs less memory; empty if there are none."""
    now = options.model_dump()
    less = {name: o.smaller(now[name]) for name, o in OPTIONS.items() if o.smaller is not None}
    return {name: value for name, value in less.items() if value != now[name]}


def out_of_memory(smaller: Mapping[str, Any], log_tail: str) -> JobError:
    """The error of a job that ran out of memory and is not tried again."""
    tried = ", ".join(f"{name}={value}" for name, value in smaller.items())
    return JobError(
        code="out_of_memory",
        detail="The job needs more memory than the machine has"
        + (f", also in a second try with {tried}." if tried else "."),
        hint="Ask for smaller images (max_image_size), fewer samples_per_step, a smaller table_size_log2 or "
        "fewer images, or use a machine (or GPU) with more memory.",
        log_tail=log_tail,
    )


class OomKills:
    """Counts the processes that the kernel has killed for lack of memory.

    In this container if that is counted (control groups of version 2 or 1), else on this machine.
    """

    def __init__(self, proc: Path = PROC, groups: Path = GROUPS) -> None:
        counts = group_files("memory.events", "memory.oom_control", proc, groups)
        self._files = [*counts, proc / "vmstat"]

    def count(self) -> int | None:
        """The count so far; None if the kernel does not tell."""
        for path in self._files:
            try:
                found = re.search(r"^oom_kill (\d+)$", path.read_text(), re.MULTILINE)
            except OSError:
                continue
            if found is not None:
                return int(found[1])
        return None
