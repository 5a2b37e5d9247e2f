"""A Python client of the service, blocking (`Client`) and asynchronous (`AsyncClient`). Loads no torch.

    with Client("http://127.0.0.1:8000") as client:
        job = client.submit(Path("photos"), {"preset": "fast"})
        job = client.wait(job.id, on_progress=lambda job: print(job.stage, job.progress.fraction))
        client.download_all(job.id, Path("out"))

Needs the extra ``client`` (httpx). Answers are the models of `biresnerf.wire`, which the service uses too.
"""

from biresnerf.client.asynchronous import AsyncClient
from biresnerf.client.blocking import Client
from biresnerf.client.errors import JobFailed, JobNotOver, ServiceError
from biresnerf.client.events import Happening
from biresnerf.client.sending import LocalFile
from biresnerf.client.submitting import Sending

__all__ = [
    "AsyncClient",
    "Client",
    "Happening",
    "JobFailed",
    "JobNotOver",
    "LocalFile",
    "Sending",
    "ServiceError",
]
