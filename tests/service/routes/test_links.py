"""Links to the page of one job: what they open, for how long, and that they can be revoked."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest

from biresnerf.wire.jobs import JobView
from tests.service.conftest import (
    Running,
    Tenant,
    client_with,
    finished,
    operator,
    problem,
    ready_dataset,
    submit,
)
from tests.service.http.test_access import GUARDED, address


def made(tenant: Tenant, **options: int) -> dict[str, str]:
    answer = tenant.http.post(f"/v1/jobs/{tenant.job}/links", json=options)
    assert answer.status_code == 201, answer.text
    found: dict[str, str] = answer.json()
    return found


def test_a_link_opens_its_job_to_read_and_no_other_route(
    closed: Running, tenants: tuple[Tenant, Tenant]
) -> None:
    anna, bert = tenants
    link = made(anna)
    base = f"/v1/jobs/{anna.job}"
    with client_with(closed, link["token"]) as guest:
        assert guest.get(base).json()["id"] == anna.job
        assert guest.get(f"{base}/link").json()["id"] == link["id"]
        files = [item["name"] for item in guest.get(f"{base}/artifacts").json()["items"]]
        assert "report.json" in files
        assert guest.get(f"{base}/artifacts/report.json").status_code == 200
        opened = {
            "/v1/jobs/{job_id}": {"GET"},
            "/v1/jobs/{job_id}/artifacts": {"GET"},
            "/v1/jobs/{job_id}/artifacts/{name:path}": {"GET", "HEAD"},
            "/v1/jobs/{job_id}/report": {"GET"},
            "/v1/jobs/{job_id}/link": {"GET"},
        }
        for method, path, _ in GUARDED:
            for owner in (anna, bert):
                if owner is anna and method in opened.get(path, ()):
                    continue
                answer = guest.request(method, address(path, owner), json={})
                assert answer.status_code == 404, (method, path, answer.text)
        other = submit(anna.http, anna.dataset)["id"]
        for path in (
            f"{base}/artifacts/log.txt",
            f"{base}0",
            f"{base}/",
            f"/v1/jobs/{other}",
            f"/v1/jobs/{bert.job}",
        ):
            problem(guest.get(path), 404, "not_found")
        assert guest.get("/metrics").status_code == 401
    assert anna.http.get(f"{base}/artifacts/report.json").status_code == 200, "nothing was deleted"


def test_strangers_do_not_learn_whose_the_job_is_nor_what_its_owner_calls_it(
    closed: Running, tenants: tuple[Tenant, Tenant]
) -> None:
    anna, _ = tenants
    labels = {"customer": "Museum of Nothing"}
    options = {"preset": "fast", "steps": 20, "seed": 5}
    body = {"dataset_id": anna.dataset, "options": options, "labels": labels}
    job = finished(anna.http, anna.http.post("/v1/jobs", json=body).json()["id"])
    token = anna.http.post(f"/v1/jobs/{job['id']}/links", json={}).json()["token"]
    address = f"/v1/jobs/{job['id']}"
    mine = anna.http.get(address)
    with client_with(closed, token) as guest:
        shown = guest.get(address)
        assert JobView.model_validate(shown.json()).id == job["id"]
        for told in ("anna", anna.dataset, "customer", "Museum"):
            assert told in mine.text
            assert told not in shown.text
        kept = {"id", "state", "verdict", "options", "resolved_options", "metrics", "finished_at"}
        assert {name: shown.json()[name] for name in kept} == {name: mine.json()[name] for name in kept}
        # A browser that has one of the two must not take it for the other.
        assert shown.headers["etag"] != mine.headers["etag"]
        again = guest.get(address, headers={"If-None-Match": mine.headers["etag"]})
        assert again.status_code == 200
        assert guest.get(address, headers={"If-None-Match": shown.headers["etag"]}).status_code == 304


def test_a_link_ends_when_it_is_revoked_and_not_before(
    closed: Running, tenants: tuple[Tenant, Tenant]
) -> None:
    anna, bert = tenants
    links = f"/v1/jobs/{anna.job}/links"
    first, second = made(anna), made(anna, valid_s=3600)
    left = datetime.fromisoformat(second["expires_at"]) - datetime.now(UTC)
    assert timedelta(minutes=58) < left <= timedelta(hours=1)
    listed = anna.http.get(links).json()["items"]
    assert {first["id"], second["id"]} <= {item["id"] for item in listed}
    assert first["token"] not in anna.http.get(links).text
    problem(bert.http.delete(f"{links}/{first['id']}"), 404, "not_found")
    assert anna.http.delete(f"{links}/{first['id']}").status_code == 204
    with client_with(closed, first["token"]) as ended, client_with(closed, second["token"]) as living:
        problem(ended.get(f"/v1/jobs/{anna.job}"), 401, "invalid_api_key")
        assert living.get(f"/v1/jobs/{anna.job}").status_code == 200
        wrong = second["token"][:-1] + ("A" if second["token"][-1] != "A" else "B")
    with client_with(closed, wrong) as guessed:
        problem(guessed.get(f"/v1/jobs/{anna.job}"), 401, "invalid_api_key")


def test_a_key_that_may_only_read_makes_no_links(closed: Running, tenants: tuple[Tenant, Tenant]) -> None:
    anna, _ = tenants
    key = operator(closed.data_dir, "keys", "create", "reader", "--tenant", "anna", "--scope", "read")["key"]
    with client_with(closed, key) as reader:
        problem(reader.post(f"/v1/jobs/{anna.job}/links", json={}), 403, "scope_required")


def test_a_job_without_a_result_is_not_shared(http: httpx.Client, scene: Path) -> None:
    job = submit(http, ready_dataset(http, scene), steps=1000, step_ms=50)["id"]
    problem(http.post(f"/v1/jobs/{job}/links", json={}), 409, "result_not_ready")
    http.post(f"/v1/jobs/{job}/cancel")


@pytest.mark.parametrize("valid_s", [0, 59, 90 * 86_400 + 1])
def test_a_link_is_valid_for_a_minute_to_90_days(http: httpx.Client, valid_s: int) -> None:
    answer = http.post("/v1/jobs/job_0000000000/links", json={"valid_s": valid_s})
    assert answer.status_code == 422
