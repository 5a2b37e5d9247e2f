"""The dispatcher: sends webhooks, fetches and delivers files, and expires results and datasets.

Several may run at the same time, on any hosts: each message and file is claimed by one of them. Jobs need no
dispatcher; without one, messages and files wait.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys

from workers.database.database import open_database
from workers.database.notifications import Listener
from workers.datasets.fetcher import Fetcher
from workers.jobs.job_updates import JobListener
from workers.jobs.jobs import JobStore
from workers.process.exit_status import ExitStatus
from workers.process.waiting import first_done
from workers.process.watchdog import end_if_broken, run_process
from workers.settings.settings import Settings
from workers.store.files import open_files
from workers.store.store_identity import require_same_store
from workers.upkeep.deliverer import Deliverer
from workers.upkeep.expiry import Expiry
from workers.webhooks.outbound import Outbound, Policy
from workers.webhooks.webhook_sender import WebhookSender

log = logging.getLogger(__name__)

WEBHOOK_CHANNEL = "biresnerf_webhooks"


async def dispatch(settings: Settings, stop: asyncio.Event) -> None:
    """Work until ``stop``, then finish the current deliveries; raises `SetupError`."""
    url = settings.require_database_url()
    async with (
        open_database(url, connections=4, silence_s=settings.stall_s) as database,
        end_if_broken(database.broken),
    ):
        files = open_files(settings)
        await require_same_store(database, files)
        listener = Listener(database, settings.poll_s, WEBHOOK_CHANNEL)
        listening = asyncio.create_task(listener.run())
        sender = WebhookSender(database, listener, Outbound(Policy.of(settings)), settings)
        to_files = Outbound(Policy.of_files(settings))
        jobs = JobStore(database, JobListener(database, settings.poll_s), settings)
        fetcher = Fetcher(database, files, listener, to_files, settings)
        deliverer = Deliverer(jobs, database, files, listener, to_files, settings)
        duties = (sender, fetcher, deliverer, Expiry(database, settings))
        working = [asyncio.create_task(duty.run(stop)) for duty in duties]
        try:
            log.info("dispatcher is ready")
            await first_done(*working)  # before `stop` only if one of them failed
            stop.set()
            await asyncio.gather(*working)
        finally:
            for task in (listening, *working):
                task.cancel()


async def _until_signalled(settings: Settings) -> ExitStatus:
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    await dispatch(settings, stop)
    return ExitStatus.DONE


def main() -> int:
    """`python -m workers.upkeep.dispatcher`, settings from the environment; SIGTERM ends it within a delivery."""
    return run_process("dispatcher", _until_signalled)


if __name__ == "__main__":
    sys.exit(main())
