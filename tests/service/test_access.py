"""Two tenants on one service: neither sees, guesses or touches what is the other's, on any route there is."""

from __future__ import annotations

import functools
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from fastapi.routing import APIRoute

from service.access import OPEN
from service.app import create_app
from service.client import Client, ServiceError
from service.keys_command import keys_command
from tests.service.conftest import (
    PROGRAM,
    Running,
    finished,
    new_dataset,
    problem,
    ready_dataset,
    running_service,
    short_folder,
    submit,
)
from workers.api_keys import ALL_SCOPES
from workers.settings import Settings

SAFE = {"GET", "HEAD", "OPTIONS"}


def keys(data_dir: Path, *arguments: str) -> Any:
    """`biresnerf keys … --json` beside the running service."""
    said = CliRunner().invoke(
        keys_command,
        [*arguments, "--json", "--data-dir", str(data_dir)],
        env={"BIRESNERF_DATABASE_URL": None},
        catch_exceptions=False,
    )
    assert said.exit_code == 0, said.output
    return json.loads(said.stdout)


def client_with(service: Running, key: str | None) -> httpx.Client:
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    return httpx.Client(base_url=service.url, timeout=60.0, headers=headers)


@pytest.fixture(scope="module")
def closed() -> Iterator[Running]:
    """A service that wants keys."""
    with (
        short_folder() as folder,
        running_service(folder, auth="required", job_command=(sys.executable, str(PROGRAM))) as running,
    ):
        yield running


@dataclass(frozen=True)
class Tenant:
    http: httpx.Client
    key: str
    dataset: str
    job: str
    upload: str


@pytest.fixture(scope="module")
def tenants(closed: Running, scene: Path) -> Iterator[tuple[Tenant, Tenant]]:
    """Two tenants, each with a dataset and a finished job."""
    made = []
    for name in ("anna", "bert"):
        key = keys(closed.data_dir, "create", "test", "--tenant", name)["key"]
        http = client_with(closed, key)
        dataset = ready_dataset(http, scene)
        job = finished(http, submit(http, dataset)["id"])["id"]
        made.append(Tenant(http, key, dataset, job, new_upload(http)))
    yield made[0], made[1]
    for tenant in made:
        tenant.http.close()


TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "9", "Upload-Offset": "0"}
TUS["Content-Type"] = "application/offset+octet-stream"


def new_upload(http: httpx.Client) -> str:
    """A resumable upload that waits for its bytes."""
    made = http.post(f"/v1/datasets/{new_dataset(http)}/uploads", headers=TUS)
    assert made.status_code == 201, made.text
    return made.json()["id"]


def all_routes() -> list[tuple[str, str, APIRoute | None]]:
    """Method, path and route of everything the application answers; docs and schema have no `APIRoute`."""
    app = create_app(Settings(database_url="postgresql://nowhere"))
    found = []
    for route in flat(app.routes):
        for method in sorted(getattr(route, "methods", None) or ()):
            found.append((method, route.path, route if isinstance(route, APIRoute) else None))
    assert len(found) > 20
    return found


def flat(routes: list[Any]) -> Iterator[Any]:
    for route in routes:
        # FastAPI keeps an included router as one entry, older versions copied its routes.
        inner = getattr(getattr(route, "original_router", route), "routes", None)
        yield from flat(inner) if inner else (route,)


GUARDED = [(method, path, route) for method, path, route in all_routes() if not OPEN.fullmatch(path)]


@functools.cache
def schema() -> dict[str, Any]:
    return create_app(Settings(database_url="postgresql://nowhere")).openapi()


def scopes_of(route: APIRoute) -> set[str]:
    plain = re.sub(r":\w+\}", "}", route.path)
    (method,) = route.methods
    (needed,) = schema()["paths"][plain][method.lower()]["security"]
    return set(needed["ApiKey"])


@pytest.mark.parametrize(("method", "path", "route"), GUARDED, ids=lambda value: str(value)[:60])
def test_every_route_needs_a_scope_and_a_changing_one_more_than_read(
    method: str, path: str, route: APIRoute | None
):
    assert route is not None, f"{path} is neither open nor a declared route"
    (needed,) = scopes_of(route)
    assert needed in ALL_SCOPES
    assert method in SAFE or needed != "read"


def test_only_health_docs_and_schema_are_open():
    open_paths = {path for _, path, _ in all_routes() if OPEN.fullmatch(path)}
    assert open_paths <= {
        *("/", "/livez", "/readyz", "/startupz", "/metrics", "/openapi.json"),
        *("/docs", "/docs/start.js", "/docs/{name}"),
    }


