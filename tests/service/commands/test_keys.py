"""API keys over HTTP: what they open, what their owner may use, and when they are refused."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner

from biresnerf.client import Client, ServiceError
from service.commands.keys import keys_command
from service.http.access import UNIDENTIFIED_BURST
from tests.service.conftest import (
    BURST,
    Running,
    Tenant,
    client_with,
    operator,
    problem,
    ready_dataset,
    submit,
    until,
)


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
    key = operator(closed.data_dir, "keys", "create", "one scope", "--tenant", "anna", "--scope", scope)[
        "key"
    ]
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


def test_a_list_for_people_says_until_when_a_key_is_valid(closed: Running):
    lasting, short, gone = (
        operator(closed.data_dir, "keys", "create", name, "--tenant", "listed", *more)
        for name, more in (("lasting", ()), ("short", ("--expires", "90d")), ("gone", ("--expires", "90d")))
    )
    operator(closed.data_dir, "keys", "revoke", gone["id"])
    said = CliRunner().invoke(
        keys_command, ["list", "--data-dir", str(closed.data_dir)], env={"BIRESNERF_DATABASE_URL": None}
    )
    ends = {line.split()[0]: line.split("  ")[4] for line in said.output.splitlines() if " listed " in line}
    ended = operator(closed.data_dir, "keys", "list")
    revoked_at = next(key["revoked_at"] for key in ended if key["id"] == gone["id"])
    assert ends == {
        lasting["id"]: "valid",
        short["id"]: f"until {short['expires_at'][:10]}",
        gone["id"]: f"revoked {revoked_at[:10]}",
    }


def test_revoked_unknown_and_malformed_keys_are_refused_alike(
    closed: Running, tenants: tuple[Tenant, Tenant]
):
    made = operator(closed.data_dir, "keys", "create", "short-lived", "--tenant", "anna")
    with client_with(closed, made["key"]) as http:
        assert http.get("/v1/jobs").status_code == 200
        (listed,) = [key for key in operator(closed.data_dir, "keys", "list") if key["id"] == made["id"]]
        assert listed["last_used_at"] is not None
        operator(closed.data_dir, "keys", "revoke", made["id"])
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
    told = closed.log.read_text() + json.dumps(operator(closed.data_dir, "keys", "list"))
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
        assert [happening.kind for happening in client.events(job.id)][-1] == "succeeded"
        assert client.artifacts(job.id)
    with Client(closed.url, api_key=bert.key) as client, pytest.raises(ServiceError, match="No job"):
        list(client.events(job.id))
    with Client(closed.url) as client, pytest.raises(ServiceError, match="API key"):
        client.job(anna.job)


def test_a_client_shows_its_key_to_its_own_service_alone(service: Running, tenants: tuple[Tenant, Tenant]):
    with Client("http://127.0.0.1:9", api_key="brn_secret") as client:
        http = client._client._http
        elsewhere = http.build_request("GET", f"{service.url}/livez")
        sent = next(http.auth.auth_flow(elsewhere))
        assert "authorization" not in sent.headers
        own = next(http.auth.auth_flow(http.build_request("GET", "/livez")))
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


def test_metrics_are_open_only_where_everything_is(service: Running, closed: Running):
    with client_with(service, None) as http:
        assert http.get("/metrics").status_code == 200
        problem(http.get("/metrics", headers={"Host": "evil.example"}), 401, "metrics_token_required")
    admin = operator(closed.data_dir, "keys", "create", "figures", "--scope", "admin")["key"]
    reader = operator(closed.data_dir, "keys", "create", "reader", "--scope", "read")["key"]
    for key, status in ((None, 401), (reader, 401), (admin, 200)):
        with client_with(closed, key) as http:
            assert http.get("/metrics").status_code == status


def test_a_keyed_answer_tells_what_is_left(tenants: tuple[Tenant, Tenant]):
    first, second = (tenants[0].http.get("/v1/info").headers for _ in range(2))
    assert first["ratelimit-policy"] == f'"key";q={BURST}'
    assert second["ratelimit"].startswith('"key";r=')


def test_a_tenant_at_its_limits_is_refused_and_told_so_and_others_go_on(
    closed: Running, tenants: tuple[Tenant, Tenant], scene: Path
):
    key = operator(closed.data_dir, "keys", "create", "k", "--tenant", "carla")["key"]
    operator(closed.data_dir, "tenants", "set", "carla", "--max-running", "1", "--max-queued", "1")
    with client_with(closed, key) as carla:
        dataset = ready_dataset(carla, scene)
        jobs = [submit(carla, dataset, steps=4000)["id"]]
        until(carla, jobs[0], lambda job: job["state"] == "running")
        jobs.append(submit(carla, dataset)["id"])
        body = {"dataset_id": dataset, "options": {"preset": "fast"}}
        refused = carla.post("/v1/jobs", json=body)
        assert problem(refused, 429, "quota_exhausted")["retryable"]
        assert int(refused.headers["retry-after"]) > 0
        submit(tenants[0].http, tenants[0].dataset)
        high = carla.post("/v1/jobs", json={**body, "priority": "high"})
        problem(high, 403, "priority_not_allowed")
        share = carla.get("/v1/info").json()["share"]
        assert (share["running"], share["queued"], share["max_queued"]) == (1, 1, 1)
        operator(closed.data_dir, "tenants", "set", "carla", "--max-stored-bytes", str(share["stored_bytes"]))
        full = carla.post("/v1/datasets", json={}).json()["id"]
        problem(carla.put(f"/v1/datasets/{full}/files/a.png", content=b"x"), 429, "quota_exhausted")
        for job in jobs:
            carla.post(f"/v1/jobs/{job}/cancel")


def test_strangers_are_slowed_down_and_keys_from_the_same_address_are_not(
    closed: Running, tenants: tuple[Tenant, Tenant]
):
    # An address of its own: what is used up of 127.0.0.1 other tests would miss.
    address = httpx.HTTPTransport(local_address="127.0.0.2")
    with httpx.Client(base_url=closed.url, timeout=60.0, transport=address) as http:
        answers = (http.get("/v1/jobs", headers=bearer("brn_wrong")) for _ in range(20 * UNIDENTIFIED_BURST))
        last = next(answer for answer in answers if answer.status_code != 401)
        assert int(last.headers["retry-after"]) >= 1
        assert problem(last, 429, "rate_limited")["retryable"]
        assert http.get("/v1/jobs", headers=bearer(tenants[0].key)).status_code == 200
    with client_with(closed, "brn_wrong") as elsewhere:
        assert elsewhere.get("/v1/jobs").status_code == 401


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}
