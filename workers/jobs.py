"""The job record: submit, look, cancel, delete, follow. Used by the service; never loads torch."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping

from biresnerf.config import RefineOptions
from workers.records import Artifact, Job, JobEvent, JobState, JobUpdate, Page


class JobStore:
    """Jobs in the database. Get one from `workers.stores.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) where the database does not answer.
    """

    async def submit(
        self,
        dataset_id: str,
        options: RefineOptions,
        *,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
    ) -> tuple[Job, bool]:
        """Queue a job; the job and its queue entry are written in one transaction.

        Returns the job and whether it is new (False: the same key with the same request came before).
        Raises `NotFound` (dataset), `Conflict` (``dataset_not_ready``, ``idempotency_key_reused``),
        `LimitReached` (``queue_full``).
        """
        raise NotImplementedError

    async def get(self, job_id: str) -> Job:
        """The job now; raises `NotFound`."""
        raise NotImplementedError

    async def list(
        self,
        *,
        state: JobState | None = None,
        label: tuple[str, str] | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[Job]:
        """Jobs, newest first; raises `InputError` (``bad_cursor``)."""
        raise NotImplementedError

    async def cancel(self, job_id: str) -> Job:
        """Ask for the end of a job: a queued one is cancelled at once, a running one within seconds.

        A job already final is returned as it is. Raises `NotFound`.
        """
        raise NotImplementedError

    async def delete(self, job_id: str) -> None:
        """Delete a final job with its files; raises `NotFound`, `Conflict` (``state_conflict``)."""
        raise NotImplementedError

    async def events(self, job_id: str, *, after: int = 0, limit: int = 1000) -> list[JobEvent]:
        """The history after ``seq == after``, gapless and in order; raises `NotFound`."""
        raise NotImplementedError

    async def artifacts(self, job_id: str) -> tuple[Artifact, ...]:
        """The published files, by name; empty while there is no result. Raises `NotFound`."""
        raise NotImplementedError

    def subscribe(
        self, job_id: str, *, after: int = 0, heartbeat_s: float = 15.0
    ) -> AsyncIterator[JobUpdate | None]:
        """Follow a job: first its state and the events after ``after``, then every change.

        Yields none when nothing changed for ``heartbeat_s`` (time for a keep-alive). Ends after the update
        that carries a final state. Progress is in ``update.job``, at most once a second. Survives a restart
        of the database. Raises `NotFound`, also when the job is deleted meanwhile.
        """
        raise NotImplementedError

    async def wait(self, job_id: str, *, timeout_s: float) -> Job:
        """The job as soon as it is final, or as it is after ``timeout_s`` (for long polls)."""
        raise NotImplementedError

    async def counts(self) -> dict[JobState, int]:
        """How many jobs are in each state."""
        raise NotImplementedError

    async def healthy(self) -> bool:
        """Whether the database answers within two seconds."""
        raise NotImplementedError
