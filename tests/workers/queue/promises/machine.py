"""The machine: a database, everybody who works on it, and the model of it, which must agree after each step."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import psycopg
import pytest
from hypothesis import strategies
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
)

from tests.workers.conftest import quick_settings
from tests.workers.queue.promises.actors import Act, Actors, Worker, answered, outcome_of
from tests.workers.queue.promises.faulty_connections import (
    AFTER_COMMIT,
    Faults,
    ProcessDied,
    faults_in,
    open_faulty_database,
    waits_for_a_lock,
)
from tests.workers.queue.promises.model import World, released
from tests.workers.queue.promises.observed import broken_promises, observe
from workers.database import job_queue
from workers.database.database import Database
from workers.process import waiting

PLACES = strategies.just(AFTER_COMMIT) | strategies.integers(0, 12)
RESET = (
    "DELETE FROM jobs; DELETE FROM procrastinate_jobs; DELETE FROM procrastinate_workers; DELETE FROM trash;"
    " DELETE FROM tally_log; DELETE FROM tallies"
)
SILENT = "UPDATE procrastinate_workers SET last_heartbeat = now() - interval '1 hour' WHERE id = ANY (%s)"
DUE = (
    "UPDATE procrastinate_jobs SET scheduled_at = now() - interval '1 second'"
    " WHERE status = 'todo' AND scheduled_at BETWEEN now() AND now() + interval '1 day'"
)
LATE = (
    "UPDATE jobs SET start_by = now() - interval '1 second', deadline_at = now() - interval '1 second'"
    " WHERE idempotency_key = %s"
)


class Promises(RuleBasedStateMachine):
    """A database, everybody who works on it, and the model of it."""

    runner: asyncio.Runner
    database: Database
    looking: psycopg.Connection
    data_dir: Path
    counts: dict[str, int]

    def __init__(self) -> None:
        super().__init__()
        self.looking.execute(RESET)
        self.actors = Actors(self.database, quick_settings(self.data_dir, max_attempts=3), "ds_promises")
        self.world = World()
        self.accepted: set[str] = set()
        self.confirmed: dict[str, int] = {}
        self.late: dict[str, int] = {}
        self.count("examples")

    def count(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1

    @initialize(limit=strategies.sampled_from([0, 0, 2]))
    def begin(self, limit: int) -> None:
        self.looking.execute("UPDATE tenants SET max_running = %s WHERE id = 'local'", (limit,))
        self.world = World(limit=limit)
        for _ in range(3):
            self.hire()

    def hire(self) -> None:
        worker_id = self.runner.run(self.database.run(job_queue.register_worker))
        self.actors.workers.append(Worker(worker_id))

    def choose(self, data: strategies.DataObject, label: str) -> Act:
        return data.draw(strategies.sampled_from(list(self.actors.possible(self.world))), label)

    @rule(data=strategies.data(), cuts=strategies.just(()) | strategies.sets(PLACES, min_size=1, max_size=2))
    def act(self, data: strategies.DataObject, cuts: set[int]) -> None:
        """Alone; each cut connection makes the call try again."""
        self.perform(self.choose(data, "act"), cuts)

    def perform(self, act: Act, cuts: set[int]) -> None:
        """Run it, and compare what it answers and what it changes with the model."""
        faults = Faults(cuts=tuple(cuts))
        answer = self.runner.run(_under(faults, act))
        self.count("calls that lost a connection" if any(cut < faults.place for cut in cuts) else "calls")
        expected, world = outcome_of(act, answer, self.world)
        assert act.answer_of(answer) == expected, act
        self.agree([world], f"{act}, cut at {cuts}")
        self.learn(act, answer)

    @rule(data=strategies.data(), at=PLACES)
    def die(self, data: strategies.DataObject, at: int) -> None:
        """All of the call has happened, or nothing."""
        act = self.choose(data, "act")
        try:
            answer = self.runner.run(_under(Faults(cuts=(at,), dies=True), act))
        except ProcessDied:
            self.count("processes that died within a call")
            _, world = outcome_of(act, None, self.world)
            self.agree([self.world, world], f"{act}, died at {at}")
            if act.worker is not None:
                self.actors.exit(act.worker)
                self.hire()
        else:
            expected, world = outcome_of(act, answer, self.world)
            assert act.answer_of(answer) == expected, act
            self.agree([world], f"{act}")
            self.learn(act, answer)

    @rule(data=strategies.data(), at=PLACES)
    def overlap(self, data: strategies.DataObject, at: int) -> None:
        """Two calls at once come out as if one had come after the other."""
        first = self.choose(data, "first")
        others = [
            act
            for act in self.actors.possible(self.world)
            if act.name != first.name and (act.worker is None or act.worker is not first.worker)
        ]
        job = first.name.rpartition("job")[2]
        others += 4 * [act for act in others if act.name.rpartition("job")[2] == job]
        self.meet(first, data.draw(strategies.sampled_from(others), "second"), at)

    def meet(self, first: Act, second: Act, at: int) -> None:
        """The second within the first, which waits at this place of its transaction."""
        answers = self.runner.run(_side_by_side(first, second, at))
        self.count("pairs of calls, one within the other")
        worlds = []
        for order in ((0, 1), (1, 0)):
            world, acts = self.world, (first, second)
            said: dict[int, object] = {}
            for which in order:
                said[which], world = outcome_of(acts[which], answers[which], world)
            if all(acts[which].answer_of(answers[which]) == said[which] for which in order):
                worlds.append(world)
        assert worlds, f"{first} and {second} (at {at}) answered {answers}: that is neither order"
        self.agree(worlds, f"{second} within {first} at {at}")
        self.learn(first, answers[0])
        self.learn(second, answers[1])

    @precondition(lambda self: any(worker.entry for worker in self.actors.workers))
    @rule(
        data=strategies.data(),
        asleep=strategies.sampled_from([True, True, False]),
        noticed=strategies.booleans(),
    )
    def fall_silent(self, data: strategies.DataObject, asleep: bool, noticed: bool) -> None:
        """A worker is dead, or only asleep: nobody can tell."""
        worker = data.draw(
            strategies.sampled_from([worker for worker in self.actors.workers if worker.entry])
        )
        self.silence(worker)
        if not asleep:
            self.actors.exit(worker)
            self.hire()
        if noticed:
            self.notice(worker)

    def silence(self, worker: Worker) -> None:
        self.looking.execute(SILENT, ([worker.id, *self.actors.dead],))
        self.world = replace(self.world, silent=self.world.silent | {worker.id, *self.actors.dead})

    def notice(self, worker: Worker) -> None:
        self.runner.run(self.actors._release())
        self.agree([released(self.world)[1]], f"worker {worker.id} was taken for dead")

    @precondition(lambda self: any(job.place == "later" and not job.held for job in self.world.jobs.values()))
    @rule()
    def time_passes(self) -> None:
        """What was put back for later is due."""
        self.looking.execute(DUE)
        due = {
            name: replace(job, place="todo") if job.place == "later" and not job.held else job
            for name, job in self.world.jobs.items()
        }
        self.world = replace(self.world, jobs=due)

    @precondition(lambda self: any(not (job.final or job.late) for job in self.world.jobs.values()))
    @rule(data=strategies.data())
    def deadline_passes(self, data: strategies.DataObject) -> None:
        """Of one job: from here on it does not start."""
        going_on = [name for name, job in self.world.jobs.items() if not (job.final or job.late)]
        self.make_late(data.draw(strategies.sampled_from(going_on)))

    def make_late(self, name: str) -> None:
        job = self.world.jobs[name]
        self.looking.execute(LATE, (name,))
        self.late[name] = len(job.events)
        self.world = replace(self.world, jobs={**self.world.jobs, name: replace(job, late=True)})

    def agree(self, worlds: list[World], what: str) -> None:
        """The database is where one of them is; tokens that nobody was told are as they are."""
        seen, rows = observe(self.looking)
        fitting = [world for world in worlds if _resolved(world, seen).jobs == seen]
        assert fitting, f"after {what} the jobs are {seen}, not {[dict(world.jobs) for world in worlds]}"
        self.world = _resolved(fitting[0], seen)
        self.actors.ids.update({row["idempotency_key"]: row["id"] for row in rows})
        assert broken_promises(self.looking, rows, self.accepted, self.confirmed, self.late) == []

    def learn(self, act: Act, answer: object) -> None:
        """What clients and workers know from here on."""
        kind, _, name = act.name.rpartition(" ")
        if kind == "client: submit":
            self.accepted.add(name)
        elif kind == "client: cancel" and answer in ("running", "cancelled"):
            self.confirmed.setdefault(name, len(self.world.jobs[name].events))
        act.learn(answer)
        while len(self.actors.workers) < 3:
            self.hire()

    def teardown(self) -> None:
        """Everybody dies, and one good worker brings all jobs to an end."""
        for worker in list(self.actors.workers):
            self.actors.exit(worker)
        self.looking.execute(SILENT, (self.actors.dead,))
        self.looking.execute(DUE)
        self.runner.run(self.actors._release())
        self.hire()
        self.runner.run(self.finish())
        seen, rows = observe(self.looking)
        assert {name: job.state for name, job in seen.items() if not job.final or job.place != "over"} == {}
        assert broken_promises(self.looking, rows, self.accepted, self.confirmed, self.late) == []

    async def finish(self) -> None:
        (worker,) = self.actors.workers
        for _ in range(60):
            world = World(observe(self.looking)[0])
            acts = {act.name.split()[2]: act for act in self.actors.next_of(worker, world)}
            act = acts.get("publish") or next(iter(acts.values()))
            answer = await answered(act)
            act.learn(answer)
            if act.name.endswith("take") and answer is None:
                return
            if answer is False:
                worker.again = worker.again or "over"
                await acts["cancelled"].run()
        raise AssertionError("the queue does not become empty")


def _resolved(world: World, seen: dict) -> World:
    """With the tokens of attempts whose process died before it knew its own."""
    jobs = {
        name: replace(job, token=seen[name].token)
        if job.state == "running" and job.token is None and name in seen
        else job
        for name, job in world.jobs.items()
    }
    return replace(world, jobs=jobs)


async def _under(faults: Faults, act: Act) -> object:
    with faults_in(faults):
        return await answered(act)


async def _side_by_side(first: Act, second: Act, at: int) -> tuple[object, object]:
    """The first waits at its statement until the second is done, or waits for it."""
    faults = Faults(pauses=at)
    early = asyncio.create_task(_under(faults, first))
    reached = asyncio.create_task(faults.reached.wait())
    await asyncio.wait({early, reached}, return_when=asyncio.FIRST_COMPLETED)
    late = asyncio.create_task(answered(second))
    while not late.done() and not waits_for_a_lock():
        await asyncio.wait({late}, timeout=0.002)
    faults.go_on.set()
    reached.cancel()
    return await early, await late


@contextlib.contextmanager
def promises_on(database_url: str, data_dir: Path) -> Iterator[type[Promises]]:
    """The machine, on a database."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith(("psycopg", "workers"))]
    with pytest.MonkeyPatch.context() as patch, asyncio.Runner() as runner:
        for name in names:  # they tell of every connection that was cut
            patch.setattr(logging.getLogger(name), "disabled", True)
        patch.setattr(waiting, "RETRY_S", 0.0)
        with psycopg.connect(database_url, autocommit=True) as looking:
            looking.execute("INSERT INTO datasets (id, name, state) VALUES ('ds_promises', 'test', 'ready')")
            opening = open_faulty_database(database_url)
            database = runner.run(opening.__aenter__())
            world = {"runner": runner, "database": database, "looking": looking, "data_dir": data_dir}
            try:
                yield type("Promises", (Promises,), {**world, "counts": {}})
            finally:
                runner.run(opening.__aexit__(None, None, None))
