"""Spans as a collector gets them, from a service and its worker over OTLP."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from tests.service.conftest import PROGRAM, finished, ready_dataset, running_service, short_folder


class Collector:
    """Takes spans over HTTP as any OpenTelemetry collector does."""

    def __init__(self) -> None:
        self.spans: list[Any] = []
        spans = self.spans

        class Receiver(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                request = ExportTraceServiceRequest()
                request.ParseFromString(self.rfile.read(int(self.headers["content-length"])))
                for resource in request.resource_spans:
                    for scope in resource.scope_spans:
                        spans.extend(scope.spans)
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def of_trace(self, trace_id: str, name: str) -> Any:
        """The one span of this name in the trace, once it has come."""
        end = time.monotonic() + 20
        while time.monotonic() < end:
            found = [span for span in self.spans if span.name == name and span.trace_id.hex() == trace_id]
            if found:
                (span,) = found
                return span
            time.sleep(0.1)
        raise AssertionError(f"{name} is not among {sorted({span.name for span in self.spans})}")


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    collecting = Collector()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{collecting.server.server_port}")
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "200")
    yield collecting
    collecting.server.shutdown()
    collecting.server.server_close()


@pytest.mark.server
def test_a_job_is_one_trace_from_the_callers_span_to_its_last_stage(
    collector: Collector, scene: Path
) -> None:
    trace_id = "4bf92f3577b34da6a3ce929d0e0e4736"
    with (
        short_folder() as folder,
        running_service(folder, traces="otlp", job_command=(sys.executable, str(PROGRAM))) as service,
        httpx.Client(base_url=service.url, timeout=60.0) as http,
    ):
        dataset = ready_dataset(http, scene)
        body = {"dataset_id": dataset, "options": {"preset": "fast", "steps": 20, "seed": 5}}
        headers = {"traceparent": f"00-{trace_id}-00f067aa0ba902b7-01"}
        job = http.post("/v1/jobs", json=body, headers=headers).json()["id"]
        assert finished(http, job)["state"] == "succeeded"
        http.get("/readyz")
        request, submit, attempt, coarse = (
            collector.of_trace(trace_id, name)
            for name in ("POST /v1/jobs", "submit", "attempt", "stage coarse")
        )
    assert request.parent_span_id.hex() == "00f067aa0ba902b7"
    assert submit.parent_span_id == request.span_id
    assert attempt.parent_span_id == submit.span_id
    assert coarse.parent_span_id == attempt.span_id
    told = {item.key: item.value for item in attempt.attributes}
    assert told["biresnerf.job"].string_value == job
    assert attempt.start_time_unix_nano <= coarse.start_time_unix_nano < coarse.end_time_unix_nano
    assert "GET /readyz" not in {span.name for span in collector.spans}


def test_without_traces_nothing_of_opentelemetry_is_set_up() -> None:
    program = "import sys, service.server, workers.queue.slot; print('opentelemetry.sdk' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
