"""Files of a bucket, and places in it, as addresses that are signed here: no service sees the caller's credentials."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from biresnerf.errors import InputError, needs_extra
from biresnerf.wire.datasets import FileAddress
from biresnerf.wire.deliveries import DeliverTo
from biresnerf.wire.safe_paths import checked_path, is_litter

SCHEME = "s3://"
# To read, and to write once a job is over that may have to wait.
VALID_S, TARGET_VALID_S = 6 * 3600, 24 * 3600


def bucket_files(address: str, *, valid_s: int = VALID_S) -> tuple[FileAddress, ...]:
    """The files below ``s3://bucket/prefix``, or the one archive of that name, as addresses that are good for a while.

    Credentials, region and endpoint are those of boto3: AWS_... variables, profiles, the host's role.

    Args:
        valid_s: how long the addresses can be used, at most a week; less where the credentials end before.

    Raises:
        InputError: ``extra_missing``, ``bucket_unreadable``, ``unsafe_path``.
    """
    bucket, _, prefix = address.removeprefix(SCHEME).partition("/")
    folder = prefix.rstrip("/") + "/" if prefix else ""
    with _told(address):
        client = _client(bucket)
        pages = client.get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=prefix)
        sizes = {item["Key"]: int(item["Size"]) for page in pages for item in page.get("Contents", ())}

        def signed(key: str) -> str:
            asked = {"Bucket": bucket, "Key": key}
            return str(client.generate_presigned_url("get_object", Params=asked, ExpiresIn=valid_s))

        if prefix in sizes and prefix != folder:
            return (FileAddress(url=signed(prefix), size=sizes[prefix]),)
        names = [
            key for key in sizes if key.startswith(folder) and not key.endswith("/") and not is_litter(key)
        ]
        paths = {key: checked_path(key.removeprefix(folder)) for key in names}
        found = tuple(FileAddress(url=signed(key), path=paths[key], size=sizes[key]) for key in names)
    if not found:
        raise InputError("bucket_unreadable", "There are no files.", where=address)
    return found


def bucket_target(address: str, *, valid_s: int = TARGET_VALID_S) -> DeliverTo:
    """Where the service sends a job's files as one zip: ``s3://bucket/name.zip``, or ``result.zip`` below a prefix.

    Raises as `bucket_files` does.
    """
    bucket, _, key = address.removeprefix(SCHEME).partition("/")
    if not key.endswith(".zip"):
        key = "/".join(filter(None, [key.rstrip("/"), "result.zip"]))
    with _told(address):
        asked = {"Bucket": bucket, "Key": key}
        url = _client(bucket).generate_presigned_url("put_object", Params=asked, ExpiresIn=valid_s)
    return DeliverTo(archive=url)


def _client(bucket: str) -> Any:
    """A client that signs for the bucket's own region: elsewhere its addresses are not accepted."""
    import boto3
    from botocore.config import Config

    client = boto3.client("s3", config=Config(signature_version="s3v4"))
    answer = client.head_bucket(Bucket=bucket)["ResponseMetadata"]
    region = answer["HTTPHeaders"].get("x-amz-bucket-region", client.meta.region_name)
    return boto3.client("s3", region_name=region, config=Config(signature_version="s3v4"))


@contextmanager
def _told(address: str) -> Iterator[None]:
    """Raise `InputError` for faults of credentials, network and bucket."""
    with needs_extra("s3"):
        from botocore.exceptions import BotoCoreError, ClientError
    try:
        yield
    except (BotoCoreError, ClientError) as error:
        detail = f"{str(error).rstrip('.')}."
        hint = "Check credentials, region and endpoint."
        raise InputError("bucket_unreadable", detail, where=address, hint=hint) from None