def address(path: str, owner: Tenant) -> str:
    """The path of something that is the owner's. A new kind of id needs a line here."""
    values = {
        **{"dataset_id": owner.dataset, "job_id": owner.job, "upload_id": owner.upload},
        **{"path": "transforms.json", "name": "report.json"},
    }
    return re.sub(r"\{(\w+)(:\w+)?\}", lambda match: values[match[1]], path)


@pytest.mark.parametrize(("method", "path"), [(method, path) for method, path, _ in GUARDED])
def test_no_route_serves_anybody_without_a_key(
    closed: Running, tenants: tuple[Tenant, Tenant], method: str, path: str
):
    with client_with(closed, None) as nobody:
        answer = nobody.request(method, address(path, tenants[0]))
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"].startswith("Bearer")
    if method != "HEAD":
        problem(answer, 401, "missing_credentials")


@pytest.mark.parametrize(("method", "path"), [(m, p) for m, p, _ in GUARDED if "{" in p])
def test_anothers_id_is_not_found_on_any_route(tenants: tuple[Tenant, Tenant], method: str, path: str):
    anna, bert = tenants
    before = seen_by(anna)
    answer = bert.http.request(method, address(path, anna), json={}, headers=TUS)
    if method == "OPTIONS":  # says what is spoken here, nothing of the dataset
        assert answer.status_code == 204
        return
    assert answer.status_code == 404, answer.text
    if method != "HEAD":
        # Word for word what an id that never was gets.
        made_up = Tenant(bert.http, "", "ds_0000000000", "job_0000000000", "up_0000000000")
        other = bert.http.request(method, address(path, made_up), json={}, headers=TUS).json()
        text = answer.text.replace(anna.dataset, made_up.dataset).replace(anna.job, made_up.job)
        mine = json.loads(text.replace(anna.upload, made_up.upload))
        assert {**mine, "request_id": ""} == {**other, "request_id": ""}
    assert seen_by(anna) == before


def seen_by(tenant: Tenant) -> list[Any]:
    job, dataset = f"/v1/jobs/{tenant.job}", f"/v1/datasets/{tenant.dataset}"
    paths = (job, f"{job}/artifacts", dataset, f"{dataset}/files", f"/v1/uploads/{tenant.upload}")
    answers = [tenant.http.get(path) for path in paths]
    assert {answer.status_code for answer in answers} == {200}
    return [answer.json() for answer in answers]


@pytest.mark.parametrize("path", [p for m, p, _ in GUARDED if m == "GET" and "{" not in p])
def test_no_list_or_count_shows_anything_of_others(tenants: tuple[Tenant, Tenant], path: str):
    anna, bert = tenants
    answer = bert.http.get(path)
    if answer.status_code == 403:
        assert answer.json()["code"] == "scope_required"
        return
    assert answer.status_code == 200
    assert anna.job not in answer.text
    assert anna.dataset not in answer.text
    if path == "/v1/info":
        assert sum(answer.json()["job_counts"].values()) == bert.http.get("/v1/jobs").text.count('"state"')


def test_a_cursor_or_label_of_another_tenant_opens_nothing(tenants: tuple[Tenant, Tenant], scene: Path):
    anna, bert = tenants
    submit(anna.http, anna.dataset, steps=20)
    cursor = anna.http.get("/v1/jobs?limit=1").json()["next_cursor"]
    assert cursor is not None
    seen = bert.http.get("/v1/jobs", params={"cursor": cursor}).json()["items"]
    assert {item["tenant"] for item in seen} <= {"bert"}


def test_nobody_runs_a_job_on_anothers_dataset(tenants: tuple[Tenant, Tenant]):
    anna, bert = tenants
    body = {"dataset_id": anna.dataset, "options": {"preset": "fast"}}
    problem(bert.http.post("/v1/jobs", json=body), 404, "not_found")


def test_idempotency_keys_of_two_tenants_do_not_meet(tenants: tuple[Tenant, Tenant]):
    said = {"Idempotency-Key": "night-run"}
    jobs = []
    for tenant in tenants:
        body = {"dataset_id": tenant.dataset, "options": {"preset": "fast", "steps": 20}}
        answers = [tenant.http.post("/v1/jobs", json=body, headers=said) for _ in range(2)]
        assert [answer.status_code for answer in answers] == [202, 202]
        assert answers[0].json()["id"] == answers[1].json()["id"]
        jobs.append(answers[0].json()["id"])
    assert jobs[0] != jobs[1]


