"""The two kinds of file storage: a folder of this machine, or a bucket of an S3-compatible store."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import urlsplit

import obstore
from obstore.store import LocalStore, ObjectStore, S3Store

from workers.settings.errors import SetupError

Method = Literal["GET", "PUT"]
DELETE_BATCH = 1000
# Buckets are read in requests of so many bytes, so that a slow reader keeps none of them open.
WINDOW_BYTES = 4 * 2**20
WHOLE = 2**62


class Place(Protocol):
    """What differs between the kinds of storage; `workers.store.files.FileStore` does the rest."""

    store: ObjectStore
    window_bytes: int

    async def delete_folder(self, folder: str, keep: str | None) -> None:
        """Delete all below the folder, except the sub-folder named ``keep``."""

    async def signed_urls(self, method: Method, keys: Sequence[str], valid_s: int) -> Sequence[str] | None:
        """URLs with which anybody may read or write these keys; None if the place has no such URLs."""

    async def link(self, key: str, target: Path) -> bool:
        """Give the file a second name at ``target``; False where that cannot be."""

    def links_into(self, folder: Path) -> bool:
        """Whether `link` can be expected to work there."""

    def attributes(self, media_type: str | None) -> dict[str, str] | None:
        """Attributes to store with a file, for clients that read it directly from the place."""


class LocalPlace:
    """A folder, created if it is missing; raises `SetupError` if it cannot be used."""

    window_bytes = WHOLE

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self.store: ObjectStore = LocalStore(str(self.root))
        except OSError as error:
            raise SetupError(
                "storage_unusable",
                f"Cannot use {root}: {error}. Set BIRESNERF_DATA_DIR to a writable folder.",
            ) from error

    async def delete_folder(self, folder: str, keep: str | None) -> None:
        """Remove folders instead of listed files, which also deletes partial files of killed uploads."""
        await asyncio.to_thread(self._remove, self.root / folder, keep)

    @staticmethod
    def _remove(folder: Path, keep: str | None) -> None:
        for child in folder.iterdir() if folder.is_dir() else ():
            if child.name == keep:
                continue
            if child.is_dir():
                shutil.rmtree(child, ignore_errors=True)
            else:
                child.unlink(missing_ok=True)
        if keep is None and folder.is_dir():
            shutil.rmtree(folder, ignore_errors=True)

    async def signed_urls(self, method: Method, keys: Sequence[str], valid_s: int) -> Sequence[str] | None:
        """None: only we serve a folder."""
        return None

    async def link(self, key: str, target: Path) -> bool:
        """False on another file system, for a link, and for a key that the store writes otherwise."""
        return await asyncio.to_thread(self._linked, self.root / key, target)

    @staticmethod
    def _linked(source: Path, target: Path) -> bool:
        try:
            if source.is_symlink():  # it would be linked itself
                return False
            os.link(source, target)
        except OSError:
            return False
        return True

    def links_into(self, folder: Path) -> bool:
        """On the same disk."""
        return folder.stat().st_dev == self.root.stat().st_dev

    def attributes(self, media_type: str | None) -> dict[str, str] | None:
        """None: a folder keeps bytes only."""
        return None


@dataclass(frozen=True)
class Bucket:
    """A bucket and its credentials. Without keys, those of the environment are used (``AWS_…``, instance roles)."""

    name: str
    prefix: str = ""
    endpoint: str | None = None
    public_endpoint: str | None = None
    region: str = "us-east-1"
    access_key_id: str | None = None
    secret_access_key: str | None = None

    @classmethod
    def at(cls, url: str, **rest: Any) -> Bucket:
        """The bucket of ``s3://bucket/prefix``; raises `SetupError`."""
        parts = urlsplit(url)
        if parts.scheme != "s3" or not parts.hostname or parts.query or "@" in parts.netloc:
            raise SetupError(
                "storage_url_unknown",
                f"BIRESNERF_STORAGE_URL is {parts.scheme}://…; it must be s3://bucket or s3://bucket/prefix.",
            )
        return cls(parts.netloc, parts.path.strip("/"), **rest)


class BucketPlace:
    """A bucket of an S3-compatible store; not contacted before the first use.

    Args:
        patience_s: how long a request is retried while the store does not answer.
    """

    window_bytes = WINDOW_BYTES

    def __init__(self, bucket: Bucket, patience_s: float) -> None:
        self._bucket, self._patience_s = bucket, patience_s
        self.store: ObjectStore = self._opened(bucket.endpoint)
        self._signer = self._opened(bucket.public_endpoint or bucket.endpoint)

    def _opened(self, endpoint: str | None) -> S3Store:
        bucket = self._bucket
        config: dict[str, Any] = {
            "endpoint": endpoint,
            "access_key_id": bucket.access_key_id,
            "secret_access_key": bucket.secret_access_key,
        }
        plain = bool(endpoint and endpoint.startswith("http://"))
        try:
            return S3Store(
                bucket.name,
                prefix=bucket.prefix or None,
                region=bucket.region,
                virtual_hosted_style_request=False,
                client_options={"allow_http": plain, "connect_timeout": "5s", "timeout": "60s"},
                retry_config={"max_retries": 20, "retry_timeout": timedelta(seconds=self._patience_s)},
                **{name: value for name, value in config.items() if value is not None},
            )
        except (obstore.exceptions.BaseError, ValueError) as error:
            raise SetupError("storage_unusable", f"Cannot use the bucket {bucket.name}: {error}") from error

    async def delete_folder(self, folder: str, keep: str | None) -> None:
        """Delete listed files. Parts of killed uploads expire by the bucket's lifecycle rule."""
        kept = None if keep is None else f"{folder}/{keep}/"
        async for batch in obstore.list(self.store, prefix=folder, chunk_size=DELETE_BATCH):
            keys = [meta["path"] for meta in batch]
            doomed = [key for key in keys if kept is None or not key.startswith(kept)]
            if doomed:
                await obstore.delete_async(self.store, doomed)

    async def signed_urls(self, method: Method, keys: Sequence[str], valid_s: int) -> Sequence[str] | None:
        """Signed locally with the secret key, without a request."""
        return await obstore.sign_async(self._signer, method, keys, timedelta(seconds=valid_s))

    async def link(self, key: str, target: Path) -> bool:
        """False: nothing of a bucket is on this machine."""
        return False

    def links_into(self, folder: Path) -> bool:
        """False."""
        return False

    def attributes(self, media_type: str | None) -> dict[str, str] | None:
        """Always an attachment: users' files must not run as pages of the store's origin."""
        return {
            "Content-Type": media_type or "application/octet-stream",
            "Content-Disposition": "attachment",
        }
