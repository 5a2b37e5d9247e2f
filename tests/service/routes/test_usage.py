"""What jobs used, over HTTP: by job, by key, by tenant, as JSON and as CSV, and the limit of seconds a day."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from biresnerf.client import Client
from tests.service.conftest import (
    Running,
    client_with,
    finished,
    operator,
    problem,
    ready_dataset,
    submit,
    until,
)

FIGURES = ("processor_s", "wall_s", "gpu_s")


@dataclass(frozen=True)
class Users:
    """Two keys of one tenant with a job each, a key of another tenant, and one with the scope admin."""

    first: httpx.Client
    second: httpx.Client
    other: httpx.Client
    admin: httpx.Client
    jobs: tuple[dict[str, Any], dict[str, Any], dict[str, Any]]


@pytest.fixture(scope="module")
def users(closed: Running, scene: Path) -> Iterator[Users]:
    def key(tenant: str, *more: str) -> httpx.Client:
        made = operator(closed.data_dir, "keys", "create", "use", "--tenant", tenant, *more)
        return client_with(closed, made["key"])

    clients = [key("dora"), key("dora"), key("emil"), key("emil", "--scope", "admin")]
    datasets = [ready_dataset(client, scene) for client in (clients[0], clients[2])]
    pairs = ((clients[0], datasets[0]), (clients[1], datasets[0]), (clients[2], datasets[1]))
    jobs = [finished(client, submit(client, dataset)["id"]) for client, dataset in pairs]
    yield Users(*clients, jobs=(jobs[0], jobs[1], jobs[2]))
    for client in clients:
        client.close()


def rows(http: httpx.Client, **asked: str) -> list[dict[str, Any]]:
    answer = http.get("/v1/usage", params=asked)
    assert answer.status_code == 200, answer.text
    return answer.json()["items"]


def test_a_job_shows_its_key_and_what_it_used(closed: Running, users: Users) -> None:
    keys = {key["id"]: key["tenant"] for key in operator(closed.data_dir, "keys", "list")}
    found = [job["key_id"] for job in users.jobs]
    assert len(set(found)) == 3
    assert [keys[key] for key in found] == ["dora", "dora", "emil"]
    for job in users.jobs:
        took = datetime.fromisoformat(job["finished_at"]) - datetime.fromisoformat(job["started_at"])
        assert job["use"]["wall_s"] == pytest.approx(took.total_seconds(), abs=0.2)
        assert job["use"]["processor_s"] > 0.05
        assert job["use"]["gpu_s"] == 0


def test_a_fork_and_an_export_are_of_the_key_that_asked_for_them(users: Users) -> None:
    path = f"/v1/jobs/{users.jobs[0]['id']}"
    export = users.second.post(f"{path}/exports", json={"formats": ["kitti"]}).json()
    assert (export["parent"], export["key_id"]) == (users.jobs[0]["id"], users.jobs[1]["key_id"])
    finished(users.second, export["id"])


def test_use_is_summed_by_what_is_asked_for_and_a_tenant_sees_its_own_alone(users: Users) -> None:
    by_key = {row["key_id"]: row for row in rows(users.first, by="tenant,key")}
    assert by_key.keys() == {job["key_id"] for job in users.jobs[:2]}
    first = by_key[users.jobs[0]["key_id"]]
    assert (first["tenant"], first["day"], first["device"], first["attempts"]) == ("dora", None, None, 1)
    for figure in FIGURES:
        assert first[figure] == pytest.approx(users.jobs[0]["use"][figure])
    everybody = {row["tenant"]: row for row in rows(users.admin, by="tenant")}
    assert everybody.keys() >= {"dora", "emil"}
    for figure in FIGURES:
        assert everybody["dora"][figure] == pytest.approx(sum(row[figure] for row in by_key.values()))


def test_days_are_of_utc_and_both_ends_count(users: Users) -> None:
    today = datetime.now(UTC).date()
    days = {str(today), str(today - timedelta(days=1))}  # midnight may have passed
    assert {row["day"] for row in rows(users.first)} <= days
    assert rows(users.first, **{"from": min(days), "to": str(today)}) == rows(users.first)
    assert rows(users.first, to=str(today - timedelta(days=2))) == []
    assert rows(users.first, **{"from": str(today + timedelta(days=1)), "to": "9999-12-31"}) == []
    assert rows(users.first, to="0001-01-01") == []


@pytest.mark.parametrize(
    "wish", [{"params": {"format": "csv"}}, {"headers": {"Accept": "text/csv"}}], ids=["format", "accept"]
)
def test_csv_says_the_same(users: Users, wish: dict[str, Any]) -> None:
    asked = wish.get("params", {}) | {"by": "day,key"}
    answer = users.first.get("/v1/usage", params=asked, headers=wish.get("headers"))
    assert answer.headers["content-type"].startswith("text/csv")
    found = list(csv.DictReader(io.StringIO(answer.text)))
    assert found == [
        {name: "" if value is None else str(value) for name, value in row.items()}
        for row in rows(users.first, by="day,key")
    ]


@pytest.mark.parametrize(
    "asked", [{"by": "hour"}, {"by": "day,day"}, {"by": ""}, {"from": "today"}, {"format": "xml"}], ids=str
)
def test_what_cannot_be_asked_is_refused(users: Users, asked: dict[str, str]) -> None:
    problem(users.first.get("/v1/usage", params=asked), 422, "invalid_request")


def test_the_client_asks_for_the_same(closed: Running, users: Users) -> None:
    today = datetime.now(UTC).date()
    key = users.first.headers["authorization"].removeprefix("Bearer ")
    with Client(closed.url, api_key=key) as client:
        found = client.usage(by=("day", "key"))
        assert [row.model_dump(mode="json") for row in found] == rows(users.first, by="day,key")
        assert client.usage(last=today - timedelta(days=1)) == ()
        assert client.usage(first=today + timedelta(days=1), last=today + timedelta(days=2)) == ()


def test_metrics_count_by_tenant(users: Users) -> None:
    told = users.admin.get("/metrics").text
    for name in ("processor", "wall", "gpu"):
        assert f'biresnerf_use_{name}_seconds_total{{tenant="dora"}}' in told


def test_at_the_seconds_of_the_day_new_jobs_are_refused_until_midnight_and_running_ones_end(
    closed: Running, users: Users
) -> None:
    dataset = users.jobs[2]["dataset_id"]
    running = submit(users.other, dataset, steps=200, step_ms=10)["id"]
    until(users.other, running, lambda job: job["state"] == "running")
    operator(closed.data_dir, "tenants", "set", "emil", "--max-daily-seconds", "1")
    try:
        while users.other.get("/v1/info").json()["share"]["seconds_today"] < 1:
            time.sleep(0.1)
        body = {"dataset_id": dataset, "options": {"preset": "fast"}}
        for path, sent in (
            ("/v1/jobs", body),
            (f"/v1/jobs/{users.jobs[2]['id']}/exports", {"formats": ["kitti"]}),
        ):
            refused = users.other.post(path, json=sent)
            told = problem(refused, 429, "daily_limit_reached")
            assert told["retryable"]
            assert "max_daily_seconds is 1" in told["detail"]
            now = datetime.now(UTC)
            tomorrow = datetime(now.year, now.month, now.day, tzinfo=UTC) + timedelta(days=1)
            assert f"{tomorrow:%Y-%m-%dT00:00:00}" in told["detail"]
            assert int(refused.headers["retry-after"]) == pytest.approx(
                (tomorrow - now).total_seconds(), abs=5
            )
        submit(users.first, users.jobs[0]["dataset_id"])
        assert finished(users.other, running)["state"] == "succeeded"
    finally:
        operator(closed.data_dir, "tenants", "set", "emil", "--max-daily-seconds", "-1")
    assert finished(users.other, submit(users.other, dataset)["id"])["state"] == "succeeded"
