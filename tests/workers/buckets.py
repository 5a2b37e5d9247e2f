"""Two independent S3 servers for tests: moto (Python) and s3rver (JavaScript), each with a fresh bucket."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from botocore.config import Config

from workers.store.file_places import Bucket

S3RVER = "s3rver@3.7.1"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "biresnerf-tests"
START_S = 20.0


@contextlib.contextmanager
def moto_server() -> Iterator[str]:
    """Address of a moto server in this process; keys are not checked."""
    from moto.server import ThreadedMotoServer  # loads most of AWS: only where one is started

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        yield f"http://{host}:{port}"
    finally:
        server.stop()


@contextlib.contextmanager
def s3rver_server() -> Iterator[str]:
    """Address of an s3rver process; its one key is ``S3RVER``. Skips the test where it cannot be had."""
    program = _s3rver_program()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            ["node", str(program), "--directory", folder, "--address", "127.0.0.1", "--port", str(port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            _wait_for(port, process)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.kill()
            process.wait()


def _s3rver_program() -> Path:
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are missing: the contract is not run against s3rver")
    folder = CACHE / S3RVER
    program = folder / "node_modules/s3rver/bin/s3rver.js"
    if not program.exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(folder), S3RVER]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        if done.returncode != 0:
            pytest.skip(f"npm cannot install {S3RVER}: {done.stderr.strip()[-300:]}")
    return program


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        time.sleep(0.05)
    raise RuntimeError("s3rver does not answer")


def fresh_bucket(endpoint: str) -> Bucket:
    """A new empty bucket; files go below a prefix of it."""
    bucket = Bucket(f"b{uuid.uuid4().hex}", "some/prefix", endpoint, None, "us-east-1", "S3RVER", "S3RVER")
    by_boto(bucket).create_bucket(Bucket=bucket.name)
    return bucket


def by_boto(bucket: Bucket):
    """Amazon's own client of the same bucket."""
    return boto3.client(
        "s3",
        endpoint_url=bucket.endpoint,
        region_name=bucket.region,
        aws_access_key_id=bucket.access_key_id,
        aws_secret_access_key=bucket.secret_access_key,
        config=Config(s3={"addressing_style": "path"}),
    )


def environment_of(bucket: Bucket) -> dict[str, str]:
    """The settings that name this bucket."""
    return {
        "storage_url": f"s3://{bucket.name}/{bucket.prefix}",
        "storage_endpoint": str(bucket.endpoint),
        "storage_access_key_id": str(bucket.access_key_id),
        "storage_secret_access_key": str(bucket.secret_access_key),
    }
