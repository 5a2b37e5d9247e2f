"""A Python client of the service: `Client` blocks, `AsyncClient` is asynchronous. Does not load torch.

    with Client("http://127.0.0.1:8000") as client:
        job = client.submit(Path("photos"), {"preset": "fast"})
        job = client.wait(job.id, on_progress=lambda job: print(job.stage, job.progress.fraction))
        client.download_all(job.id, Path("out"))

Needs the extra ``client``. Answers are the models of `biresnerf.wire`, which the service uses too.
"""

from biresnerf.client.blocking import Client
from biresnerf.client.bucket_files import bucket_files, bucket_target
from biresnerf.client.client import AsyncClient
from biresnerf.client.errors import JobFailed, JobNotOver, ServiceError
from biresnerf.client.events import StreamEvent
from biresnerf.client.submission import Sending
from biresnerf.client.uploads import LocalFile
from biresnerf.wire.datasets import FileAddress
from biresnerf.wire.deliveries import DeliverTo

__all__ = [
    "AsyncClient",
    "Client",
    "DeliverTo",
    "FileAddress",
    "JobFailed",
    "JobNotOver",
    "LocalFile",
    "Sending",
    "ServiceError",
    "StreamEvent",
    "bucket_files",
    "bucket_target",
]
