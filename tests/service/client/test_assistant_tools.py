"""The tool server for assistants, by the protocol's own client, over the pipes that an assistant uses."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from biresnerf.client import Client as ServiceClient
from tests.service.conftest import Running

mcp = pytest.importorskip("mcp", reason="needs mcp (pip install 'biresnerf[mcp]')")

pytestmark = [pytest.mark.server, pytest.mark.anyio]


@asynccontextmanager
async def assistant(url: str) -> AsyncIterator[Any]:
    command = ["-m", "biresnerf.command_line", "mcp", "--url", url]
    async with mcp.Client(mcp.StdioServerParameters(command=sys.executable, args=command)) as client:
        yield client


async def answer(client: Any, tool: str, **arguments: Any) -> Any:
    said = await client.call_tool(tool, arguments)
    assert not said.is_error, said.content
    return said.structured_content.get("result", said.structured_content)


async def test_an_assistant_submits_follows_reads_the_verdict_and_downloads(
    service: Running, scene: Path, tmp_path: Path
) -> None:
    async with assistant(service.url) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == {
            "submit", "jobs", "job", "verdict", "download", "cancel",
        }  # fmt: skip
        queued = await answer(
            client, "submit", path=str(scene), options={"preset": "fast"}, name="by an assistant"
        )
        assert queued["page"] == f"{service.url}/#/jobs/{queued['id']}"
        over = await answer(client, "job", job_id=queued["id"], wait_s=60)
        assert (over["state"], over["final"], over["fraction"]) == ("succeeded", True, 1.0)
        assert queued["id"] in [job["id"] for job in await answer(client, "jobs")]
        said = await answer(client, "verdict", job_id=queued["id"])
        with ServiceClient(service.url) as own:
            assert said["in_words"] == own.report(queued["id"]).verdict.in_words()
            wanted = {file.name for file in own.artifacts(queued["id"])}
        files = await answer(client, "download", job_id=queued["id"], folder=str(tmp_path / "out"))
        assert {Path(file).relative_to(tmp_path / "out").as_posix() for file in files} == wanted


async def test_a_job_is_cancelled_and_one_that_runs_is_not_waited_for_too_long(
    service: Running, scene: Path
) -> None:
    slow = {"preset": "fast", "steps": 400, "seed": 100}
    async with assistant(service.url) as client:
        queued = await answer(client, "submit", path=str(scene), options=slow)
        assert not (await answer(client, "job", job_id=queued["id"], wait_s=0.2))["final"]
        await answer(client, "cancel", job_id=queued["id"])
        assert (await answer(client, "job", job_id=queued["id"], wait_s=60))["state"] == "cancelled"


async def test_an_error_reaches_the_assistant_with_what_where_and_a_hint(
    service: Running, tmp_path: Path
) -> None:
    async with assistant(service.url) as client:
        for tool, arguments, words in (
            ("submit", {"path": str(tmp_path / "nowhere")}, "does not exist"),
            ("job", {"job_id": "job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"}, "job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"),
        ):
            said = await client.call_tool(tool, arguments)
            assert said.is_error
            assert words in said.content[0].text
            assert "Traceback" not in said.content[0].text


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
