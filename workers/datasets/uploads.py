"""Uploads in progress: bytes arrive in pieces, over any number of connections, processes and hosts.

Each piece is stored, then counted by one conditional UPDATE: of two connections that write at the same offset, one
wins. Counted bytes survive a failure of connection, process or host: none are held in memory or on local disk.
"""

from __future__ import annotations

import contextlib
import secrets
import uuid
from collections.abc import AsyncIterable, AsyncIterator, Iterator, Sequence

from psycopg.types.json import Jsonb

from biresnerf.errors import InputError
from biresnerf.wire.datasets import FileAddress, UploadKind, UploadState
from biresnerf.wire.problems import JobError
from workers.database.database import Connection, Database, OwnedStore
from workers.database.ids import new_id
from workers.database.losses import LOSSES_MAX, LostTooOften, at_an_end, counted
from workers.datasets.dataset_rows import MINE, file_key, require_open
from workers.jobs.quotas import require_byte_quota
from workers.records import Upload, record_from_row
from workers.settings.errors import Conflict, LimitReached, NotFound
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import discard
from workers.webhooks.outbound import Policy, checked_url

# Memory for unstored pieces of all uploads of this process: the more uploads, the smaller the pieces of each.
PIECES_BYTES = 256 * 2**20
PIECE_MAX_BYTES = 4 * 2**20
PIECE_MIN_BYTES = 2**18
EXPIRE_BATCH = 100

_NEVER_STORED = JobError(
    code="storage_unavailable",
    detail="The upload arrived whole, but storing its content failed again and again.",
    hint="Send it again; the operator's log says what was wrong.",
    retryable=True,
)
_NEVER_FETCHED = JobError(
    code="fetch_failed",
    detail="No dispatcher fetched the file in time.",
    hint="Ask the operator whether one runs, and have it fetched again.",
    retryable=True,
)
_UPLOAD = "SELECT uploads.* FROM uploads JOIN datasets ON datasets.id = uploads.dataset_id"


