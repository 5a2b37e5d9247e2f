"""Rows of the tables `datasets` and `dataset_files`, inside the caller's transaction."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from biresnerf.errors import InputError
from biresnerf.wire.datasets import DatasetState
from workers.database.database import Connection
from workers.records import DatasetFile
from workers.settings.errors import Conflict, LimitReached
from workers.settings.settings import Settings
from workers.store.files import StoredFile

DATASET = """
    SELECT datasets.*, coalesce(total.files, 0) AS files, coalesce(total.bytes, 0)::bigint AS bytes,
        CASE WHEN state = 'finalizing' AND check_of IS NOT NULL
            THEN jsonb_build_object('photos_read', check_photos, 'photos', check_of) END AS checked,
        ARRAY(SELECT entry ->> 'path'
            FROM jsonb_array_elements(datasets.manifest) WITH ORDINALITY AS listed(entry, place)
            WHERE NOT EXISTS (SELECT 1 FROM dataset_files AS file WHERE file.dataset_id = datasets.id
                AND file.path = entry ->> 'path' AND file.sha256 = coalesce(entry ->> 'sha256', file.sha256))
            ORDER BY place) AS missing
    FROM datasets LEFT JOIN LATERAL (SELECT count(*) AS files, sum(size) AS bytes
        FROM dataset_files WHERE dataset_id = datasets.id) AS total ON true"""
# The parameter is the store's tenant; None for all tenants.
MINE = "datasets.tenant = coalesce(%s, datasets.tenant)"
# A dataset that waits for its first job.
UNUSED = (
    "(state IN ('open', 'finalizing', 'ready')"
    " AND NOT EXISTS (SELECT 1 FROM dataset_jobs WHERE dataset_id = datasets.id))"
)
# Missing files of the manifest whose bytes the same tenant has sent before, with their key.
KNOWN = f"""
    SELECT DISTINCT ON (entry.path) entry.path, file.key, file.size, file.sha256
    FROM datasets, jsonb_to_recordset(datasets.manifest) AS entry(path text, size bigint, sha256 text)
    JOIN dataset_files AS file ON file.sha256 = entry.sha256 AND file.size = entry.size
    JOIN datasets AS other ON other.id = file.dataset_id
    WHERE datasets.id = %s AND {MINE} AND other.tenant = datasets.tenant AND NOT EXISTS (
        SELECT 1 FROM dataset_files AS own WHERE own.dataset_id = datasets.id AND own.path = entry.path)"""
# The file store keeps such names for uploads under way.
RESERVED_NAME = re.compile(r"#\d+$")


async def record_files(
    connection: Connection, dataset_id: str, stored: Mapping[str, StoredFile], upload_id: str | None
) -> tuple[list[DatasetFile], int]:
    """Add stored files, by path, to a dataset whose row is locked. Replaced files go to the trash.

    ``upload_id``: the upload that brought them. Returns the files, and how many replaced another.
    """
    paths, files = list(stored), list(stored.values())
    if upload_id is not None:
        await connection.execute(
            "UPDATE uploads SET brought = least(size, brought + %s) WHERE id = %s",
            (sum(file.size for file in files), upload_id),
        )
    replaced = await connection.execute(
        "WITH gone AS (DELETE FROM dataset_files WHERE dataset_id = %s AND path = ANY(%s) RETURNING path, key)"
        " INSERT INTO trash (prefix) SELECT left(key, length(key) - length(path) - 1) FROM gone",
        (dataset_id, paths),
    )
    recorded = await connection.rows(
        "INSERT INTO dataset_files (dataset_id, path, key, size, sha256)"
        " SELECT %s, * FROM unnest(%s::text[], %s::text[], %s::bigint[], %s::text[])"
        " RETURNING path, key, size, sha256, created_at",
        *(dataset_id, paths, [file.key for file in files]),
        *([file.size for file in files], [file.sha256 for file in files]),
    )
    await connection.execute("UPDATE datasets SET revision = revision + 1 WHERE id = %s", (dataset_id,))
    return [DatasetFile.model_validate(row) for row in recorded], replaced.rowcount


async def require_open(connection: Connection, dataset_id: str, tenant: str | None) -> None:
    """Locks the dataset's row; raises `NotFound`, `Conflict` (``dataset_not_open``)."""
    state = await lock_dataset(connection, dataset_id, tenant)
    if state != "open":
        raise Conflict("dataset_not_open", f"Dataset {dataset_id} is {state}; it takes no more files.")


async def require_places(
    connection: Connection,
    settings: Settings,
    dataset_id: str,
    paths: Sequence[str],
    size: int,
    *,
    overwrite: bool,
) -> int:
    """Check that ``paths`` may be added with ``size`` bytes in all; returns the bytes of the other files.

    Raises `Conflict` (``file_exists``), `LimitReached` (``too_many_files``, ``body_too_large``).
    """
    there = await connection.only_row(
        "SELECT count(*) FILTER (WHERE path <> ALL(%s)) AS files, min(path) FILTER (WHERE path = ANY(%s)) AS same,"
        " coalesce(sum(size) FILTER (WHERE path <> ALL(%s)), 0)::bigint AS bytes"
        " FROM dataset_files WHERE dataset_id = %s",
        *([*paths], [*paths], [*paths], dataset_id),
    )
    if there["same"] is not None and not overwrite:
        raise Conflict("file_exists", f"{there['same']} is there already.")
    if there["files"] + len(paths) > settings.max_files:
        raise LimitReached("too_many_files", f"A dataset holds at most {settings.max_files} files.")
    if there["bytes"] + size > settings.max_dataset_bytes:
        raise LimitReached("body_too_large", f"A dataset holds at most {settings.max_dataset_bytes} bytes.")
    return int(there["bytes"])


async def lock_dataset(connection: Connection, dataset_id: str, tenant: str | None) -> DatasetState:
    """Lock the dataset until the transaction ends, and return its state; raises `NotFound`."""
    sql = f"SELECT state FROM datasets WHERE id = %s AND {MINE} FOR UPDATE"
    row = await connection.required_row(f"No dataset {dataset_id}.", sql, dataset_id, tenant)
    state: DatasetState = row["state"]
    return state


def file_key(folder: str, path: str) -> str:
    """The key of a client's path; raises `InputError` (``unsafe_path``)."""
    parts = path.split("/")
    bad = any(part in ("", ".", "..") or len(part.encode()) > 255 for part in parts) or "\0" in path
    if bad or RESERVED_NAME.search(path):
        raise InputError("unsafe_path", "Not a usable file name.", where=path[:300], hint="Rename the file.")
    return f"{folder}/{path}"
