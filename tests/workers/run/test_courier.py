"""What is delivered from a job's process to its record, with a ledger that only records calls."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from biresnerf.progress import Progress
from workers.jobs.claim import Fenced
from workers.run import courier as couriers
from workers.run.courier import Courier
from workers.settings.errors import Unavailable
from workers.store.file_places import LocalPlace
from workers.store.files import FileStore

pytestmark = pytest.mark.anyio


class Notes:
    """In the place of a `Ledger`."""

    def __init__(self) -> None:
        self.claim = SimpleNamespace(job_id="job_1", name="1-x")
        self.stages: list[tuple[str, int]] = []
        self.pointers: list[tuple[str, str, list[str]]] = []
        self.lines: list[str] = []
        self.fenced = False

    async def progress(self, now: Progress) -> None:
        self.stages.append((now.stage, now.step))

    async def log(self, lines: Sequence[str]) -> None:
        self.lines += lines

    async def checkpoint(self, prefix: str, files: Sequence[str], step: int) -> None:
        self._point("checkpoint", prefix, files)

    async def preview(self, prefix: str, artifacts: Sequence[Any], now: Progress) -> None:
        self._point("preview", prefix, [item.name for item in artifacts])

    async def reusable(self, stage: str, prefix: str, files: Sequence[str]) -> None:
        self._point(stage, prefix, files)

    def _point(self, kind: str, prefix: str, files: Sequence[str]) -> None:
        if self.fenced:
            raise Fenced("another owner")
        self.pointers.append((kind, prefix, list(files)))


class Run:
    """A courier, and what it works on."""

    def __init__(self, folder: Path) -> None:
        self.notes, self.files = Notes(), FileStore(LocalPlace(folder / "files"))
        self.output, self.log = folder / "output", folder / "log.txt"
        self.output.mkdir()
        self.courier = Courier(self.notes, self.files, self.output, self.log)  # type: ignore[arg-type]

    def wrote(self, *names: str) -> None:
        for name in names:
            (self.output / name).write_text(name)

    async def end(self, **options: bool) -> None:
        self.courier.close(**options)
        await asyncio.wait_for(self.courier.run(), 10)

    async def stored(self) -> set[str]:
        return {file.key for file in await self.files.list("jobs/job_1")}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


async def test_every_stage_arrives_in_order_and_of_the_rest_only_the_latest(run: Run):
    for stage, step in (("seeding", 0), ("coarse", 1), ("coarse", 2), ("fine", 3), ("fine", 4), ("fine", 5)):
        run.courier.offer(Progress(stage=stage, step=step))
    await run.end()
    assert run.notes.stages == [("seeding", 0), ("coarse", 1), ("fine", 3), ("fine", 5)]


async def test_progress_is_written_once_a_period(run: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(couriers, "PERIOD_S", 0.2)
    running = asyncio.create_task(run.courier.run())
    for step in range(50):
        run.courier.offer(Progress(stage="coarse", step=step))
        await asyncio.sleep(0.01)
    run.courier.close()
    await running
    assert run.notes.stages[-1] == ("coarse", 49)
    assert len(run.notes.stages) < 10


async def test_each_checkpoint_has_a_folder_of_its_own_and_is_stored_before_it_is_pointed_at(run: Run):
    running = asyncio.create_task(run.courier.run())
    run.wrote("checkpoint.pt")
    for step in (1, 2):
        run.courier.offer(Progress(stage="coarse", step=step, checkpoint="checkpoint.pt"))
        while len(run.notes.pointers) < step:
            await asyncio.sleep(0.01)
        assert f"{run.notes.pointers[-1][1]}/checkpoint.pt" in await run.stored()
    run.courier.close()
    await running
    first, second = (prefix for _, prefix, _ in run.notes.pointers)
    assert first != second
    assert {first, second} == {f"jobs/job_1/checkpoints/1-x-{number}" for number in (1, 2)}


async def test_of_a_cancelled_job_the_last_checkpoint_is_not_stored_but_its_preview_is(run: Run):
    run.wrote("checkpoint.pt", "poses.json")
    run.courier.offer(Progress(stage="coarse", checkpoint="checkpoint.pt", preview=("poses.json",)))
    await run.end(last_checkpoint=False)
    assert [kind for kind, _, _ in run.notes.pointers] == ["preview"]


async def test_a_preview_that_the_job_takes_away_at_its_end_is_no_error(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    run.wrote("a.png", "b.png")
    store = couriers.store_artifact

    async def while_the_job_cleans_up(files: FileStore, prefix: str, name: str, path: Path) -> Any:
        stored = await store(files, prefix, name, path)
        (run.output / "b.png").unlink()
        return stored

    monkeypatch.setattr(couriers, "store_artifact", while_the_job_cleans_up)
    run.courier.offer(Progress(stage="fine", fraction=1.0, preview=("a.png", "b.png")))
    await run.end()
    assert (run.notes.pointers, caplog.records) == ([], [])


async def test_files_outside_of_the_output_and_links_are_not_stored(run: Run, tmp_path: Path):
    (tmp_path / "secret").write_text("s")
    (run.output / "link").symlink_to(tmp_path / "secret")
    run.wrote("good")
    run.courier.offer(
        Progress(stage="coarse", preview=("../secret", str(tmp_path / "secret"), "link", "good"))
    )
    await run.end()
    assert {key.rpartition("/")[2] for key in await run.stored()} == {"good"}


async def test_work_of_a_stage_that_lacks_a_file_is_not_offered(run: Run):
    run.wrote("poses")
    run.courier.offer(Progress(stage="coarse", reusable={"seeding": ("poses", "lost"), "coarse": ("poses",)}))
    await run.end()
    ((kind, prefix, files),) = run.notes.pointers
    assert (kind, files) == ("coarse", ["poses"])
    assert await run.stored() == {f"{prefix}/poses"}
    assert "/stages/coarse/" in prefix, "where the end of the job looks for what is not recorded"


async def test_a_store_that_refuses_a_checkpoint_does_not_end_the_job(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    async def refuses(*_: object) -> None:
        raise Unavailable("storage_unavailable", "full")

    monkeypatch.setattr(run.files, "put_path", refuses)
    run.wrote("checkpoint.pt")
    run.courier.offer(Progress(stage="coarse", checkpoint="checkpoint.pt"))
    with caplog.at_level(logging.ERROR):
        await run.end()
    assert run.notes.stages == [("coarse", 0)]
    assert "was not stored" in caplog.text


async def test_who_is_fenced_takes_away_what_was_stored_in_vain(run: Run):
    run.notes.fenced = True
    run.wrote("checkpoint.pt")
    run.courier.offer(Progress(stage="coarse", checkpoint="checkpoint.pt"))
    with pytest.raises(Fenced):
        await run.end()
    assert await run.stored() == set()


async def test_the_log_is_carried_to_its_end_by_whole_lines(run: Run):
    run.log.write_bytes(b"one\n10%\r20%\rtwo\nthr")
    running = asyncio.create_task(run.courier.run())
    while len(run.notes.lines) < 2:
        await asyncio.sleep(0.01)
    with run.log.open("ab") as file:
        file.write(b"ee\nlast\0" + b"x" * 3000)
    run.courier.close()
    await running
    assert run.notes.lines[:3] == ["one", "two", "three"]
    assert run.notes.lines[3].startswith("last\ufffdx")
    assert len(run.notes.lines) == 4
    assert len(run.notes.lines[3]) == couriers.LINE_CHARACTERS_MAX
