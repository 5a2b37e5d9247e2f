"""`biresnerf mcp`: tools for assistants (Model Context Protocol), by which they use a service as its commands do."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.jobs.service_options import DEFAULT_URL, PAGE, service_options
from biresnerf.errors import BiresnerfError, needs_extra

if TYPE_CHECKING:
    from mcp.server import MCPServer

    from biresnerf.client import AsyncClient
    from biresnerf.wire.jobs import JobView

INSTRUCTIONS = (
    "BiResNeRF refines the camera poses of photos. Submit a folder, ask for the job until its state is final, read its "
    "verdict, and download the result. Always tell the user the verdict: the result may hold the input's own poses."
)


@click.command("mcp")
@service_options
def mcp_command(url: str | None, api_key: str | None) -> None:
    """Serve tools for assistants on standard input and output (Model Context Protocol).

    An assistant's program starts this command, and uses the service with your API key and your files.
    """
    with needs_extra("mcp"):
        server = tool_server(url or DEFAULT_URL, api_key)
    server.run("stdio")


def tool_server(url: str, api_key: str | None) -> MCPServer:
    """A server with the tools of `Tools`."""
    from mcp.server import MCPServer

    server, tools = MCPServer("biresnerf", instructions=INSTRUCTIONS), Tools(url.rstrip("/"), api_key)
    for tool in (tools.submit, tools.jobs, tools.job, tools.verdict, tools.download, tools.cancel):
        server.add_tool(tool)
    return server


@dataclass(frozen=True)
class Tools:
    """What an assistant can do with the service at ``url``; each answers, or says what was wrong."""

    url: str
    api_key: str | None

    async def submit(
        self, path: Path, options: dict[str, Any] | None = None, name: str | None = None
    ) -> dict[str, Any]:
        """Send a folder of photos, or a file with their poses, and queue a job.

        Options: {"preset": "fast"} for minutes (the default without a GPU), "balanced" (with one) or "quality";
        {"time_budget_s": 120}.
        """
        async with self._service() as client:
            return self._told(await client.submit(path, options, name=name))

    async def jobs(self, most: int = 10) -> list[dict[str, Any]]:
        """The newest jobs."""
        async with self._service() as client:
            return [self._told(job) for job in await client.jobs(limit=most)]

    async def job(self, job_id: str, wait_s: float = 0) -> dict[str, Any]:
        """A job's state and progress; when it is over, or after so many seconds. Ask again until it is final."""
        from biresnerf.client import JobNotOver

        async with self._service() as client:
            with suppress(JobNotOver):
                return self._told(await client.wait(job_id, timeout_s=wait_s))
            return self._told(await client.job(job_id))

    async def verdict(self, job_id: str) -> dict[str, Any]:
        """Whether a finished job's refinement helped, on what evidence, whose poses the result has, and warnings."""
        async with self._service() as client:
            report = await client.report(job_id)
        said = report.verdict
        return {
            "verdict": said and said.verdict,
            "in_words": said.in_words() if said else [],
            "warnings": list(report.warnings),
        }

    async def download(self, job_id: str, folder: Path) -> list[str]:
        """Fetch a result into a folder: transforms.json, a COLMAP model, report.html. No other file is replaced."""
        async with self._service() as client:
            return [str(file) for file in await client.download_all(job_id, folder)]

    async def cancel(self, job_id: str, keep_partial: bool = True) -> dict[str, Any]:
        """Stop a job, with its best poses so far unless told otherwise."""
        async with self._service() as client:
            return self._told(await client.cancel(job_id, keep_partial=keep_partial))

    @asynccontextmanager
    async def _service(self) -> AsyncIterator[AsyncClient]:
        from mcp.server.mcpserver.exceptions import ToolError

        from biresnerf.client import AsyncClient

        try:
            async with AsyncClient(self.url, api_key=self.api_key, patience_s=30.0) as client:
                yield client
        except BiresnerfError as error:
            raise ToolError(str(error)) from None

    def _told(self, job: JobView) -> dict[str, Any]:
        named = {"id", "state", "stage", "queue_position", "partial", "message", "verdict", "error", "labels"}
        return {
            **job.model_dump(mode="json", include=named, exclude_none=True),
            "fraction": job.progress.fraction,
            "final": job.final,
            "page": f"{self.url}{PAGE}{job.id}",
        }
