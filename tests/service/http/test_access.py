"""Two tenants on one service: neither sees, guesses or touches the other's data, on any route."""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute

from service.app import create_app
from service.http.access import OPEN
from tests.service.conftest import (
    TUS,
    Running,
    Tenant,
    client_with,
    problem,
    submit,
)
from workers.settings.settings import Settings
from workers.tenants.api_keys import ALL_SCOPES

# Of routes that look at the body first.
BODIES: dict[str, dict[str, Any]] = {
    "/v1/jobs/{job_id}/exports": {"formats": ["kitti"]},
    "/v1/jobs/{job_id}/deliver": {"archive": "https://a.example/a.zip"},
    "/v1/jobs/{job_id}/shares": {"name": "report.json"},
    "/v1/datasets/{dataset_id}/fetches": {"files": [{"url": "https://a.example/a.zip"}]},
    "/v1/datasets/{dataset_id}/signed-uploads": {"files": [{"path": "a", "size": 1, "sha256": 64 * "0"}]},
}
SAFE = {"GET", "HEAD", "OPTIONS"}


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
        *("/docs", "/docs/start.js", "/docs/{name}", "/web/{name}", "/example/{name:path}"),
        "/v1/shared/{job_id}/{name:path}",  # by a signature: tests/service/routes/test_shares.py
    }


def address(path: str, owner: Tenant) -> str:
    """The path of something that is the owner's. A new kind of id needs a line here."""
    values = {
        **{"dataset_id": owner.dataset, "job_id": owner.job, "upload_id": owner.upload},
        **{"path": "transforms.json", "name": "report.json", "photo": "0"},
        **{"webhook_id": owner.webhook, "delivery_id": owner.delivery, "link_id": owner.link},
        "batch_id": owner.batch,
        "other_id": owner.job,
    }
    return re.sub(r"\{(\w+)(:\w+)?\}", lambda match: values[match[1]], path)


def ids_of(owner: Tenant) -> dict[str, str]:
    names = ("dataset", "job", "upload", "webhook", "delivery", "link", "batch")
    return {name: getattr(owner, name) for name in names}


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
    headers = TUS | ({"Content-Type": "application/offset+octet-stream"} if "upload_id" in path else {})
    body = BODIES.get(path, {})
    answer = bert.http.request(method, address(path, anna), json=body, headers=headers)
    if method == "OPTIONS":  # says what is spoken here, nothing of the dataset
        assert answer.status_code == 204
        return
    assert answer.status_code == 404, answer.text
    if method != "HEAD":
        # Word for word what an id that never was gets.
        unknown = {name: f"{text.partition('_')[0]}_0000000000" for name, text in ids_of(anna).items()}
        made_up = replace(anna, **unknown)
        other = bert.http.request(method, address(path, made_up), json=body, headers=headers).json()
        text = answer.text
        for name, identity in ids_of(anna).items():
            text = text.replace(identity, unknown[name])
        mine = json.loads(text)
        assert {**mine, "request_id": ""} == {**other, "request_id": ""}
    assert seen_by(anna) == before


def seen_by(tenant: Tenant) -> list[Any]:
    job, dataset = f"/v1/jobs/{tenant.job}", f"/v1/datasets/{tenant.dataset}"
    paths = (job, f"{job}/artifacts", dataset, f"{dataset}/files", f"/v1/uploads/{tenant.upload}")
    paths += (f"/v1/webhooks/{tenant.webhook}", f"/v1/batches/{tenant.batch}")
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
    assert not [identity for identity in ids_of(anna).values() if identity in answer.text]
    if path == "/v1/info":
        assert sum(answer.json()["job_counts"].values()) == bert.http.get("/v1/jobs").text.count('"state"')


def test_a_cursor_or_label_of_another_tenant_opens_nothing(tenants: tuple[Tenant, Tenant], scene: Path):
    anna, bert = tenants
    submit(anna.http, anna.dataset, steps=20)
    cursor = anna.http.get("/v1/jobs?limit=1").json()["next_cursor"]
    assert cursor is not None
    seen = bert.http.get("/v1/jobs", params={"cursor": cursor}).json()["items"]
    assert {item["tenant"] for item in seen} <= {"bert"}


def test_whoever_knows_a_digest_gets_no_bytes_of_others_by_it(tenants: tuple[Tenant, Tenant]):
    anna, bert = tenants
    content = b"anna's alone"
    own = anna.http.post("/v1/datasets", json={}).json()["id"]
    assert anna.http.put(f"/v1/datasets/{own}/files/a.png", content=content).status_code == 201
    entry = {"path": "b.png", "size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    missing = [
        tenant.http.post("/v1/datasets", json={"manifest": [entry]}).json()["missing"]
        for tenant in (anna, bert)
    ]
    assert missing == [[], ["b.png"]]


def test_nobody_runs_a_job_on_anothers_dataset(tenants: tuple[Tenant, Tenant]):
    anna, bert = tenants
    body = {"dataset_id": anna.dataset, "options": {"preset": "fast"}}
    problem(bert.http.post("/v1/jobs", json=body), 404, "not_found")
    mixed = {"jobs": [{"dataset_id": bert.dataset}, body]}
    before = bert.http.get("/v1/info").json()["job_counts"]
    problem(bert.http.post("/v1/batches", json=mixed), 404, "not_found")
    assert bert.http.get("/v1/info").json()["job_counts"] == before


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
