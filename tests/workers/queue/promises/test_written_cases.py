"""Cases that few random runs seldom reach: late, repeated and simultaneous writes, and lost answers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

from tests.workers.queue.promises.actors import Act, Worker
from tests.workers.queue.promises.faulty_connections import AFTER_COMMIT
from tests.workers.queue.promises.machine import Promises, promises_on

ENDS = ("publish", "fail", "give back (None)", "give back (error)", "give back (disk_full)")
WRITES = ("progress", "checkpoint", "stage", *ENDS)
CANCELLED = "cancelled"


class Play:
    """One job, and three workers whose steps are told; each is compared with the model."""

    def __init__(self, promises: type[Promises], *, cancelling: bool = False, limit: int = 0) -> None:
        self.machine, self._cancelling = promises(), cancelling
        self.machine.begin(limit=limit)
        self.workers = list(self.machine.actors.workers)
        self._perform(self.machine.actors.possible(self.machine.world), "client: submit job0", set())

    def does(self, number: int, *steps: str, lost: bool = False) -> None:
        """Also what the worker's program would not do at this moment. ``lost``: the answer, with its connection."""
        worker = self.workers[number]
        for step in steps:
            name = f"worker {worker.id}: {step}" + (" job0" if step != "take" else "")
            self._perform(self._acts(worker), name, {AFTER_COMMIT} if lost else set())
            if step == "claim" and self._cancelling:
                self._perform(self.machine.actors.possible(self.machine.world), "client: cancel job0", set())

    def is_late(self, ends: bool = True) -> None:
        """The job's deadline passes, and a janitor sees it."""
        self.machine.make_late("job0")
        if ends:
            self._perform(
                self.machine.actors.possible(self.machine.world), "janitor: end what is late", set()
            )

    def is_taken_for_dead(self, number: int) -> None:
        """It falls silent, and its job goes back to the queue."""
        self.machine.silence(self.workers[number])
        self.machine.notice(self.workers[number])

    def is_replaced(self, number: int) -> None:
        """It falls silent, and its job goes to the next worker."""
        self.is_taken_for_dead(number)
        self.does(number + 1, "take", "claim")

    def meet(self, first: str, second: str, at: int) -> None:
        """Two calls at once, the second within the first."""
        acts = {act.name: act for act in self.machine.actors.possible(self.machine.world)}
        self.machine.meet(acts[first], acts[second], at)

    def end(self) -> None:
        """A good worker brings the job to its end."""
        self.machine.teardown()

    def _acts(self, worker: Worker) -> Iterator[Act]:
        yield from self.machine.actors.next_of(worker, self.machine.world)
        if worker.claim is not None:
            yield from self.machine.actors._writes(worker, self.machine.world)

    def _perform(self, acts: Iterator[Act], name: str, cuts: set[int]) -> None:
        act = next(act for act in acts if act.name == name)
        self.machine.perform(act, cuts)


def test_nothing_is_changed_by_a_worker_that_was_replaced(database_url: str, tmp_path: Path):
    with promises_on(database_url, tmp_path) as promises:
        for write in WRITES:
            for published in (False, True):
                play = Play(promises)
                play.does(0, "take", "claim", "checkpoint")
                play.is_replaced(0)
                if published:
                    play.does(1, "publish")
                play.does(0, write)
                play.end()


def test_a_worker_that_was_replaced_before_it_claimed_does_not_claim(database_url: str, tmp_path: Path):
    with promises_on(database_url, tmp_path) as promises:
        for steps in ((), ("take",), ("take", "claim"), ("take", "claim", "publish", "acknowledge over")):
            play = Play(promises)
            play.does(0, "take")
            play.is_taken_for_dead(0)
            play.does(1, *steps)
            play.does(0, "claim", "acknowledge over")
            play.end()


def test_a_write_whose_answer_was_lost_is_done_once(database_url: str, tmp_path: Path):
    with promises_on(database_url, tmp_path) as promises:
        for write, cancelling in (
            *((write, False) for write in WRITES),
            *((end, True) for end in (*ENDS, CANCELLED)),
        ):
            play = Play(promises, cancelling=cancelling)
            play.does(0, "take", "claim")
            play.does(0, write, lost=True)
            play.end()


def test_beyond_its_deadline_a_job_ends_once_whoever_sees_it_first(database_url: str, tmp_path: Path):
    before = ((), ("take",), ("take", "claim"), ("take", "claim", "give back (None)"))
    with promises_on(database_url, tmp_path) as promises:
        for steps in before:
            for ends in (True, False):
                play = Play(promises)
                play.does(0, *steps)
                play.is_late(ends)
                if steps == ("take",):
                    play.does(0, "claim", "acknowledge over")
                play.is_taken_for_dead(0)
                play.end()
        for write in ENDS:
            play = Play(promises)
            play.does(0, "take", "claim")
            play.is_late()
            play.does(0, write)
            play.end()
        for at in range(12):
            for pair in itertools.permutations(("janitor: end what is late", "client: cancel job0")):
                play = Play(promises)
                play.is_late(ends=False)
                play.meet(*pair, at)
                play.end()


def test_an_attempt_ends_once_however_often_it_says_so(database_url: str, tmp_path: Path):
    with promises_on(database_url, tmp_path) as promises:
        for first in ENDS:
            for second in WRITES:
                play = Play(promises)
                play.does(0, "take", "claim", first, second)
                play.end()


def test_of_a_submission_and_an_end_at_once_the_new_job_is_held_only_while_there_is_no_room(
    database_url: str, tmp_path: Path
):
    with promises_on(database_url, tmp_path) as promises:
        for at in range(12):
            for first, second in itertools.permutations(("client: submit job1", "client: cancel job0")):
                play = Play(promises, limit=1)
                play.meet(first, second, at)
                assert not play.machine.world.jobs["job1"].held
                play.end()
