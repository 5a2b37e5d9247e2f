"""Clients, workers and a janitor: what each may do next, with the product's own functions on a real database."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress
from biresnerf.wire.problems import JobError
from tests.workers.queue.promises import model
from tests.workers.queue.promises.model import FENCED, Change, World
from workers.database import job_queue
from workers.database.database import Connection, Database
from workers.database.job_queue import Entry
from workers.database.statistics import fold_tallies
from workers.jobs.claim import Claim, Fenced, claim_job
from workers.jobs.deadlines import end_overdue_jobs
from workers.jobs.job_states import Requeue, offer_held_jobs, requeue_lost
from workers.jobs.jobs import JobStore
from workers.jobs.ledger import Ledger
from workers.process.waiting import retry_while_unavailable
from workers.queue.janitor import Janitor
from workers.records import Artifact
from workers.settings.settings import Settings

Again = Literal["over", "now", "later"]
AGAIN_S = {"over": None, "now": 0.0, "later": 3600.0}
OPTIONS = RefineOptions(preset="fast")


@dataclass
class Worker:
    """A slot between its steps: it has taken an entry, claimed its job, and ended the attempt, in this order."""

    id: int
    entry: Entry | None = None
    name: str = ""
    claim: Claim | None = None
    again: Again | None = None
    stored: int = 0


@dataclass
class Act:
    """One call of one process: what it does, what that may change, and what its process knows after the answer."""

    name: str
    run: Callable[[], Awaitable[Any]]
    change: Callable[[Any], Change]
    worker: Worker | None = None
    learn: Callable[[Any], None] = lambda _: None
    answer_of: Callable[[Any], object] = lambda answer: answer

    def __repr__(self) -> str:
        return self.name

    def _repr_pretty_(self, printer: Any, _: bool) -> None:
        """As Hypothesis shows it."""
        printer.text(self.name)


class Actors:
    """Everybody who works on the queue at the same time."""

    def __init__(self, database: Database, settings: Settings, dataset_id: str) -> None:
        self._database, self._dataset_id = database, dataset_id
        self._settings = settings
        self._jobs = JobStore(database, None, settings)  # type: ignore[arg-type]  # nobody follows
        self._janitor = Janitor(database, None, settings)  # type: ignore[arg-type]  # empties no trash
        self.ids: dict[str, str] = {}
        self.workers: list[Worker] = []
        self.dead: list[int] = []

    def possible(self, world: World) -> Iterator[Act]:
        """What may happen next; what seldom has its moment comes several times, so that it is chosen more often."""
        if len(world.jobs) < 4:
            yield self._submit(f"job{len(world.jobs)}")
        for name, job in world.jobs.items():
            if not job.final:
                yield self._submit(name)
                yield self._cancel(name)
        for worker in self.workers:
            fenced = worker.claim is not None and world.jobs[worker.name].token != worker.claim.token
            for _ in range(8 if fenced else 2):
                yield from self.next_of(worker, world)
        for _ in range(12 if world.silent else 0):
            yield Act("janitor: release silent workers", self._release, lambda _: model.released)
        late = any(job.late and not job.final for job in world.jobs.values())
        for _ in range(6 if late else 1):
            yield Act("janitor: end what is late", self._end_late, model.late_ones_ended)
        yield Act("janitor: offer and fold", self._upkeep, lambda _: model.unchanged)

    def next_of(self, worker: Worker, world: World) -> Iterator[Act]:
        """The steps that a worker's program may do next."""
        if worker.entry is None:
            yield self._take(worker)
        elif worker.again is not None:
            yield self._acknowledge(worker)
        elif worker.claim is None:
            yield self._claim(worker)
        else:
            yield from self._writes(worker, world)

    def _submit(self, name: str) -> Act:
        async def run() -> str:
            async def once() -> tuple[Any, bool]:
                return await self._jobs.submit(self._dataset_id, OPTIONS, idempotency_key=name)

            job, _ = await retry_while_unavailable(once)  # as the client does
            self.ids[name] = job.id
            return name

        return Act(f"client: submit {name}", run, lambda _: model.submitted(name))

    def _cancel(self, name: str) -> Act:
        async def run() -> str:
            job = await retry_while_unavailable(lambda: self._jobs.cancel(self.ids[name]))
            return str(job.state)

        return Act(f"client: cancel {name}", run, lambda _: model.cancelled_by_client(name))

    def _take(self, worker: Worker) -> Act:
        def learn(entry: Entry | None) -> None:
            worker.entry, worker.name = entry, self._name_of(entry)

        return Act(
            f"worker {worker.id}: take",
            lambda: retry_while_unavailable(lambda: self._database.run(job_queue.take, worker.id)),
            lambda _: model.taken(worker.id),
            worker,
            learn,
            lambda entry: self._name_of(entry) or None,
        )

    def _name_of(self, entry: Entry | None) -> str:
        return "" if entry is None else next(name for name, id in self.ids.items() if id == entry.job_id)

    def _claim(self, worker: Worker) -> Act:
        assert worker.entry is not None
        job_id = worker.entry.job_id

        def learn(claim: Claim | None) -> None:
            worker.claim = claim
            worker.again = "over" if claim is None else None

        return Act(
            f"worker {worker.id}: claim {worker.name}",
            lambda: claim_job(self._database, job_id, worker.id, model.MAX_CRASHES, self._settings.stall_s),
            lambda claim: model.claimed(worker.name, worker.id, None if claim is None else claim.token),
            worker,
            learn,
            lambda claim: claim is not None,
        )

    def _writes(self, worker: Worker, world: World) -> Iterator[Act]:
        claim, name = worker.claim, worker.name
        assert claim is not None
        ledger = Ledger(self._database, claim, self._settings.stall_s)
        root = f"jobs/{claim.job_id}"
        stage = "coarse" if world.jobs[name].stage != "coarse" else "fine"
        now = Progress(stage=stage, step=1, steps_total=9, fraction=0.1)
        yield self._write(
            worker, "progress", lambda: ledger.progress(now), model.progressed(name, claim.token, stage)
        )
        worker.stored += 1
        stored = f"{claim.name}-{worker.stored}"
        prefix, work = f"checkpoints/{stored}", f"stages/coarse/{stored}"
        yield self._write(
            worker,
            "checkpoint",
            lambda: ledger.checkpoint(f"{root}/{prefix}", ["latest"], 1),
            model.checkpointed(name, claim.token, prefix),
        )
        yield self._write(
            worker,
            "stage",
            lambda: ledger.reusable("coarse", f"{root}/{work}", ["poses"]),
            model.stage_kept(name, claim.token, work),
        )
        yield from self._ends(worker, world, claim, ledger)

    def _ends(self, worker: Worker, world: World, claim: Claim, ledger: Ledger) -> Iterator[Act]:
        name, root = worker.name, f"jobs/{claim.job_id}"
        result = tuple(f"results/{claim.name}/{file}" for file in ("poses.json", "report.json"))
        files = [
            Artifact(name=key.rpartition("/")[2], key=f"{root}/{key}", size=1, sha256="", media_type="")
            for key in result
        ]
        yield self._write(
            worker,
            "publish",
            lambda: ledger.publish(files, None),
            model.published(name, claim.token, result),
            lambda done: "over" if done else None,
        )
        error = JobError(code="engine_error", detail="It failed.")
        yield self._write(
            worker,
            "fail",
            lambda: ledger.fail(error, []),
            model.failed(name, claim.token),
            lambda done: "over" if done else None,
        )
        if world.jobs[name].cancel_requested:
            yield self._write(
                worker,
                "cancelled",
                lambda: ledger.cancelled([], claim.name),
                model.ended_cancelled(name, claim.token),
                lambda _: "over",
            )
        for event, setback, again in (
            ("requeued", None, "now"),
            ("attempt_crashed", "error", "now"),
            ("requeued", "disk_full", "later"),
        ):
            how = Requeue(event, {}, setback)  # type: ignore[arg-type]
            yield self._write(
                worker,
                f"give back ({setback})",
                lambda how=how: ledger.give_back(how),
                model.given_back(name, claim.token, event, setback),
                lambda back, again=again: again if back else "over",
            )

    def _write(
        self,
        worker: Worker,
        what: str,
        run: Callable[[], Awaitable[Any]],
        change: Change,
        ends: Callable[[Any], Again | None] | None = None,
    ) -> Act:
        """``ends``: what the worker does with the entry after this answer."""

        def learn(answer: object) -> None:
            if answer == FENCED:
                self.exit(worker)  # and leaves the entry to the new owner
            elif ends is not None:
                worker.again = ends(answer)

        return Act(f"worker {worker.id}: {what} {worker.name}", run, lambda _: change, worker, learn)

    def _acknowledge(self, worker: Worker) -> Act:
        entry, again = worker.entry, worker.again
        assert entry is not None
        assert again is not None

        async def acknowledge(connection: Connection) -> bool:
            return await job_queue.acknowledge(connection, entry.id, worker.id, again_in_s=AGAIN_S[again])

        def learn(_: bool) -> None:
            worker.entry, worker.claim, worker.again, worker.name = None, None, None, ""

        return Act(
            f"worker {worker.id}: acknowledge {again} {worker.name}",
            lambda: retry_while_unavailable(lambda: self._database.run(acknowledge)),
            lambda _, name=worker.name: model.acknowledged(name, worker.id, again),
            worker,
            learn,
            lambda _: None,
        )

    async def _release(self) -> None:
        await retry_while_unavailable(lambda: self._database.run(self._janitor._release_stalled))

    async def _end_late(self) -> frozenset[str] | None:
        """Which it ended; none where an answer was lost."""
        tries: list[list[str]] = []

        async def once() -> None:
            tries.append([])
            tries[-1] += await self._database.run(end_overdue_jobs, self._settings.stall_s)

        await retry_while_unavailable(once)
        ended = frozenset(name for name, job_id in self.ids.items() if job_id in tries[-1])
        return ended if len(tries) == 1 else None

    async def _upkeep(self) -> None:
        async def upkeep(connection: Connection) -> None:
            await requeue_lost(connection, 0)
            await offer_held_jobs(connection)
            await fold_tallies(connection)

        await retry_while_unavailable(lambda: self._database.run(upkeep))

    def exit(self, worker: Worker) -> None:
        """The worker's process is gone; what it has stays with it."""
        self.workers.remove(worker)
        self.dead.append(worker.id)


async def answered(act: Act) -> Any:
    """What the process sees: an answer, or that it is fenced."""
    try:
        return await act.run()
    except Fenced:
        return FENCED


def outcome_of(act: Act, answer: Any, world: World) -> tuple[object, World]:
    """What the model expects of the act, and where that leads."""
    return act.change(None if answer == FENCED else answer)(world)
