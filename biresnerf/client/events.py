"""Follows a job by its server-sent events, over as many connections as it takes."""

from __future__ import annotations

import json
import math
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any

import anyio
from httpx_sse import EventSource

from biresnerf.client.errors import JobNotOver, ServiceError
from biresnerf.client.job_calls import JobCalls
from biresnerf.client.retries import Retries
from biresnerf.client.transport import Call, tell
from biresnerf.wire.batches import BatchView
from biresnerf.wire.jobs import FINAL_JOB_STATES, JobEvent, JobView, job_url

# The service sends a comment every 15 s; after three missing ones the connection is dead.
_SILENCE_S = 50.0
_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0


@dataclass(frozen=True)
class StreamEvent:
    """One message of the stream. For the kind ``progress``, ``data`` is the job, else one of its events."""

    kind: str
    data: dict[str, Any]

    @property
    def job(self) -> JobView | None:
        """The job as it is now, for ``progress``."""
        return JobView.model_validate(self.data, extra="ignore") if self.kind == "progress" else None

    @property
    def event(self) -> JobEvent | None:
        """The event, for all other kinds."""
        return None if self.kind == "progress" else JobEvent.model_validate(self.data, extra="ignore")


class Events(JobCalls):
    """Follows jobs."""

    async def events(
        self, job_id: str, *, after: int = 0, timeout_s: float | None = None
    ) -> AsyncIterator[StreamEvent]:
        """The job's events after number ``after``, each once, and its progress, until the job is over.

        Reconnects where a connection broke, and waits for a service that is away.

        Raises:
            JobNotOver: the job is not over after ``timeout_s``.
        """
        deadline = math.inf if timeout_s is None else anyio.current_time() + timeout_s
        async with aclosing(self._follow(job_id, after)) as following:
            while True:
                event = None
                with anyio.CancelScope(deadline=deadline) as scope:
                    event = await anext(following, None)
                if scope.cancelled_caught and timeout_s is not None:
                    raise JobNotOver(job_id, timeout_s)
                if event is None:
                    return
                yield event

    async def wait(
        self,
        job_id: str,
        on_progress: Callable[[JobView], object] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> JobView:
        """Waits until the job is over and returns it, however it ended; ``on_progress`` is called with the job.

        Raises:
            JobNotOver: the job is not over after ``timeout_s``.
        """
        async for event in self.events(job_id, timeout_s=timeout_s):
            if on_progress is not None and (job := event.job) is not None:
                await tell(on_progress, job)
        return await self.job(job_id)

    async def wait_for_batch(self, batch_id: str, *, timeout_s: float | None = None) -> BatchView:
        """Waits until all jobs of the batch are over and returns it, however they ended.

        Raises:
            JobNotOver: one of its jobs is not over after ``timeout_s``.
        """
        deadline = math.inf if timeout_s is None else anyio.current_time() + timeout_s
        for job in (await self.batch(batch_id)).jobs:
            left_s = None if timeout_s is None else max(0.0, deadline - anyio.current_time())
            await self.wait(job.id, timeout_s=left_s)
        return await self.batch(batch_id)

    async def _follow(self, job_id: str, after: int) -> AsyncGenerator[StreamEvent]:
        retries, reconnect_s, last = Retries(self._policy), _PAUSE_S, after
        while True:
            job_is_final = False
            headers = {"Accept": "text/event-stream", "Last-Event-ID": str(last)}
            call = Call("GET", f"{job_url(job_id)}/events", headers=headers, answer_s=_SILENCE_S)
            try:
                async with self._open(call) as response:
                    if not response.headers.get("content-type", "").startswith("text/event-stream"):
                        raise ServiceError.of_foreign_answer(response.status_code)
                    async for message in EventSource(response).aiter_sse():
                        retries.progressed()
                        if message.retry is not None:
                            reconnect_s = min(message.retry / 1000, _LONGEST_PAUSE_S)
                        if not message.data:
                            continue
                        last = int(message.id or last)
                        event = StreamEvent(message.event, json.loads(message.data))
                        yield event
                        # The event that ends the job comes last, after the job as it ended.
                        if event.kind in FINAL_JOB_STATES:
                            return
                        job_is_final = event.data.get("state") in FINAL_JOB_STATES
                if job_is_final:
                    return
                pause_s = reconnect_s
            except ServiceError as error:
                pause_s = max(reconnect_s, retries.pause_after(error))
            await anyio.sleep(pause_s)
