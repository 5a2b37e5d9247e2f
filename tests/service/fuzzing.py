"""Made-up requests against a real service: `python -m tests.service.fuzzing --seconds 600 --mutated 100000`.

schemathesis reads the OpenAPI document and sends what fits it and what does not, in chains too (a dataset made
here is filled there, deleted, asked for again). A server error, an answer that the document does not declare, or
one that does not fit its schema ends the command with 1. So does a server error, or a path of the server in an answer,
among the many requests with hostile values that follow (`mutated_requests`).
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx

from biresnerf.data.synthetic.scene import write_synthetic_scene
from tests.service.conftest import (
    PROGRAM,
    Running,
    finished,
    ready_dataset,
    running_service,
    short_folder,
    submit,
)
from tests.service.mutated_requests import SHOWN, Generator, Seen, send_all

ROOT = Path(__file__).parents[2]
# Not ensure_resource_availability: it mistakes ids that an earlier phase has deleted for new ones.
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
    "allow_header_conformance",
    "use_after_free",
    "ignored_auth",
)
# One client asks faster here than a service lets it.
UNLIMITED = {"key_requests_per_s": 1e6, "key_requests_burst": 10**6}
# Ids that exist, for what only reads: the chances to guess one are nil. What deletes gets made-up ones and,
# in chains, those of its own making.
_CONFIG = """
hooks = "{hooks}"

[[operations]]
include-method = ["GET", "HEAD"]
include-path-regex = "jobs/"
parameters = {{ job_id = "{job_id}", name = "report.json" }}

[[operations]]
include-method = ["GET", "HEAD"]
include-path-regex = "datasets/"
parameters = {{ dataset_id = "{dataset_id}" }}

[[operations]]
include-method = ["POST"]
include-path-regex = "/(fork|exports|shares)$"
parameters = {{ job_id = "{job_id}" }}
"""


def admin_key(service: Running) -> str:
    """A key that may do everything; from then on nothing works without one."""
    command = [sys.executable, "-m", "biresnerf.command_line", "keys", "create", "fuzz", "--scope", "admin"]
    made = subprocess.run(
        [*command, "--json", "--data-dir", str(service.data_dir)], capture_output=True, check=True
    )
    key: str = json.loads(made.stdout)["key"]
    return key


def fuzz(service: Running, folder: Path, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """Runs schemathesis against the service, which has a finished job by then."""
    url, access = service.url, {"Authorization": f"Bearer {admin_key(service)}"}
    scene = folder / "scene"
    write_synthetic_scene(scene, n_views=6, size=32, seed=1)
    with httpx.Client(base_url=url, timeout=60.0, headers=access) as http:
        dataset_id = ready_dataset(http, scene)
        job_id = finished(http, submit(http, dataset_id)["id"])["id"]
    config = folder / "schemathesis.toml"
    hooks = ROOT / "tests" / "service" / "fuzz_hooks.py"
    config.write_text(_CONFIG.format(hooks=hooks, job_id=job_id, dataset_id=dataset_id))
    command = ["schemathesis", "--config-file", str(config), "run", f"{url}/openapi.json"]
    options = [
        "-H",
        f"Authorization: {access['Authorization']}",
        "--checks",
        ",".join(CHECKS),
        "--request-timeout",
        "70",
        "--suppress-health-check",
        "all",
    ]
    return subprocess.run(
        [str(Path(sys.executable).parent / command[0]), *command[1:], *options, *arguments],
        cwd=folder,  # it keeps what it found where it runs
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


def fuzzed(*arguments: str) -> tuple[subprocess.CompletedProcess[str], str]:
    """A service of its own fuzzed with these arguments; also what the service found worth a warning."""
    with (
        TemporaryDirectory() as folder,
        short_folder() as data,
        running_service(data, job_command=(sys.executable, str(PROGRAM)), **UNLIMITED) as service,
    ):
        done = fuzz(service, Path(folder), list(arguments))
        log = service.log.read_text()
    return done, "\n".join(line for line in log.splitlines() if " INFO " not in line)


def mutated(requests: int, seconds: float, seed: int) -> tuple[Seen, str]:
    """Sends so many requests with hostile values to a service of its own; also what it found worth a warning."""
    with (
        TemporaryDirectory() as folder,
        short_folder() as data,
        running_service(data, job_command=(sys.executable, str(PROGRAM)), **UNLIMITED) as service,
    ):
        access = {"Authorization": f"Bearer {admin_key(service)}"}
        write_synthetic_scene(Path(folder) / "scene", n_views=6, size=32, seed=1)
        with httpx.Client(base_url=service.url, timeout=60.0, headers=access) as http:
            dataset = ready_dataset(http, Path(folder) / "scene")
            job = finished(http, submit(http, dataset)["id"])["id"]
            open_one = http.post("/v1/datasets", json={}).json()["id"]
            known = {
                "dataset_id": [dataset, open_one],
                "job_id": [job],
                "name": ["report.json", "log.txt"],
                "path": ["images/0.png", "transforms.json"],
            }
            document = http.get("/openapi.json").json()
        generator = Generator(document, known, access["Authorization"], random.Random(seed))
        secrets = (str(service.data_dir), "Traceback", "site-packages", "psycopg")
        port = int(service.url.rsplit(":", 1)[1])
        seen = asyncio.run(send_all(port, generator, secrets, requests=requests, seconds=seconds))
        log = service.log.read_text()
    return seen, "\n".join(line for line in log.splitlines() if " INFO " not in line)


def main() -> int:
    """Returns the exit status of schemathesis, or 1 where a request with hostile values broke something."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--mutated", type=int, default=100_000, help="Requests with hostile values; 0: none.")
    parser.add_argument("--mutated-seconds", type=float, default=3600.0, help="At most for these.")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    status = 0
    if arguments.seconds:
        done, log = fuzzed("--max-time", str(arguments.seconds), "--seed", str(arguments.seed))
        sys.stdout.write(f"{log}\n{done.stdout}{done.stderr}")
        status = done.returncode
    if arguments.mutated:
        began = time.monotonic()
        seen, log = mutated(arguments.mutated, arguments.mutated_seconds, arguments.seed)
        took = time.monotonic() - began
        told = [log, f"{seen.sent} requests in {took:.0f} s to {len(seen.operations)} operations and heads"]
        told += [f"answers: {dict(sorted(seen.statuses.items()))}", *seen.broken[:SHOWN]]
        sys.stdout.write("\n".join(told) + "\n")
        status = status or int(bool(seen.broken))
    return status


if __name__ == "__main__":
    sys.exit(main())
