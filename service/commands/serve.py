"""Commands that run the service's processes; each imports what it needs when it runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from biresnerf.commands.answers import json_option, show
from biresnerf.commands.settings_option import settings_option
from service.commands.installation import data_dir_option, settings_with, setup_problems

if TYPE_CHECKING:
    from workers.settings.settings import Settings


processes_option = click.option(
    "--processes",
    type=click.IntRange(1, 16),
    help="Web processes that share the port. Default: BIRESNERF_PROCESSES, else 1.",
)


@click.command("up")
@click.option("--host", help="Address to listen on. Default: BIRESNERF_HOST, else 127.0.0.1.")
@click.option(
    "--port", type=click.IntRange(0, 65535), help="0: a free one. Default: BIRESNERF_PORT, else 8000."
)
@click.option(
    "--slots", type=click.IntRange(0, 64), help="Jobs at the same time. Default: BIRESNERF_SLOTS, else 1."
)
@processes_option
@data_dir_option
@click.option(
    "--open/--no-open", "open_page", default=None, help="Open the page in a browser. Default: on a desktop."
)
@click.option("--verbose", "-v", is_flag=True, help="Log every request and job, not only warnings.")
def up_command(
    host: str | None,
    port: int | None,
    slots: int | None,
    processes: int | None,
    data_dir: Path | None,
    open_page: bool | None,
    verbose: bool,
) -> None:
    """Run a whole service on this machine: database, API, dispatcher and workers.

    Without BIRESNERF_DATABASE_URL a private PostgreSQL is started from the installed package. Ctrl-C stops
    everything; running jobs write a checkpoint and continue at the next start.
    """
    import asyncio

    from service.processes import web_processes
    from workers.settings.logs import set_up_logging
    from workers.upkeep.supervise import dispatcher_spec, slot_specs, supervise

    os.environ.setdefault("BIRESNERF_LOG_LEVEL", "INFO" if verbose else "WARNING")  # for children, too
    if open_page is None:
        open_page = sys.stdout.isatty() and ("DISPLAY" in os.environ or sys.platform == "darwin")
    with setup_problems():
        settings = settings_with(host=host, port=port, slots=slots, processes=processes, data_dir=data_dir)
        set_up_logging("up", settings)
        with web_processes(settings) as web:
            children = [*web.children, dispatcher_spec(settings), *slot_specs(settings)]
            bound = settings.model_copy(update={"port": web.port})
            sys.exit(
                asyncio.run(supervise(settings, children, on_ready=lambda _: _announce(bound, open_page)))
            )


async def _announce(settings: Settings, open_page: bool) -> None:
    """Prints the service's address once it is ready, and opens the page if asked to."""
    import asyncio

    from biresnerf.client import AsyncClient

    host = "127.0.0.1" if settings.host in {"0.0.0.0", "::"} else settings.host
    url = f"http://{f'[{host}]' if ':' in host else host}:{settings.port}"
    async with AsyncClient(url) as client:
        while not await client.ready():
            await asyncio.sleep(0.1)
    click.echo(f"ready at {url}  (the page; API docs: {url}/docs; Ctrl-C stops everything)")
    if open_page:
        click.launch(url)


@click.command("api")
@click.option("--host", help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), help="0: a free one.")
@processes_option
def api_command(host: str | None, port: int | None, processes: int | None) -> None:
    """Run only the web process, or several that share the port.

    Needs BIRESNERF_DATABASE_URL, and a database brought up to date by `biresnerf migrate`.
    """
    import asyncio

    from service.processes import web_processes
    from workers.settings.logs import set_up_logging
    from workers.upkeep.supervise import keep_running

    with setup_problems():
        settings = settings_with(host=host, port=port, processes=processes)
        set_up_logging("api", settings)
        settings.require_database_url()
        if settings.processes == 1:
            from service.server import serve

            serve(settings)
        else:
            with web_processes(settings) as web:
                sys.exit(asyncio.run(keep_running(settings, web.children)))


@click.command("worker")
@click.option("--slot", default="cpu0", show_default=True, help="cpuN, or gpuN for GPU number N.")
@click.option(
    "--free-slot",
    type=click.Choice(["cpu", "gpu"]),
    help="In place of --slot: the first that is free on this host, of cpu0, cpu1 … or gpu0, gpu1 …",
)
@click.option("--one-job", is_flag=True, help="End after one job; the exit status says how it ended.")
@click.option(
    "--idle-exit", type=click.FloatRange(min=0), metavar="SECONDS", help="End where no job came for so long."
)
def worker_command(
    slot: str, free_slot: Literal["cpu", "gpu"] | None, one_job: bool, idle_exit: float | None
) -> None:
    """Run one worker slot, which runs one job at a time.

    Needs BIRESNERF_DATABASE_URL, and a database brought up to date by `biresnerf migrate`. With --free-slot gpu, jobs
    use the device in CUDA_VISIBLE_DEVICES if it is set, as batch systems do. With --one-job the exit status says how
    the job ended, or that there was none; docs/operations.md lists the statuses.
    """
    from workers.queue.slot import run_slot

    with setup_problems():
        settings_with().require_database_url()
    sys.exit(run_slot(slot, free_slot, one_job=one_job, idle_exit_s=idle_exit))


@click.command("migrate")
@json_option
def migrate_command(as_json: bool) -> None:
    """Bring the database at BIRESNERF_DATABASE_URL up to date."""
    from workers.database.migrate import migrate

    with setup_problems():
        applied = migrate(settings_with().require_database_url())
    lines = [f"applied {name}" for name in applied] or ["The database is up to date."]
    show({"applied": applied}, "\n".join(lines), as_json=as_json)


@click.command("demo")
@click.option("--scene", type=click.Path(path_type=Path), help="Your own folder or transforms.json.")
@click.option(
    "--output", type=click.Path(path_type=Path), default=Path("demo-output"), show_default=True,
    help="Folder for all files.",
)  # fmt: skip
@click.option("--preset", default="fast", show_default=True, help="fast, balanced, quality or paper.")
@click.option(
    "--views", type=click.IntRange(6, 400), default=60, show_default=True, help="Images of the synthetic scene."
)  # fmt: skip
@click.option(
    "--size", type=click.IntRange(32, 800), default=100, show_default=True, help="Width of its images, px."
)
@settings_option
def demo_command(
    scene: Path | None, output: Path, preset: str, views: int, size: int, settings: dict[str, Any]
) -> None:
    """Run a demonstration on a temporary service: wrong poses in, refined poses out.

    Without --scene a synthetic scene with known poses is rendered and each camera is turned and shifted at random
    (14 degrees on average). All files are in OUTPUT afterwards.
    """
    from biresnerf.options.refine_options import parse_options
    from service.commands.demo import run_demo

    run_demo(scene, output, parse_options({**settings, "preset": preset}), views, size)
