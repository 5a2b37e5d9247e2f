from __future__ import annotations

import json
import re
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import yaml
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from tests.service.conftest import PATIENCE_S, ready_dataset, submit, until

DOCS = Path(__file__).parents[3] / "docs"


def figures(http: httpx.Client) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every sample by name and labels."""
    answer = http.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def at(found: dict[Any, float], name: str, **labels: str) -> float:
    return found.get((name, frozenset(labels.items())), 0.0)


def test_requests_are_counted_by_route_and_status_and_never_by_what_strangers_make_up(
    http: httpx.Client,
) -> None:
    before = figures(http)
    http.get("/v1/jobs/job_1")
    http.get("/v1/jobs/job_2?hush=1")
    http.request("BREW", "/v1/pot-1")
    http.get("/v1/pot-2")
    http.post("/v1/datasets", json={"name": "x" * 100})
    after = figures(http)
    route = {"method": "GET", "route": "/v1/jobs/{job_id}"}
    counted = {**route, "status": "404"}
    grown = at(after, "biresnerf_http_requests_total", **counted) - at(
        before, "biresnerf_http_requests_total", **counted
    )
    assert grown == 2
    timed = at(after, "biresnerf_http_answer_seconds_count", **route)
    assert timed - at(before, "biresnerf_http_answer_seconds_count", **route) == 2
    posted = {"method": "POST", "route": "/v1/datasets"}
    received = at(after, "biresnerf_http_request_bytes_total", **posted)
    assert received - at(before, "biresnerf_http_request_bytes_total", **posted) > 100
    assert at(after, "biresnerf_http_requests_total", method="other", route="unmatched", status="404") >= 1
    assert not re.search(r"pot-|job_1|hush|BREW", str(after))


def test_a_job_is_told_from_queue_to_end(http: httpx.Client, scene: Path) -> None:
    before = figures(http)
    job = submit(http, ready_dataset(http, scene), steps=300, step_ms=20)["id"]
    until(http, job, lambda found: found["state"] == "running")
    during = figures(http)
    assert at(during, "biresnerf_jobs", state="running") == 1
    assert at(during, "biresnerf_slots", kind="cpu", busy="true") == 1
    assert at(during, "biresnerf_queue_running", kind="cpu") == 1
    assert ("biresnerf_queue_waiting", frozenset({("kind", "cpu")})) in during
    until(http, job, lambda found: found["state"] == "succeeded")
    after = figures(http)

    def grown(name: str, **labels: str) -> float:
        return at(after, name, **labels) - at(before, name, **labels)

    # What happened, by the job's own history: on a slow machine an attempt may be taken for dead.
    history = http.get(f"/v1/jobs/{job}/events").text
    for event in ("queued", "started", "succeeded"):
        assert grown("biresnerf_job_events_total", type=event) == history.count(f"event: {event}\n") >= 1
    assert grown("biresnerf_queue_wait_seconds_count") == 1
    assert grown("biresnerf_job_seconds_count", state="succeeded") == 1
    for stage in ("coarse", "fine", "exporting"):
        times = history.count(f'"type":"stage","data":{{"stage":"{stage}"}}')
        assert grown("biresnerf_stage_seconds_count", stage=stage) == times >= 1
        assert grown("biresnerf_stage_seconds_bucket", stage=stage, le="+Inf") == times
    # How much of the work falls between two reports of the stage depends on the machine.
    spent = [grown("biresnerf_stage_seconds_sum", stage=stage) for stage in ("coarse", "fine")]
    assert 0.0 < sum(spent) <= grown("biresnerf_job_seconds_sum", state="succeeded")
    assert grown("biresnerf_stored_files_total") == 7
    assert grown("biresnerf_stored_bytes_total") > 1000
    assert at(after, "biresnerf_database_up") == 1


def test_counts_outlive_the_job_they_are_of(http: httpx.Client, scene: Path) -> None:
    job = submit(http, ready_dataset(http, scene), threads=77)["id"]
    until(http, job, lambda found: found["state"] == "failed")
    failed = at(figures(http), "biresnerf_job_failures_total", code="diverged")
    assert failed >= 1
    assert http.delete(f"/v1/jobs/{job}").status_code == 204
    time.sleep(1.2)  # two rounds of the janitor, which adds single counts up
    assert at(figures(http), "biresnerf_job_failures_total", code="diverged") == failed


def test_listeners_are_counted_while_they_listen(http: httpx.Client, scene: Path) -> None:
    job = submit(http, ready_dataset(http, scene), steps=4000, step_ms=10)["id"]
    opened, leave = threading.Event(), threading.Event()

    def listen() -> None:
        with httpx.stream("GET", str(http.base_url.join(f"/v1/jobs/{job}/events"))) as stream:
            lines = stream.iter_lines()
            next(lines)
            opened.set()
            leave.wait(PATIENCE_S)

    listener = threading.Thread(target=listen)
    listener.start()
    assert opened.wait(PATIENCE_S)
    assert at(figures(http), "biresnerf_event_listeners") == 1
    leave.set()
    listener.join()
    end = time.monotonic() + PATIENCE_S
    while at(figures(http), "biresnerf_event_listeners"):
        assert time.monotonic() < end
        time.sleep(0.1)
    http.post(f"/v1/jobs/{job}/cancel")


def test_openmetrics_is_told_to_who_asks_for_it(http: httpx.Client) -> None:
    answer = http.get("/metrics", headers={"Accept": "application/openmetrics-text; version=1.0.0"})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    assert {family.name for family in parse_openmetrics(answer.text)} >= {"biresnerf_jobs", "biresnerf_slots"}


def test_dashboard_and_alerts_ask_for_metrics_that_exist(
    http: httpx.Client, done_job: dict[str, Any]
) -> None:
    dashboard = json.loads((DOCS / "grafana-dashboard.json").read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", [])]
    on_dashboard = set(re.findall(r"\bbiresnerf_[a-z_]+", " ".join(asked)))
    rules = yaml.safe_load((DOCS.parent / "deploy" / "prometheus" / "alerts.yaml").read_text())["groups"][0][
        "rules"
    ]
    asked += [rule["expr"] for rule in rules if rule["expr"] != 'up{job="biresnerf"} == 0']
    assert len(asked) > 30
    told: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(http.get("/metrics").text):
        endings = {"counter": ("_total",), "histogram": ("_bucket", "_count", "_sum")}.get(family.type, ("",))
        name = family.name.removesuffix("_total")
        for ending in endings:
            told.setdefault(name + ending, set()).update(
                label for sample in family.samples for label in sample.labels
            )
    for query in asked:
        names = re.findall(r"\b(?:biresnerf|process)_[a-z_]+", query)
        assert names, query
        assert set(names) <= set(told), query
        labels = set(re.findall(r"(\w+)\s*(?:=~?|!~?=?)\s*\"", query))
        for group in re.findall(r"\bby\s*\(([^)]*)\)", query):
            labels |= {label.strip() for label in group.split(",")}
        known = set().union(*(told[name] for name in names)) | {"instance", "job", "le"}
        assert labels <= known, query
    # And what exists is shown, but for what says no more than another.
    shown = {re.sub(r"_(bucket|sum|count)$", "", name) for name in on_dashboard}
    exist = {re.sub(r"_(bucket|sum|count)$", "", name) for name in told}
    exist = {name for name in exist if name.startswith("biresnerf_") and not name.endswith("_created")}
    assert exist - shown == {"biresnerf_build_info", "biresnerf_stored_files_total"}
