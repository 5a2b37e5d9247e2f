from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from service.app import create_app
from tests.service.conftest import LIMITS, Running, problem, ready_dataset, short_folder, submit
from tests.service.free_port import free_port
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.settings.settings import Settings

pytestmark = pytest.mark.server

HEAVY = ("torch", "numba", "pycolmap", "numpy", "PIL", "scipy", "biresnerf.data")


def test_the_options_are_a_schema_and_resolved_presets(http: httpx.Client) -> None:
    answer = http.get("/v1/options")
    body = answer.json()
    assert body["json_schema"] == RefineOptions.model_json_schema()
    assert set(body["presets"]) == set(PRESETS)
    for values in body["presets"].values():
        assert RefineOptions.model_validate(values).resolved("cpu") == ResolvedOptions.model_validate(values)
        assert values["steps"] is not None
    sizes = [body[key]["balanced"]["max_image_size"] for key in ("presets", "presets_on_gpu")]
    assert sizes == [200, 400]
    assert http.get("/v1/options", headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_info_tells_the_limits_that_hold(http: httpx.Client) -> None:
    body = http.get("/v1/info").json()
    assert {name: body["limits"][name] for name in LIMITS} == LIMITS
    assert set(body["job_counts"]) <= {"queued", "running", "succeeded", "failed", "cancelled"}


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/v1/nothing", 404, "not_found"),
        ("GET", "/v1/jobs/", 404, "not_found"),
        ("GET", "/v1/jobs/job_unknown", 404, "not_found"),
        ("GET", "/v1/jobs/%00", 404, "not_found"),
        ("GET", "/v1/datasets/ds_%C3%A4", 404, "not_found"),
        ("PATCH", "/v1/jobs", 405, "method_not_allowed"),
        ("POST", "/livez", 405, "method_not_allowed"),
        ("GET", "/v1/jobs?limit=many", 422, "invalid_request"),
        ("GET", "/v1/jobs?state=asleep", 422, "invalid_request"),
        ("GET", "/v1/jobs?label=nocolon", 422, "invalid_request"),
        ("GET", "/v1/jobs?cursor=abc", 400, "bad_cursor"),
        ("GET", "/v1/jobs?cursor=WyIwIiwgIlx1MDAwMCJd", 400, "bad_cursor"),
        ("GET", "/v1/jobs?label=a:%00", 422, "invalid_request"),
    ],
)
def test_every_wrong_address_or_question_is_a_problem(
    http: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    answer = http.request(method, path)
    body = problem(answer, status, code)
    if path == "/v1/jobs" and status == 405:
        assert answer.headers["allow"] == "GET, HEAD, POST"
    if code == "invalid_request":
        assert body["errors"][0]["pointer"].startswith("/query/")


def test_a_request_id_is_kept_if_it_is_harmless(http: httpx.Client) -> None:
    assert http.get("/livez", headers={"X-Request-ID": "trace-1"}).headers["x-request-id"] == "trace-1"
    assert (
        http.get("/livez", headers={"X-Request-ID": "a b<script>"}).headers["x-request-id"] != "a b<script>"
    )
    first, second = (http.get("/v1/nothing").json()["request_id"] for _ in range(2))
    assert first != second


def test_a_page_of_another_site_cannot_use_the_service(http: httpx.Client) -> None:
    form = {
        "files": {"archive": b"x"},
        "headers": {"Sec-Fetch-Site": "cross-site", "Origin": "http://evil.example"},
    }
    problem(http.post("/v1/jobs", **form), 403, "cross_site")
    assert http.get("/livez", headers=form["headers"]).status_code == 200
    assert "access-control-allow-origin" not in http.get("/livez", headers=form["headers"]).headers
    own = http.post("/v1/datasets", json={}, headers={"Sec-Fetch-Site": "same-origin"})
    assert own.status_code == 201


def test_a_page_of_another_port_of_this_machine_is_another_origin(http: httpx.Client) -> None:
    host = http.base_url.netloc.decode()
    for headers in (
        {"Sec-Fetch-Site": "same-site", "Origin": "http://127.0.0.1:1"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": f"http://{host}.evil.example"},
        {"Origin": "null"},
        {"Origin": "http://[::1"},
        {"Origin": "http://["},
        {"Origin": "http://a]b"},
        {"Origin": f"ftp://{host}"},
        {"Origin": f"//{host}"},
    ):
        refused = problem(http.post("/v1/datasets", json={}, headers=headers), 403, "cross_site")
        assert refused["where"] == "Origin"
    for headers in ({"Origin": f"http://{host}"}, {"Origin": f"https://{host}"}, {}):
        assert http.post("/v1/datasets", json={}, headers=headers).status_code == 201


@pytest.mark.parametrize(
    "host",
    [
        "evil.example#127.0.0.1",
        "localhost:1@evil.example",
        "127.0.0.1, evil.example",
        "[::1",
        "",
        "127.0.0.1/../x",
        *(".", "..", "-", "_", "a..b", "-a", "a-", "2130706433", "127.1", "1.2.3.256", "x" * 64),
        *("[.]", "[:::::::]", "[127.0.0.1]", "[]"),
    ],
)
def test_a_host_that_cannot_be_parsed_is_refused(http: httpx.Client, host: str) -> None:
    problem(http.get("/v1/jobs", headers={"Host": host}), 400, "malformed_request")


def test_text_that_the_database_cannot_hold_is_refused(http: httpx.Client) -> None:
    for body in ({"dataset_id": "\0"}, {"dataset_id": "ds_1", "labels": {"a\0": "b"}}):
        problem(http.post("/v1/jobs", json=body), 422, "invalid_request")


def test_the_docs_page_works_without_any_other_host(http: httpx.Client) -> None:
    page = http.get("/docs")
    assert page.status_code == 200
    assert "default-src 'self'" in page.headers["content-security-policy"]
    parts = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert {part.rsplit(".", 1)[-1] for part in parts} == {"js", "css", "png"}
    answer = http.get("/v1/jobs")
    assert answer.headers["content-security-policy"].startswith("default-src 'none'")
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cross-origin-resource-policy"] == "same-origin"
    start = http.get("/docs/start.js").text
    assert "://" not in page.text + start
    assert "validatorUrl: null" in start
    for part in parts:
        answer = http.get(f"/{part}")
        assert answer.status_code == 200
        assert len(answer.content) > 50
    # OpenAPI 3.1 is understood from version 5 on.
    assert re.search(r'"5\.\d+\.\d+"', http.get("/docs/swagger-ui-bundle.js").text)
    assert http.get("/openapi.json").json()["openapi"].startswith("3.1")
    problem(http.get("/docs/..%2fapp.py"), 404, "not_found")


def test_every_answer_is_declared(http: httpx.Client) -> None:
    schema = http.get("/openapi.json").json()
    identities = []
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            identities.append(operation["operationId"])
            statuses = set(operation["responses"])
            assert any(status.startswith("2") for status in statuses), (path, method)
            assert "500" in statuses, (path, method)
            asks_nobody = path in {"/livez", "/metrics", "/v1/options"} or method == "options"
            assert asks_nobody or "503" in statuses, (path, method)
            assert "{" not in path or "404" in statuses, (path, method)
            for status, answer in operation["responses"].items():
                if status >= "400":
                    reference = {"$ref": "#/components/schemas/Problem"}
                    assert list(answer["content"]) == ["application/problem+json"]
                    assert answer["content"]["application/problem+json"]["schema"] == reference
    assert len(identities) == len(set(identities))
    assert not [name for name in schema["components"]["schemas"] if "ValidationError" in name]
    references = set(re.findall(r'"#/components/schemas/([^"]+)"', httpx.Response(200, json=schema).text))
    assert references <= set(schema["components"]["schemas"])


def _command(process: psutil.Process) -> list[str]:
    """Its command line; empty once it has ended, as processes of the database do at any time."""
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def test_the_web_process_loads_nothing_heavy(
    service: Running, http: httpx.Client, done_job: dict[str, Any]
) -> None:
    """In the running process, after uploads, checks, a job and a download."""
    http.get(f"{done_job['links']['artifacts']}/renders/orbit.mp4")
    http.get("/docs")
    children = psutil.Process(service.process.pid).children(recursive=True)
    sizes = {}
    for name in ("service.server", "workers.queue.slot"):
        (process,) = [child for child in children if name in _command(child)]
        libraries = {Path(mapping.path).name for mapping in process.memory_maps()}
        assert not [
            library for library in libraries if re.search(r"torch|numba|colmap|openblas|llvm", library)
        ]
        sizes[name] = process.memory_info().rss / 2**20
    sys.stdout.write(
        "resident memory (MiB): " + ", ".join(f"{n} {size:.0f}" for n, size in sizes.items()) + "\n"
    )
    assert sizes["service.server"] < 200


def test_importing_the_application_imports_nothing_heavy() -> None:
    program = f"import sys, service.server; print([name for name in {HEAVY!r} if name in sys.modules])"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


def test_the_application_has_a_schema_without_a_database() -> None:
    assert create_app(Settings(database_url="postgresql://nowhere")).openapi()["info"]["title"] == "BiResNeRF"


def test_without_database_or_storage_the_service_says_503_and_comes_back(tmp_path: Path) -> None:
    with short_folder() as folder:
        postgres = EmbeddedPostgres(folder / "postgres")
        url, port = postgres.start(), free_port()
        migrate(url)
        settings = {"DATABASE_URL": url, "DATA_DIR": str(tmp_path / "data"), "PORT": str(port)}
        settings["METRICS_TOKEN"] = "figures-for-me"
        settings["ANSWER_S"] = "4"  # else each answer without a database comes after ten
        environment = {**os.environ, **{f"BIRESNERF_{name}": value for name, value in settings.items()}}
        server = subprocess.Popen([sys.executable, "-m", "service.server"], env=environment)
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as http:
                until_status(http, "/startupz", 200)
                until_status(http, "/readyz", 200)
                told = problem(http.get("/metrics"), 401, "metrics_token_required")
                assert "figures-for-me" not in str(told)
                scraper = {"Authorization": "Bearer figures-for-me"}
                assert "\nbiresnerf_database_up 1.0\n" in http.get("/metrics", headers=scraper).text
                postgres.stop()
                until_status(http, "/readyz", 503)
                assert http.get("/livez").status_code == 200
                assert (
                    http.get("/startupz").status_code == 200
                )  # it has started; how it is now is another question
                figures = http.get("/metrics", headers=scraper).text
                assert "\nbiresnerf_database_up 0.0\n" in figures
                assert 'route="/readyz",status="503"' in figures
                answer = http.get("/readyz")
                assert int(answer.headers["retry-after"]) > 0
                assert problem(answer, 503, "database_unavailable")["retryable"]
                assert {item["pointer"] for item in answer.json()["errors"]} == {
                    "check/database",
                    "check/queue",
                }
                problem(http.get("/v1/jobs"), 503, "database_unavailable")
                postgres.start()
                until_status(http, "/readyz", 200)
                assert http.get("/v1/jobs").json()["items"] == []
                files = tmp_path / "data" / "files"
                files.rename(tmp_path / "away")
                files.write_text("a file where the folder was")
                problem(http.get("/readyz"), 503, "storage_unavailable")
                files.unlink()
                (tmp_path / "away").rename(files)
                until_status(http, "/readyz", 200)
        finally:
            server.terminate()
            assert server.wait(15) == -signal.SIGTERM  # after its clean end, as uvicorn has it
            postgres.stop()


def until_status(http: httpx.Client, path: str, status: int) -> None:
    end, seen = time.monotonic() + 30, 0
    while seen != status:
        assert time.monotonic() < end, seen
        try:
            seen = http.get(path).status_code
        except httpx.TransportError:
            seen = 0
        time.sleep(0.1)


def test_a_server_that_cannot_start_says_why(service: Running, tmp_path: Path) -> None:
    def said(**settings: str) -> str:
        environment = {**os.environ, "BIRESNERF_DATA_DIR": str(tmp_path)}
        environment |= {f"BIRESNERF_{name}": value for name, value in settings.items()}
        command = [sys.executable, "-m", "biresnerf.command_line", "api"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2, done.stderr
        assert "Traceback" not in done.stderr
        return done.stderr

    assert "BIRESNERF_DATABASE_URL" in said()
    port = service.url.rsplit(":", 1)[1]
    assert "BIRESNERF_PORT" in said(DATABASE_URL="postgresql://x", PORT=port)
    assert "BIRESNERF_PORT" in said(PORT="many")


def test_two_keys_in_one_request_are_refused(http: httpx.Client) -> None:
    two = [("Authorization", "Bearer brn_a"), ("Authorization", "Bearer brn_b")]
    assert problem(http.get("/v1/jobs", headers=two), 400, "malformed_request")["where"] == "Authorization"


@pytest.mark.parametrize(
    "path", ["/livez", "/v1/jobs", "/v1/info", "/v1/jobs/job_none", "/openapi.json", "/v1/none"]
)
def test_head_answers_as_get_does_but_for_the_body(http: httpx.Client, path: str) -> None:
    got, asked = http.get(path), http.head(path)
    assert (asked.status_code, asked.content) == (got.status_code, b"")
    for header in ("content-type", "content-length", "etag", "cache-control"):
        if header != "content-length" or got.status_code < 400:  # a problem has the id of its request
            assert asked.headers.get(header) == got.headers.get(header), header


def test_head_of_a_stream_without_end_ends(http: httpx.Client, scene: Path) -> None:
    job = submit(http, ready_dataset(http, scene), steps=5000)["id"]
    asked = http.head(f"/v1/jobs/{job}/events", timeout=30)
    assert asked.status_code == 200
    assert asked.headers["content-type"].startswith("text/event-stream")
    assert http.post(f"/v1/jobs/{job}/cancel").status_code < 300, (
        "it was under way, and the connection goes on"
    )
