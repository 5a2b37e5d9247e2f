from __future__ import annotations

import asyncio
import fcntl
import os
from pathlib import Path

from workers.process.locked_folders import locked_folder, sweep_folders


def test_folders_go_away_with_their_use_and_after_a_crash(tmp_path: Path) -> None:
    async def use() -> None:
        async with locked_folder(tmp_path) as folder:
            (folder / "archive").write_bytes(b"x")
            os.utime(folder, (0, 0))
            assert sweep_folders(tmp_path) == 0  # in use, however long

    asyncio.run(use())
    assert list(tmp_path.iterdir()) == []
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    (crashed / ".in-use").touch()  # its lock went with its process
    living = tmp_path / "living"
    living.mkdir()
    made_just_now = tmp_path / "new"
    made_just_now.mkdir()
    with (living / ".in-use").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for folder in (crashed, living):
            os.utime(folder, (0, 0))
        assert sweep_folders(tmp_path) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["living", "new"]
