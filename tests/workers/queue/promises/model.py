"""What each operation is allowed to do to a job: pure functions from the world before to the world after.

Written from the promises in docs/reliability.md, not from the code that it is compared with.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

Place = Literal["todo", "later", "doing", "over"]
FENCED = "fenced"
COUNTED = {"killed", "error"}
MAX_CRASHES, MAX_LOSSES, MAX_ATTEMPTS = 3, 9, 30
ENDS = {"succeeded", "failed", "cancelled", "expired"}


@dataclass(frozen=True)
class Job:
    """All of a job that somebody can tell. ``place`` is its entry's in the queue, ``worker`` has the entry."""

    state: str = "queued"
    attempt: int = 0
    crashes: int = 0
    losses: int = 0
    setback: str | None = None
    token: uuid.UUID | None = None
    cancel_requested: bool = False
    late: bool = False
    stage: str | None = None
    checkpoint: str | None = None
    stage_work: str | None = None
    result: tuple[str, ...] = ()
    held: bool = False
    place: Place = "todo"
    worker: int | None = None
    abort: bool = False
    events: tuple[str, ...] = ("queued",)
    trash: frozenset[str] = frozenset()

    @property
    def final(self) -> bool:
        return self.state in ENDS

    def with_event(self, event: str, **changes: object) -> Job:
        return replace(self, events=(*self.events, event), **changes)  # type: ignore[arg-type]

    def ended(self, state: str, result: tuple[str, ...] = ()) -> Job:
        swept = self.trash | {"checkpoints", "previews", "results", "stages/seeding", "stages/coarse"}
        return self.with_event(state, state=state, result=result, checkpoint=None, trash=swept)


@dataclass(frozen=True)
class World:
    """Jobs by name, in the order of their submission; workers that were silent for too long; the tenant's limit."""

    jobs: Mapping[str, Job] = field(default_factory=dict)
    silent: frozenset[int] = frozenset()
    limit: int = 0

    def with_job(self, name: str, job: Job) -> World:
        return replace(self, jobs={**self.jobs, name: job})._offered()

    def _offered(self) -> World:
        """As many jobs are offered or running as the limit allows, the oldest first."""
        jobs = dict(self.jobs)
        room = self.limit - sum(not job.held and not job.final for job in jobs.values())
        for name, job in jobs.items():
            if job.held and not job.final and room > 0:
                jobs[name], room = replace(job, held=False, place="todo"), room - 1
        return replace(self, jobs=jobs)


Outcome = tuple[object, World]
Change = Callable[[World], Outcome]


def submitted(name: str) -> Change:
    """Once, however often it is asked for; and held where the tenant has as many as it may."""

    def change(world: World) -> Outcome:
        if name in world.jobs:
            return name, world
        unfinished = sum(not job.held and not job.final for job in world.jobs.values())
        held = 0 < world.limit <= unfinished
        return name, world.with_job(name, Job(held=held, place="later" if held else "todo"))

    return change


def cancelled_by_client(name: str) -> Change:
    """A waiting job ends at once; a running one is asked to."""

    def change(world: World) -> Outcome:
        job = world.jobs[name]
        if not job.final and not job.cancel_requested:
            place = "doing" if job.place == "doing" else "over"
            asked = replace(job, cancel_requested=True, place=place, abort=job.abort or place == "doing")
            if job.state == "queued":
                job = asked.ended("cancelled")
            else:
                job = asked.with_event("cancel_requested")
            world = world.with_job(name, job)
        return job.state, world

    return change


def _beyond_its_time(job: Job) -> Job:
    """What never started expires. What has ends at once where it waits, or else is asked to."""
    place = "doing" if job.place == "doing" else "over"
    job = replace(job, place=place, abort=job.abort or place == "doing")
    if "started" not in job.events:
        return job.with_event("expired", state="expired")
    job = replace(job, cancel_requested=True)
    return job.ended("cancelled") if job.state == "queued" else job.with_event("cancel_requested")


def late_ones_ended(names: frozenset[str] | None) -> Change:
    """A janitor ends what is beyond its time, but for what others have locked: ``names``, or all."""

    def change(world: World) -> Outcome:
        jobs = dict(world.jobs)
        for name, job in jobs.items():
            due = job.late and not job.final and not job.cancel_requested
            if due and (names is None or name in names):
                jobs[name] = _beyond_its_time(job)
        return names, replace(world, jobs=jobs)._offered()

    return change


def taken(worker: int) -> Change:
    """What the worker has already, or else the next that is due."""

    def change(world: World) -> Outcome:
        world = replace(world, silent=world.silent - {worker})
        for name, job in world.jobs.items():
            if job.place == "doing" and job.worker == worker:
                return name, world
        for name, job in world.jobs.items():
            if job.place == "todo":
                return name, world.with_job(name, replace(job, place="doing", worker=worker))
        return None, world

    return change


