"""The commands of the service, found by `biresnerf` through their entry points. Imports happen when one runs."""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import click

from biresnerf.errors import InputError

DEFAULT_URL = "http://127.0.0.1:8000"


def free_port() -> int:
    """A port that nobody listens on just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@click.command("up")
@click.option("--host", help="Address to listen on. Default: BIRESNERF_HOST, else 127.0.0.1.")
@click.option(
    "--port", type=click.IntRange(0, 65535), help="0 takes a free one. Default: BIRESNERF_PORT, else 8000."
)
@click.option(
    "--slots", type=click.IntRange(0, 64), help="Jobs at the same time. Default: BIRESNERF_SLOTS, else 1."
)
@click.option("--data-dir", type=click.Path(path_type=Path), help="Files and private database.")
def up_command(host: str | None, port: int | None, slots: int | None, data_dir: Path | None) -> None:
    """Run everything on this machine: database, API and workers.

    Without BIRESNERF_DATABASE_URL a private PostgreSQL is started from the installed package. Ctrl-C stops
    everything; running jobs write a checkpoint and go on at the next start.
    """
    import asyncio

    from workers.errors import SetupError
    from workers.settings import Settings
    from workers.supervise import ChildSpec, slot_specs, supervise

    logging.basicConfig(level=logging.INFO, format="%(asctime)s up %(levelname)s %(message)s")
    given = {"host": host, "port": port, "slots": slots, "data_dir": data_dir}
    try:
        settings = Settings(**{key: value for key, value in given.items() if value is not None})  # type: ignore[arg-type]
        if settings.port == 0:
            settings = settings.model_copy(update={"port": free_port()})
        variables = {"BIRESNERF_HOST": settings.host, "BIRESNERF_PORT": str(settings.port)}
        api = ChildSpec("api", (sys.executable, "-m", "service.server"), variables)
        ready = _announcer(settings.host, settings.port)
        sys.exit(asyncio.run(supervise(settings, [api, *slot_specs(settings)], on_ready=ready)))
    except (SetupError, ValueError) as error:
        raise _setup_problem(error) from None


def _announcer(host: str, port: int) -> Callable[[str], Coroutine[None, None, None]]:
    async def announce(_: str) -> None:
        import asyncio

        shown = f"[{host}]" if ":" in host else host
        url = f"http://{'127.0.0.1' if host in {'0.0.0.0', '::'} else shown}:{port}"
        while not await asyncio.to_thread(_answers, url):
            await asyncio.sleep(0.1)
        click.echo(f"ready at {url}  (API docs: {url}/docs)")

    return announce


def _answers(url: str) -> bool:
    from service.client import Client

    with Client(url) as client:
        return client.ready()


@click.command("api")
@click.option("--host", help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), help="0 takes a free one.")
def api_command(host: str | None, port: int | None) -> None:
    """Run the web process alone (needs BIRESNERF_DATABASE_URL and `biresnerf migrate`)."""
    if host is not None:
        os.environ["BIRESNERF_HOST"] = host
    if port is not None:
        os.environ["BIRESNERF_PORT"] = str(port)
    from service.server import main

    sys.exit(main())


@click.command("worker")
@click.option("--slot", default="cpu0", show_default=True, help="cpuN, or gpuN for the GPU of that number.")
def worker_command(slot: str) -> None:
    """Run one worker slot: one job at a time (needs BIRESNERF_DATABASE_URL and `biresnerf migrate`)."""
    from workers.slot import main

    sys.argv = ["biresnerf worker", "--slot", slot]
    sys.exit(main())


@click.command("migrate")
def migrate_command() -> None:
    """Bring the database at BIRESNERF_DATABASE_URL up to date."""
    from workers.errors import SetupError
    from workers.migrate import migrate
    from workers.settings import Settings

    try:
        applied = migrate(Settings().require_database_url())
    except (SetupError, ValueError) as error:
        raise _setup_problem(error) from None
    click.echo("\n".join(f"applied {name}" for name in applied) or "The database is up to date.")


@click.command("submit")
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--preset", help="fast, balanced, quality or paper.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="An option; may be repeated.")
@click.option("--wait", is_flag=True, help="Show progress until the job is over.")
@click.option("--output", type=click.Path(path_type=Path), help="Download the result here; implies --wait.")
@click.option(
    "--url", envvar="BIRESNERF_URL", default=DEFAULT_URL, show_default=True, help="Where the service is."
)
def submit_command(
    path: Path, preset: str | None, settings: tuple[str, ...], wait: bool, output: Path | None, url: str
) -> None:
    """Send PATH (a folder or a transforms.json with its images) to a service.

    Exit status: 0 done, 2 the input or options have to change, 1 anything else. Ctrl-C ends the waiting; the
    job goes on.
    """
    from service.submit import run_submit

    run_submit(path, preset, settings, wait=wait, output=output, url=url)


def _setup_problem(error: Exception) -> InputError:
    what = getattr(error, "what", None) or "; ".join(
        f"BIRESNERF_{'_'.join(str(part) for part in item['loc']).upper()}: {item['msg']}"
        for item in _items(error)
    )
    return InputError(getattr(error, "code", "invalid_settings"), what)


def _items(error: Exception) -> list[dict[str, Any]]:
    errors = getattr(error, "errors", None)
    return errors() if callable(errors) else [{"loc": ("settings",), "msg": str(error)}]
