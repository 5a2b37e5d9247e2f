"""Streams request bodies to disk, within limits, without holding them in memory."""

from __future__ import annotations

import asyncio
import fcntl
import re
import shutil
import time
import uuid
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from pathlib import Path
from typing import IO, Any

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from biresnerf.wire.problems import FieldProblem
from service.http.problems import ProblemError
from workers.process.disk_space import DiskBudget

# The methods of `Form` that the parser calls.
_CALLBACKS = (
    *("on_part_begin", "on_header_field", "on_header_value", "on_header_end", "on_headers_finished"),
    *("on_part_data", "on_part_end", "on_end"),
)
_FIELD_BYTES_MAX = 256 * 1024
_LOCK = ".in-use"
# A client that sends nothing for this long only occupies a connection and a folder.
IDLE_S = 60.0
_CHECK_EVERY_BYTES = 16 * 2**20  # between two checks of the free disk space


def raw_request(*media_types: str) -> dict[str, Any]:
    """The `openapi_extra` of a route whose body is the bytes of a file."""
    content = {"schema": {"type": "string", "format": "binary"}}
    return {"requestBody": {"required": True, "content": dict.fromkeys(media_types, content)}}


def limited_body(
    request: Request, limit_bytes: int, budget: DiskBudget | None = None
) -> AsyncIterator[bytes]:
    """The body of the request as `capped` passes it; refused at once where its Content-Length exceeds the limits."""
    announced = request.headers.get("content-length", "")
    if announced.isdigit():
        if int(announced) > limit_bytes:
            raise _too_large(limit_bytes)
        if budget is not None:
            budget.require(int(announced))
    return capped(request.stream(), limit_bytes, budget=budget)


async def capped(
    stream: AsyncIterator[bytes], limit_bytes: int, idle_s: float = IDLE_S, budget: DiskBudget | None = None
) -> AsyncIterator[bytes]:
    """The stream, with limits on its size and on the time between two chunks.

    Raises:
        ProblemError: ``body_too_large`` at the first byte beyond the limit; ``body_timeout`` if nothing
            arrives for ``idle_s``.
        LimitReached: ``storage_full`` if the disk has no room, at the start or later.
    """
    total, checked_at = 0, -_CHECK_EVERY_BYTES
    while True:
        try:
            async with asyncio.timeout(idle_s):
                chunk = await anext(stream)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise ProblemError("body_timeout", f"No byte of the body came for {idle_s:g} s.") from None
        total += len(chunk)
        if total > limit_bytes:
            raise _too_large(limit_bytes)
        if budget is not None and total - checked_at >= _CHECK_EVERY_BYTES:
            await asyncio.to_thread(budget.require)
            checked_at = total
        yield chunk


def _too_large(limit_bytes: int) -> ProblemError:
    return ProblemError(
        "body_too_large",
        f"The body is larger than {limit_bytes} bytes.",
        hint="Send fewer or smaller images, or single files; GET /v1/info tells the limits.",
    )


async def write_stream(stream: AsyncIterator[bytes], target: Path) -> None:
    """Writes the stream to a new file."""
    with target.open("xb") as out:
        async for chunk in stream:
            await asyncio.to_thread(out.write, chunk)


@asynccontextmanager
async def staging_folder(root: Path) -> AsyncIterator[Path]:
    """A private folder, deleted at the end of the block or, after a crash, at the next start."""
    folder = root / uuid.uuid4().hex
    folder.mkdir(parents=True, mode=0o700)
    with (folder / _LOCK).open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            yield folder
        finally:
            await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)


def sweep_staging(root: Path) -> int:
    """Removes staging folders of dead processes, which no longer hold the lock; returns how many."""
    removed = 0
    for folder in root.iterdir() if root.is_dir() else ():
        try:
            with (folder / _LOCK).open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        except OSError:
            # Without a lock file the folder is either brand new or half removed; its age shows which.
            if _modified_within(folder, 3600):
                continue
        shutil.rmtree(folder, ignore_errors=True)
        removed += 1
    return removed