@pytest.mark.parametrize(
    ("scope", "allowed"),
    [
        ("read", {"read"}),
        ("datasets:write", {"datasets:write"}),
        ("jobs:write", {"jobs:write"}),
        ("admin", {"read", "datasets:write", "jobs:write", "admin"}),
    ],
)
def test_a_key_may_what_its_scopes_say_and_no_more(
    closed: Running, tenants: tuple[Tenant, Tenant], scope: str, allowed: set[str]
):
    anna = tenants[0]
    key = keys(closed.data_dir, "create", "one scope", "--tenant", "anna", "--scope", scope)["key"]
    tries = {
        "read": ("GET", f"/v1/jobs/{anna.job}", None),
        "datasets:write": ("POST", "/v1/datasets", {"name": "x"}),
        "jobs:write": ("POST", f"/v1/jobs/{anna.job}/cancel", None),
    }
    with client_with(closed, key) as http:
        for needed, (method, path, body) in tries.items():
            answer = http.request(method, path, json=body)
            if needed in allowed:
                assert answer.status_code < 300, answer.text
            else:
                problem(answer, 403, "scope_required")
                assert f'scope="{needed}"' in answer.headers["www-authenticate"]


def test_revoked_unknown_and_malformed_keys_are_refused_alike(
    closed: Running, tenants: tuple[Tenant, Tenant]
):
    made = keys(closed.data_dir, "create", "short-lived", "--tenant", "anna")
    with client_with(closed, made["key"]) as http:
        assert http.get("/v1/jobs").status_code == 200
        (listed,) = [key for key in keys(closed.data_dir, "list") if key["id"] == made["id"]]
        assert listed["last_used_at"] is not None
        keys(closed.data_dir, "revoke", made["id"])
        revoked = problem(http.get("/v1/jobs"), 401, "invalid_api_key")
    wrong = tenants[0].key[:-1] + ("A" if tenants[0].key[-1] != "A" else "B")
    for text in (wrong, "brn_0000000000_" + "x" * 43, "brn_", "x"):
        with client_with(closed, text) as http:
            assert problem(http.get("/v1/jobs"), 401, "invalid_api_key")["detail"] == revoked["detail"]
    for header in ("Basic YTpi", "Bearer", "", "Bearer a b"):
        answer = httpx.get(f"{closed.url}/v1/jobs", headers={"Authorization": header})
        problem(answer, 401, "invalid_api_key")


def test_no_key_is_ever_written_to_a_log_or_told_again(closed: Running, tenants: tuple[Tenant, Tenant]):
    secrets = [tenant.key.split("_", 2)[2] for tenant in tenants]
    told = closed.log.read_text() + json.dumps(keys(closed.data_dir, "list"))
    dump = b"".join(
        path.read_bytes()
        for path in (closed.data_dir / "postgres").rglob("*")
        if path.is_file() and "base" in path.parts
    )
    for secret in secrets:
        assert secret not in told
        assert secret.encode() not in dump


def test_the_client_and_the_stream_take_a_key(closed: Running, tenants: tuple[Tenant, Tenant]):
    anna, bert = tenants
    with Client(closed.url, api_key=anna.key) as client:
        job = client.job(anna.job)
        assert [happening.kind for happening in client.follow(job)][-1] == "succeeded"
        assert client.artifacts(job)
    with Client(closed.url, api_key=bert.key) as client, pytest.raises(ServiceError, match="No job"):
        list(client.follow(job))
    with Client(closed.url) as client, pytest.raises(ServiceError, match="API key"):
        client.job(anna.job)


def test_a_client_shows_its_key_to_its_own_service_alone(service: Running, tenants: tuple[Tenant, Tenant]):
    with Client("http://127.0.0.1:9", api_key="brn_secret") as client:
        elsewhere = client._http.build_request("GET", f"{service.url}/livez")
        sent = next(client._http.auth.auth_flow(elsewhere))
        assert "authorization" not in sent.headers
        own = next(client._http.auth.auth_flow(client._http.build_request("GET", "/livez")))
        assert own.headers["authorization"] == "Bearer brn_secret"


def test_health_docs_and_schema_need_no_key(closed: Running):
    with client_with(closed, None) as nobody:
        for path in ("/livez", "/readyz", "/docs", "/docs/start.js", "/openapi.json"):
            assert nobody.get(path).status_code == 200, path


def test_without_any_key_the_loopback_is_open_but_not_to_names_that_point_at_it(service: Running):
    with client_with(service, None) as http:
        assert http.get("/v1/jobs").status_code == 200
        rebound = http.get("/v1/jobs", headers={"Host": "evil.example"})
        problem(rebound, 403, "cross_site")
        assert http.get("/v1/jobs", headers={"Host": "localhost:1"}).status_code == 200
        problem(http.get("/v1/jobs", headers={"Authorization": "Bearer brn_x"}), 401, "invalid_api_key")
