"""`biresnerf up` without HTTP: supervises a private database and the slots, then prints the database's address."""

import asyncio
import logging
import sys

from workers.settings.settings import Settings
from workers.upkeep.supervise import ChildSpec, slot_specs, supervise


async def ready(url: str) -> None:
    sys.stdout.write(f"ready {url}\n")
    sys.stdout.flush()
    await asyncio.sleep(600)  # as one that waits for an API which never comes up; must not hold up the end


logging.basicConfig(level=logging.INFO)
settings = Settings()
broken = (
    [ChildSpec("broken", (sys.executable, "-c", "raise SystemExit(7)"))] if "--broken" in sys.argv else []
)
sys.exit(asyncio.run(supervise(settings, [*slot_specs(settings), *broken], on_ready=ready)))