def _modified_within(path: Path, seconds: float) -> bool:
    try:
        return time.time() - path.stat().st_mtime < seconds
    except OSError:
        return True


class Form:
    """A multipart form read from a stream: one file goes to disk, small text fields to memory."""

    def __init__(self, file_field: str, text_fields: Collection[str], target: Path) -> None:
        self.texts: dict[str, str] = {}
        self.has_file = False
        self._file_field, self._text_fields, self._target = file_field, text_fields, target
        self._out: IO[bytes] | None = None
        self._pending: list[bytes] = []
        self._header_name = self._header_value = b""
        self._headers: dict[bytes, bytes] = {}
        self._field = ""
        self._text = bytearray()
        self._complete = False

    async def read(self, content_type: str, stream: AsyncIterator[bytes]) -> None:
        """Reads the whole body.

        Raises:
            ProblemError: ``malformed_body``, ``invalid_request`` (unknown or repeated field).
        """
        _, parameters = parse_options_header(content_type)
        boundary = parameters.get(b"boundary")
        if not boundary:
            raise ProblemError("malformed_body", "The Content-Type has no boundary.", where="Content-Type")
        try:
            callbacks = {name: getattr(self, f"_{name}") for name in _CALLBACKS}
            parser = MultipartParser(boundary, callbacks)  # type: ignore[arg-type]
            async for chunk in stream:
                parser.write(chunk)
                await self._flush()
            parser.finalize()
        except FormParserError as error:
            raise ProblemError("malformed_body", f"The form is malformed: {error}.") from None
        finally:
            if self._out is not None:
                self._out.close()
        if not self._complete:
            raise ProblemError("malformed_body", "The form is cut short: its end mark is missing.")

    async def _flush(self) -> None:
        """Writes the parsed bytes of the file to disk, in a thread."""
        if self._pending and self._out is not None:
            block, self._pending = b"".join(self._pending), []
            await asyncio.to_thread(self._out.write, block)

    def _on_part_begin(self) -> None:
        self._headers, self._field, self._text = {}, "", bytearray()
        self._header_name = self._header_value = b""

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _on_header_end(self) -> None:
        self._headers[self._header_name.lower()] = self._header_value
        self._header_name = self._header_value = b""

    def _on_headers_finished(self) -> None:
        _, parameters = parse_options_header(self._headers.get(b"content-disposition", b""))
        self._field = parameters.get(b"name", b"").decode(errors="replace")
        if self._field in self.texts or (self._field == self._file_field and self.has_file):
            raise _bad_field(self._field, "The field occurs twice.")
        if self._field == self._file_field:
            self.has_file = True
            self._out = self._target.open("xb")
        elif self._field not in self._text_fields:
            known = ", ".join([self._file_field, *sorted(self._text_fields)])
            raise _bad_field(self._field, f"The field is unknown; there are {known}.")

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._field == self._file_field:
            self._pending.append(bytes(data[start:end]))
            return
        self._text += data[start:end]
        if len(self._text) > _FIELD_BYTES_MAX:
            raise _bad_field(self._field, f"The field is longer than {_FIELD_BYTES_MAX} bytes.")

    def _on_part_end(self) -> None:
        if self._field == self._file_field:
            return
        try:
            self.texts[self._field] = self._text.decode()
        except UnicodeDecodeError:
            raise _bad_field(self._field, "The field is not UTF-8 text.") from None

    def _on_end(self) -> None:
        self._complete = True


def _bad_field(field: str, detail: str) -> ProblemError:
    shown = re.sub(r"[^\w.-]", "?", field)[:100]
    return ProblemError(
        "invalid_request", f"{shown}: {detail}", errors=[FieldProblem(pointer=f"#/{shown}", detail=detail)]
    )
