"""Stores the files of a job's process as artifacts, each attempt's under its own prefix."""

from __future__ import annotations

import logging
import mimetypes
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path, PurePosixPath

from workers.process.waiting import retry_while_unavailable
from workers.records import LOG_NAME, POSES_NAME, PREVIEW_FOLDER, Artifact
from workers.store.files import FileStore

log = logging.getLogger(__name__)

KEPT_FROM_CLIENTS = {"checkpoint", PREVIEW_FOLDER}
# Stored first, so that a job that is cancelled meanwhile keeps them.
FIRST = (LOG_NAME, "report.json", POSES_NAME, "transforms.json")


async def store_result(
    files: FileStore,
    prefix: str,
    output: Path,
    log_file: Path,
    *,
    log_only: bool = False,
    enough: Callable[[], bool] = lambda: False,
) -> list[Artifact]:
    """Store the output, except checkpoint and previews, and the log; stops early once ``enough``.

    Waits while the store is away, as the work is already done.
    """
    names = {LOG_NAME: log_file} if log_file.exists() else {}
    for path in () if log_only else sorted(output.rglob("*")):
        relative = path.relative_to(output)
        if relative.parts[0] not in KEPT_FROM_CLIENTS and _is_plain(path):
            names[relative.as_posix()] = path
    artifacts = []
    for name in sorted(names, key=lambda name: (name not in FIRST, name)):
        if enough():
            break
        artifacts.append(
            await retry_while_unavailable(partial(store_artifact, files, prefix, name, names[name]))
        )
    return sorted(artifacts, key=lambda item: item.name)


async def store_artifact(files: FileStore, prefix: str, name: str, path: Path) -> Artifact:
    """Store one file as ``prefix``/``name``."""
    media_type = mimetypes.guess_type(name)[0] or "application/octet-stream"
    stored = await files.put_path(f"{prefix}/{name}", path, media_type)
    return Artifact(
        name=name,
        key=stored.key,
        size=stored.size,
        sha256=stored.sha256 or "",
        media_type=media_type,
    )


def files_inside(output: Path, names: Iterable[str]) -> dict[str, Path]:
    """Those of the named files that are plain files below the output folder."""
    found = {}
    for name in names:
        pure = PurePosixPath(name)
        if pure.is_absolute() or ".." in pure.parts:
            log.error("%r lies outside the output folder", name)
        elif _is_plain(output / name):
            found[name] = output / name
    return found


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()