class UploadStore(OwnedStore):
    """Uploads in the database, their pieces in the file store. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` if database or store does not answer.
    """

    def __init__(self, database: Database, files: FileStore, settings: Settings) -> None:
        super().__init__(database)
        self._files, self._settings = files, settings
        self._appending = [0]  # a list, which the stores of all tenants share

    async def create(
        self,
        dataset_id: str,
        kind: UploadKind,
        size: int,
        *,
        path: str | None = None,
        sha256: str | None = None,
    ) -> Upload:
        """A new, empty upload of ``size`` bytes.

        Raises `NotFound`, `Conflict` (``dataset_not_open``), `LimitReached` (``body_too_large``,
        ``too_many_files``), `InputError` (``unsafe_path``).
        """
        async with self._database.transaction() as connection:
            await self._require_places(connection, dataset_id, 1, size)
            state: UploadState = "receiving" if size or kind == "signed" else "received"
            return await self._insert(connection, dataset_id, kind, size, path, sha256, state=state)

    async def fetch(self, dataset_id: str, files: Sequence[FileAddress]) -> tuple[Upload, ...]:
        """Create an upload for each address, for a dispatcher to fetch; none if one is refused.

        Raises as `create` does, and `InputError` (``address_refused``).
        """
        policy, hosts = Policy.of_files(self._settings), []
        for number, file in enumerate(files):
            try:
                hosts.append(checked_url(file.url, policy).host)
            except InputError as error:
                raise InputError.of(error.fault, where=file.path or f"files/{number}") from None
        async with self._database.transaction() as connection:
            await self._require_places(connection, dataset_id, len(files), sum(f.size or 0 for f in files))
            made = []
            for file, host in zip(files, hosts, strict=True):
                kind: UploadKind = "archive" if file.path is None else "file"
                made.append(
                    await self._insert(
                        connection, dataset_id, kind, file.size or 0, file.path, file.sha256, host=host
                    )
                )
                await connection.execute(
                    "INSERT INTO upload_fetches (id, url, size) VALUES (%s, %s, %s)",
                    (made[-1].id, file.url, file.size),
                )
            await connection.execute("SELECT pg_notify('biresnerf_webhooks', '')")
        return tuple(made)

    async def _require_places(self, connection: Connection, dataset_id: str, count: int, size: int) -> None:
        await require_open(connection, dataset_id, self._tenant)
        await require_byte_quota(connection, dataset_id, size)
        n = await connection.value("SELECT count(*) FROM uploads WHERE dataset_id = %s", dataset_id)
        if n + count > self._settings.max_files:
            most = self._settings.max_files
            raise LimitReached("too_many_files", f"A dataset has at most {most} uploads at a time.")

    async def _insert(
        self,
        connection: Connection,
        dataset_id: str,
        kind: UploadKind,
        size: int,
        path: str | None,
        sha256: str | None,
        *,
        state: UploadState = "receiving",
        host: str | None = None,
    ) -> Upload:
        require_size(self._settings, kind, size)
        upload_id = new_id("up")
        folder = f"datasets/{dataset_id}/uploads/{upload_id}"
        if path is not None:
            file_key(folder, path)
        row = await connection.only_row(
            "INSERT INTO uploads (id, dataset_id, kind, path, size, sha256, folder, state, host, expires_at)"
            " VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, clock_timestamp() + make_interval(secs => %s))"
            " RETURNING *",
            *(upload_id, dataset_id, kind, path, size, sha256, folder, state, host),
            self._settings.upload_expiry_s,
        )
        return record_from_row(Upload, row)

    async def get(self, upload_id: str) -> Upload:
        """The upload; raises `NotFound` (also where it expired)."""
        async with self._database.transaction() as connection:
            return await self._required(connection, upload_id)

    async def of_dataset(self, dataset_id: str) -> tuple[Upload, ...]:
        """The dataset's uploads that are not yet stored, oldest first."""
        rows = await self._database.fetch(
            _UPLOAD + f" WHERE dataset_id = %s AND {MINE} AND uploads.state <> 'stored' ORDER BY uploads.id",
            *(dataset_id, self._tenant),
        )
        return tuple(record_from_row(Upload, row) for row in rows)

    async def append(self, upload_id: str, start: int, chunks: AsyncIterable[bytes]) -> Upload:
        """Append the stream at byte ``start``; returns the upload with its new ``received``.

        If the stream breaks, the bytes that arrived are kept and the error is raised.

        Raises `NotFound`, `Conflict` (``offset_mismatch``: ``start`` is not the next byte, or another connection
        was faster), `LimitReached` (``body_too_large``, ``storage_full``).
        """
        upload = await self.get(upload_id)
        if upload.received != start or upload.kind == "signed" or upload.host is not None:
            raise _offset_mismatch(upload)
        gathered = bytearray()
        with self._sharing():
            try:
                async for chunk in chunks:
                    gathered += chunk
                    if upload.received + len(gathered) > upload.size:
                        gathered.clear()
                        raise LimitReached("body_too_large", f"The upload has only {upload.size} bytes.")
                    if len(gathered) >= self._piece_bytes():
                        piece, gathered = bytes(gathered), bytearray()
                        upload = await self._add_piece(upload, piece)
            finally:
                if gathered:
                    upload = await self._add_piece(upload, bytes(gathered))
        return upload

    @contextlib.contextmanager
    def _sharing(self) -> Iterator[None]:
        self._appending[0] += 1
        try:
            yield
        finally:
            self._appending[0] -= 1

    def _piece_bytes(self) -> int:
        return min(PIECE_MAX_BYTES, max(PIECE_MIN_BYTES, PIECES_BYTES // self._appending[0]))

    async def _add_piece(self, upload: Upload, piece: bytes) -> Upload:
        start, end = upload.received, upload.received + len(piece)
        # A unique name: a slower connection never touches the piece of a faster one.
        key = f"{upload.folder}/{start:014d}-{secrets.token_hex(4)}"
        await self._files.put_bytes(key, piece)
        async with self._database.transaction() as connection:
            cursor = await connection.execute(
                "UPDATE uploads SET received = %s, state = CASE WHEN size = %s THEN 'received' ELSE state END,"
                " expires_at = clock_timestamp() + make_interval(secs => %s)"
                " WHERE id = %s AND received = %s AND state = 'receiving'",
                (end, end, self._settings.upload_expiry_s, upload.id, start),
            )
            if cursor.rowcount:
                await connection.execute(
                    "INSERT INTO upload_pieces (upload_id, start, size, key) VALUES (%s, %s, %s, %s)",
                    (upload.id, start, len(piece), key),
                )
                return await self._required(connection, upload.id)
        await self._files.delete(key)
        raise _offset_mismatch(await self.get(upload.id))

    async def content(self, upload: Upload) -> AsyncIterator[bytes]:
        """All bytes received, in order.

        Raises `Conflict` (``upload_incomplete``) if the store has lost some, as after a restore.
        """
        pieces = await self._database.fetch(
            "SELECT key, size FROM upload_pieces WHERE upload_id = %s ORDER BY start", upload.id
        )
        for piece in pieces:
            try:
                async for chunk in self._files.read(piece["key"]):
                    yield chunk
            except NotFound:
                raise Conflict("upload_incomplete", "Bytes of the upload are lost; send it again.") from None

    async def take(self, upload_id: str, token: uuid.UUID) -> bool:
        """Take or renew the lease to add a received upload to its dataset; it expires if the process dies."""
        rows = await self._database.fetch(
            "UPDATE uploads SET take_token = %s, take_until = clock_timestamp() + make_interval(secs => %s)"
            " WHERE id = %s AND state = 'received'"
            " AND (take_token = %s OR take_token IS NULL OR take_until < clock_timestamp()) RETURNING id",
            *(token, 2 * self._settings.beat_s, upload_id, token),
        )
        return bool(rows)

    @contextlib.asynccontextmanager
    async def unpacking(self, upload_id: str | None) -> AsyncIterator[None]:
        """Wraps the unpacking, which may kill this process; raises `InputError` if it has killed too many."""
        try:
            async with counted(self._database, "uploads.losses", upload_id):
                yield
        except LostTooOften:
            detail = f"{LOSSES_MAX} processes were lost while they unpacked the archive."
            hint = "Check for damaged or very large files."
            raise InputError("validation_resources", detail, hint=hint) from None

    async def give_back(self, upload_id: str, token: uuid.UUID, *, failed: bool) -> None:
        """Give the lease back. After a failure, `not_imported` lists the upload again after half of its age.

        At the latest after 15 minutes; `take` by its id works at once.
        """
        await at_an_end(
            self._database,
            "UPDATE uploads SET take_token = NULL, take_until = CASE WHEN %s THEN"
            " clock_timestamp() + least(interval '15 min', greatest(interval '10 s',"
            " (clock_timestamp() - expires_at + make_interval(secs => %s)) / 2)) END"
            " WHERE id = %s AND state = 'received' AND take_token = %s",
            *(failed, self._settings.upload_expiry_s, upload_id, token),
        )

    async def conclude(self, upload_id: str, token: uuid.UUID, error: JobError | None) -> None:
        """``received`` becomes ``stored``, or ``rejected`` with the error; the pieces go to the trash."""
        async with self._database.transaction() as connection:
            row = await connection.row(
                "UPDATE uploads SET state = %s, error = %s, take_token = NULL, take_until = NULL"
                " WHERE id = %s AND state = 'received' AND take_token = %s RETURNING folder",
                "stored" if error is None else "rejected",
                None if error is None else Jsonb(error.model_dump()),
                upload_id,
                token,
            )
            if row is not None:
                await connection.execute("DELETE FROM upload_pieces WHERE upload_id = %s", (upload_id,))
                await discard(connection, row["folder"])

    async def conclude_signed(self, upload_id: str, late_s: float) -> None:
        """Mark a file stored that the client sent to the bucket; its signed address stays valid for ``late_s``."""
        await self._database.fetch(
            "WITH done AS (UPDATE uploads SET state = 'stored', received = size"
            " WHERE id = %s AND kind = 'signed' AND state = 'receiving' RETURNING folder)"
            " INSERT INTO trash (prefix, not_before)"
            " SELECT folder, clock_timestamp() + make_interval(secs => %s) FROM done",
            *(upload_id, late_s),
        )

    async def not_imported(self) -> tuple[str, ...]:
        """Ids of received uploads that no process is adding to their dataset."""
        rows = await self._database.fetch(
            "SELECT id FROM uploads WHERE state = 'received'"
            " AND coalesce(take_until < clock_timestamp(), true) ORDER BY created_at"
        )
        return tuple(row["id"] for row in rows)

    async def delete(self, upload_id: str) -> None:
        """Delete an upload in any state; raises `NotFound`. Files it added to the dataset stay."""
        async with self._database.transaction() as connection:
            await self._required(connection, upload_id)
            await connection.execute(
                "WITH gone AS (DELETE FROM uploads WHERE id = %s RETURNING folder)"
                " INSERT INTO trash (prefix) SELECT folder FROM gone",
                (upload_id,),
            )

    async def expire(self) -> int:
        """Delete uploads that received nothing for ``upload_expiry_s``; returns how many.

        One that could not be fetched or stored is rejected first, so that its owner sees why.
        """
        await self._give_up()
        rows = await self._database.fetch(
            "WITH gone AS (DELETE FROM uploads WHERE id IN (SELECT id FROM uploads"
            " WHERE expires_at < clock_timestamp() AND state <> 'received'"
            " AND (state <> 'receiving' OR host IS NULL) ORDER BY expires_at LIMIT %s"
            " FOR UPDATE SKIP LOCKED) RETURNING folder)"
            " INSERT INTO trash (prefix) SELECT folder FROM gone RETURNING id",
            EXPIRE_BATCH,
        )
        return len(rows)

    async def _give_up(self) -> None:
        await self._database.fetch(
            "WITH given_up AS (UPDATE uploads SET state = 'rejected', take_token = NULL, take_until = NULL,"
            " error = CASE state WHEN 'received' THEN %s ELSE %s END,"
            " expires_at = clock_timestamp() + make_interval(secs => %s) WHERE id IN (SELECT id FROM uploads"
            " WHERE expires_at < clock_timestamp() AND (state = 'received' OR state = 'receiving' AND host IS NOT NULL)"
            " AND (take_token IS NULL OR take_until < clock_timestamp()) LIMIT %s FOR UPDATE SKIP LOCKED)"
            " RETURNING id, folder),"
            " fetches AS (DELETE FROM upload_fetches USING given_up WHERE upload_fetches.id = given_up.id),"
            " pieces AS (DELETE FROM upload_pieces USING given_up WHERE upload_id = given_up.id)"
            " INSERT INTO trash (prefix) SELECT folder FROM given_up",
            *(Jsonb(_NEVER_STORED.model_dump()), Jsonb(_NEVER_FETCHED.model_dump())),
            *(self._settings.upload_expiry_s, EXPIRE_BATCH),
        )

    async def _required(self, connection: Connection, upload_id: str) -> Upload:
        sql = _UPLOAD + f" WHERE uploads.id = %s AND {MINE}"
        row = await connection.required_row(f"No upload {upload_id}.", sql, upload_id, self._tenant)
        return record_from_row(Upload, row)


def require_size(settings: Settings, kind: UploadKind, size: int) -> None:
    """Raises `LimitReached` (``body_too_large``)."""
    limit = settings.max_archive_bytes if kind == "archive" else settings.max_file_bytes
    if size > limit:
        raise LimitReached("body_too_large", f"At most {limit} bytes are accepted at once, not {size}.")


def _offset_mismatch(upload: Upload) -> Conflict:
    return Conflict("offset_mismatch", f"The upload goes on at byte {upload.received}, state {upload.state}.")
