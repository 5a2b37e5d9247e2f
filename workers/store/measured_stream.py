"""A byte stream that is measured on its way into the store."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterable, AsyncIterator

from biresnerf.errors import InputError
from workers.settings.errors import LimitReached


class MeasuredStream:
    """Counts and hashes a stream as it passes. ``failure`` is the error that ended it, if any."""

    def __init__(self, key: str, chunks: AsyncIterable[bytes], limit: int, expected: str | None) -> None:
        self._key, self._limit, self._expected = key, limit, expected
        self._digest, self._size = hashlib.sha256(), 0
        self._chunks = aiter(chunks)
        self.ended = False
        self.failure: BaseException | None = None

    @property
    def sha256(self) -> str:
        return self._digest.hexdigest()

    async def first(self, size: int) -> bytes:
        """About the first ``size`` bytes; afterwards, `ended` says whether that was all."""
        head = bytearray()
        while len(head) <= size:
            chunk = await self._next()
            if chunk is None:
                break
            head += chunk
        return bytes(head)

    async def all_with(self, head: bytes) -> AsyncIterator[bytes]:
        """``head`` and the rest of the stream."""
        yield head
        try:
            while (chunk := await self._next()) is not None:
                yield chunk
        except BaseException as error:
            self.failure = error
            raise

    async def _next(self) -> bytes | None:
        try:
            chunk = bytes(await anext(self._chunks))
        except StopAsyncIteration:
            self.ended = True
            self._check_digest()
            return None
        self._size += len(chunk)
        if self._size > self._limit:
            raise LimitReached("body_too_large", f"{self._key} has more than {self._limit} bytes.")
        self._digest.update(chunk)
        return chunk

    def _check_digest(self) -> None:
        if self._expected is not None and self.sha256 != self._expected:
            raise InputError(
                "digest_mismatch",
                f"What arrived has SHA-256 {self.sha256}, announced was {self._expected}.",
                where=self._key.rpartition("/")[2],
                hint="Send the file again.",
            )
