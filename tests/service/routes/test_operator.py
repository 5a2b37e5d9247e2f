"""What the operator sees of the installation, and that nobody else does."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

from biresnerf.client import Client, ServiceError
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


@pytest.fixture(scope="module")
def admin(closed: Running) -> Iterator[httpx.Client]:
    key = operator(closed.data_dir, "keys", "create", "op", "--tenant", "ops", "--scope", "admin")["key"]
    with client_with(closed, key) as http:
        yield http


@pytest.fixture(scope="module")
def user(closed: Running) -> Iterator[httpx.Client]:
    with client_with(
        closed, operator(closed.data_dir, "keys", "create", "u", "--tenant", "gerd")["key"]
    ) as http:
        yield http


def seen(http: httpx.Client) -> dict[str, Any]:
    answer = http.get("/v1/operator")
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_the_client_shows_it_to_operators_alone(
    closed: Running, admin: httpx.Client, user: httpx.Client
) -> None:
    def client(http: httpx.Client) -> Client:
        return Client(closed.url, api_key=http.headers["authorization"].removeprefix("Bearer "))

    with client(admin) as allowed, client(user) as refused:
        assert [slot.name for slot in allowed.operator().slots] == [
            slot["name"] for slot in seen(admin)["slots"]
        ]
        with pytest.raises(ServiceError) as error:
            refused.operator()
    assert error.value.code == "scope_required"


def test_a_key_without_the_scope_admin_is_refused(user: httpx.Client) -> None:
    answer = user.get("/v1/operator")
    problem(answer, 403, "scope_required")
    assert 'scope="admin"' in answer.headers["www-authenticate"]


def test_it_shows_what_waits_and_what_each_slot_does_of_all_tenants(
    closed: Running, admin: httpx.Client, user: httpx.Client, scene: Path
) -> None:
    operator(closed.data_dir, "tenants", "set", "gerd", "--max-running", "2", "--top-priority", "high")
    dataset = ready_dataset(user, scene)
    running = submit(user, dataset, steps=4000, step_ms=10)["id"]
    body = {"dataset_id": dataset, "options": {"preset": "fast"}, "priority": "low"}
    until(user, running, lambda job: job["stage"] == "coarse")
    waiting = [user.post("/v1/jobs", json=body).json() for _ in range(2)]
    now = seen(admin)
    counts = {row["priority"]: row for row in now["queue"]}
    assert list(counts) == ["high", "normal", "low"]
    assert (counts["low"]["waiting"], counts["low"]["held"], counts["low"]["running"]) == (1, 1, 0)
    assert counts["low"]["oldest_at"] == waiting[0]["created_at"]
    assert (counts["normal"]["running"], counts["high"]["running"]) == (1, 0)
    (slot,) = now["slots"]
    assert (slot["name"], slot["kind"], slot["alive"]) == ("cpu0", "cpu", True)
    at, beat_at = (datetime.fromisoformat(text) for text in (now["at"], slot["beat_at"]))
    assert -1 < (at - beat_at).total_seconds() < 10
    (work,) = slot["jobs"]
    job = user.get(f"/v1/jobs/{running}").json()
    assert (work["id"], work["tenant"], work["stage"], work["kind"]) == (running, "gerd", "coarse", "refine")
    began = [datetime.fromisoformat(text) for text in (work["since"], job["started_at"])]
    assert abs((began[0] - began[1]).total_seconds()) < 0.1
    for other in (*(item["id"] for item in waiting), running):
        user.post(f"/v1/jobs/{other}/cancel")
    finished(user, running)
    assert [slot["jobs"] for slot in seen(admin)["slots"]] == [[]]


def test_it_shows_the_latest_failures_first_and_why(
    admin: httpx.Client, user: httpx.Client, scene: Path
) -> None:
    dataset = ready_dataset(user, scene)
    failed = [finished(user, submit(user, dataset, threads=77)["id"]) for _ in range(2)]
    newest = seen(admin)["failures"][:2]
    assert [row["id"] for row in newest] == [failed[1]["id"], failed[0]["id"]]
    assert {row["tenant"] for row in newest} == {"gerd"}
    assert newest[0]["finished_at"] == failed[1]["finished_at"]
    assert (newest[0]["code"], newest[0]["detail"]) == ("diverged", "The loss is not finite.")


def test_sizes_are_those_of_all_tenants_the_database_and_the_disk(
    closed: Running, admin: httpx.Client, user: httpx.Client
) -> None:
    before = seen(admin)
    stored = sum(share["stored_bytes"] for share in operator(closed.data_dir, "tenants", "list"))
    assert before["stored_bytes"] == stored > 0
    assert 2**22 < before["database_bytes"] < 2**32
    assert before["upload_room_bytes"] > 0
    dataset = user.post("/v1/datasets", json={}).json()["id"]
    assert user.put(f"/v1/datasets/{dataset}/files/a.png", content=b"x" * 5000).status_code == 201
    assert seen(admin)["stored_bytes"] == stored + 5000