def claimed(name: str, worker: int, token: uuid.UUID | None) -> Change:
    """A new attempt, unless the worker has lost the entry, or the job is over, should be cancelled, is late, or crashed
    too often. ``token``: its own.
    """

    def change(world: World) -> Outcome:
        job = world.jobs[name]
        if job.final or job.place != "doing" or job.worker != worker:
            return False, world
        if job.state == "running":  # its last attempt is fenced, which never said how it ended
            job = replace(job, token=None)
        if job.late and not job.cancel_requested:
            job = _beyond_its_time(job)
        if job.cancel_requested or job.late:
            return False, world.with_job(name, job if job.final else job.ended("cancelled"))
        if job.crashes >= MAX_CRASHES or job.losses >= MAX_LOSSES or job.attempt >= MAX_ATTEMPTS:
            return False, world.with_job(name, job.ended("failed"))
        running = replace(job, state="running", attempt=job.attempt + 1, token=token, stage=None)
        return True, world.with_job(name, running.with_event("started"))

    return change


def _owned(
    name: str, token: uuid.UUID, effect: Callable[[Job], tuple[object, Job]], *, ends: bool = False
) -> Change:
    """A write of an attempt: only who claimed last can write, and only until the job is no longer running.

    ``ends``: it is one that would end the attempt, and its answer is false where a cancellation came first.
    """

    def change(world: World) -> Outcome:
        job = world.jobs[name]
        if job.token != token:
            return FENCED, world
        if job.state != "running":
            return job.state != "cancelled" if ends else None, world
        answer, job = effect(job)
        return answer, world.with_job(name, job)

    return change


def progressed(name: str, token: uuid.UUID, stage: str) -> Change:
    return _owned(
        name,
        token,
        lambda job: (None, job if job.stage == stage else job.with_event("stage", stage=stage)),
    )


def checkpointed(name: str, token: uuid.UUID, prefix: str) -> Change:
    def effect(job: Job) -> tuple[object, Job]:
        replaced = job.trash | ({job.checkpoint} if job.checkpoint not in (None, prefix) else set())
        return None, job.with_event("checkpoint", checkpoint=prefix, crashes=0, losses=0, trash=replaced)

    return _owned(name, token, effect)


def stage_kept(name: str, token: uuid.UUID, prefix: str) -> Change:
    """The work of a stage is there for other jobs, also after the end; of the one before nothing is left."""

    def effect(job: Job) -> tuple[object, Job]:
        replaced = job.trash | ({job.stage_work} if job.stage_work not in (None, prefix) else set())
        return None, replace(job, stage_work=prefix, trash=replaced)

    return _owned(name, token, effect)


def published(name: str, token: uuid.UUID, result: tuple[str, ...]) -> Change:
    return _owned(
        name,
        token,
        lambda job: (False, job) if job.cancel_requested else (True, job.ended("succeeded", result)),
        ends=True,
    )


def failed(name: str, token: uuid.UUID) -> Change:
    return _owned(
        name,
        token,
        lambda job: (False, job) if job.cancel_requested else (True, job.ended("failed")),
        ends=True,
    )


def ended_cancelled(name: str, token: uuid.UUID) -> Change:
    return _owned(name, token, lambda job: (None, job.ended("cancelled")))


def given_back(name: str, token: uuid.UUID, event: str, setback: str | None) -> Change:
    def effect(job: Job) -> tuple[object, Job]:
        if job.cancel_requested:
            return False, job.ended("cancelled")
        attempt = job.attempt - (setback is None)
        crashes = job.crashes + (setback in COUNTED)
        return True, job.with_event(event, state="queued", attempt=attempt, crashes=crashes, setback=setback)

    return _owned(name, token, effect, ends=True)


def acknowledged(name: str, worker: int, again: Literal["over", "now", "later"]) -> Change:
    """The entry is put back or over, if it is still the worker's: nobody acts on the answer."""

    def change(world: World) -> Outcome:
        job = world.jobs[name]
        if job.place != "doing" or job.worker != worker:
            return None, world
        # Cancelled between the two: there is nothing to offer again.
        place: Place = "over" if again == "over" or job.abort else "todo" if again == "now" else "later"
        return None, world.with_job(name, replace(job, place=place, worker=None, abort=False))

    return change


def released(world: World) -> Outcome:
    """A janitor takes back all that silent workers have. A crash is counted where an attempt was running."""
    for name, job in world.jobs.items():
        if job.place != "doing" or job.worker not in world.silent:
            continue
        if job.final:
            job = replace(job, place="over", worker=None, abort=False)
        elif job.cancel_requested:
            job = replace(job, place="over", worker=None, abort=False, token=None).ended("cancelled")
        else:
            if job.state == "running":
                job = replace(job, state="queued", setback="worker_lost", losses=job.losses + 1)
            job = job.with_event("requeued", place="todo", worker=None, token=None)
        world = world.with_job(name, job)
    return None, replace(world, silent=frozenset())


def unchanged(world: World) -> Outcome:
    """Upkeep, of which no job shows anything."""
    return None, world
