"""Metrics for Prometheus.

Requests and streams are counted by the web processes of one port (`collected`), which is one scrape target.
prometheus_client keeps their counters in files that all of them read (`PROMETHEUS_MULTIPROC_DIR`, set by
`service.processes`). Counters of ended processes are kept, their gauges dropped.
Queue, jobs, stages and slots belong to the whole installation and are read from the database at each scrape; every
replica reports the same, and workers need no port.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import psutil
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.exposition import choose_encoder
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead
from prometheus_client.registry import Collector

from biresnerf import __version__
from biresnerf.wire.jobs import EventType
from service.processes import COUNTERS_VARIABLE
from workers.database.statistics import Statistics

_ANSWER_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
# Tally in the database -> metric, name of its label, help text.
_COUNTERS = {
    "job_events": (
        "biresnerf_job_events",
        "type",
        "Entries of jobs' histories: queued, started, succeeded …",
    ),
    "job_failures": ("biresnerf_job_failures", "code", "Failed jobs by the code of their error."),
    "job_faults": (
        "biresnerf_job_faults",
        "code",
        "Faults of ours that jobs went on without: evidence was missing.",
    ),
    "job_requeues": ("biresnerf_job_requeues", "why", "Jobs given back; why=worker_lost is a take-over."),
    "processor_seconds": (
        "biresnerf_use_processor_seconds",
        "tenant",
        "Processor seconds of attempts that ended.",
    ),
    "wall_seconds": ("biresnerf_use_wall_seconds", "tenant", "How long attempts took that ended."),
    "gpu_seconds": ("biresnerf_use_gpu_seconds", "tenant", "How long attempts had a GPU that ended."),
    "webhook_attempts": ("biresnerf_webhook_attempts", "result", "Deliveries of webhook messages tried."),
    "stored_files": ("biresnerf_stored_files", "", "Files stored in datasets."),
    "stored_bytes": ("biresnerf_stored_bytes", "", "Bytes of the files stored in datasets."),
}
# The columns of the view queue_depth, by kind of slot.
_QUEUE = (
    ("biresnerf_queue_waiting", "Jobs that need a slot.", "waiting"),
    ("biresnerf_queue_held", "Jobs that wait for their tenant's limit.", "held"),
    ("biresnerf_queue_running", "Jobs that need the slot of this kind on which they run.", "running"),
    ("biresnerf_queue_oldest_seconds", "Age of the oldest job that waits for a slot.", "oldest_s"),
)
# Reported as 0 before they first happen: a rate needs the zero before the one.
_FROM_ZERO: dict[str, tuple[str, ...]] = {
    "job_events": get_args(EventType),
    "job_failures": ("engine_error", "timeout", "too_many_crashes"),
    "job_faults": ("seeding_crashed",),
    "job_requeues": ("disk_full", "lost", "shutdown", "store_away", "worker_lost"),
    "webhook_attempts": ("delivered", "failed"),
}
_DURATIONS = {
    "stage_seconds": ("biresnerf_stage_seconds", "stage", "Time that jobs spent in each stage."),
    "job_seconds": ("biresnerf_job_seconds", "state", "Time from submission to the end, by final state."),
    "queue_wait_seconds": ("biresnerf_queue_wait_seconds", "", "Time from submission to the first start."),
}


class WebMetrics:
    """The metrics that one web process counts."""

    def __init__(self) -> None:
        forget_predecessor()
        self.registry = CollectorRegistry()
        at = ("method", "route")
        self.requests = self._counter("biresnerf_http_requests", "Requests answered.", *at, "status")
        self.received = self._counter("biresnerf_http_request_bytes", "Bytes of bodies received.", *at)
        self.sent = self._counter("biresnerf_http_response_bytes", "Bytes of bodies sent.", *at)
        self.answer_s = Histogram(
            "biresnerf_http_answer_seconds",
            "Time until an answer began (its body may stream for long after that).",
            at,
            buckets=_ANSWER_S,
            registry=self.registry,
        )
        self.under_way = self._gauge(
            "biresnerf_http_requests_under_way", "Requests not answered in full yet."
        )
        self.listeners = self._gauge("biresnerf_event_listeners", "Clients that follow a job's events.")

    def _counter(self, name: str, help_text: str, *labels: str) -> Counter:
        return Counter(name, help_text, labels, registry=self.registry)

    def _gauge(self, name: str, help_text: str) -> Gauge:
        return Gauge(name, help_text, registry=self.registry, multiprocess_mode=LIVING)


class Exposition(Collector):
    """One scrape: the metrics of the web processes, and of the installation while the database answers."""

    def __init__(self, web: WebMetrics, installation: Statistics | None) -> None:
        self._web, self._installation = web, installation

    def collect(self) -> Iterable[Metric]:
        """All metric families."""
        yield InfoMetricFamily("biresnerf_build", "What runs here.", {"version": __version__})
        yield from collected(self._web.registry)
        answers = self._installation is not None
        yield GaugeMetricFamily(
            "biresnerf_database_up", "1 while the database answers this process.", answers
        )
        if self._installation is not None:
            yield from _families(self._installation)

    def rendered(self, accept: str) -> tuple[bytes, str]:
        """The text and its media type, in the format that the scraper accepts."""
        encode, media_type = choose_encoder(accept)
        registry = CollectorRegistry()
        registry.register(self)
        return encode(registry), media_type


def _families(now: Statistics) -> Iterator[Metric]:
    yield _by_state("biresnerf_jobs", "Jobs by state.", now.jobs)
    yield _by_state("biresnerf_datasets", "Datasets by state.", now.datasets)
    late = "How long the most urgent webhook message is overdue: grows where no dispatcher runs."
    for name, help_text, amount in (
        ("trash", "Folders of files that wait for deletion.", now.trash),
        ("webhooks_pending", "Webhook messages to send.", now.webhooks_pending),
        ("webhooks_late_seconds", late, now.webhooks_late_s),
    ):
        yield GaugeMetricFamily(f"biresnerf_{name}", help_text, amount)
    for name, help_text, column in _QUEUE:
        depth = GaugeMetricFamily(name, help_text, labels=["kind"])
        for row in now.queue:
            depth.add_metric([row["slot_kind"]], row[column])
        yield depth
    slots = GaugeMetricFamily("biresnerf_slots", "Living worker slots.", labels=["kind", "busy"])
    for slot in now.slots:
        slots.add_metric([slot["kind"], str(slot["busy"]).lower()], slot["slots"])
    yield slots
    for tally, (name, label, help_text) in _COUNTERS.items():
        counter = CounterMetricFamily(name, help_text, labels=[label] if label else [])
        found = {item["label"]: item["amount"] for item in now.tallies if item["name"] == tally}
        for value in sorted({*found, *_FROM_ZERO.get(tally, () if label else ("",))}):
            counter.add_metric([value] if label else [], found.get(value, 0.0))
        yield counter
    for tally, (name, label, help_text) in _DURATIONS.items():
        durations = [item for item in now.tallies if item["name"] == tally]
        yield _histogram(name, help_text, label, durations, now.bounds_s)


def _by_state(name: str, help_text: str, values: Mapping[Any, float]) -> Metric:
    family = GaugeMetricFamily(name, help_text, labels=["state"])
    for state, value in values.items():
        family.add_metric([state], value)
    return family


def _histogram(
    name: str, help_text: str, label: str, tallies: list[dict[str, Any]], bounds_s: list[float]
) -> Metric:
    family = HistogramMetricFamily(name, help_text, labels=[label] if label else [])
    for value in sorted({item["label"] for item in tallies}):
        mine = [item for item in tallies if item["label"] == value]
        counts = {item["bucket"]: item["count"] for item in mine}
        buckets, below = [], 0
        # A duration in bucket i is less than bound i; one more bucket has those beyond the last bound.
        for index, bound in enumerate((*bounds_s, float("inf"))):
            below += counts.get(index, 0)
            buckets.append(("+Inf" if bound == float("inf") else f"{bound:g}", float(below)))
        family.add_metric([value] if label else [], buckets, sum_value=sum(item["amount"] for item in mine))
    return family


# Gauges are summed over living processes.
LIVING: Literal["livesum"] = "livesum"


def forget_predecessor() -> None:
    """Call it before the first metric is made: this process may have the PID of one that ended."""
    folder = os.environ.get(COUNTERS_VARIABLE)
    if folder:
        mark_process_dead(os.getpid(), folder)


def collected(registry: CollectorRegistry) -> Iterable[Metric]:
    """The metrics of this process, or of all that share its port; system metrics then have a label `pid`."""
    folder = os.environ.get(COUNTERS_VARIABLE)
    if not folder:
        return [*registry.collect(), *ProcessCollector(registry=None).collect()]
    living = []
    for file in Path(folder).glob(f"gauge_{LIVING}_*.db"):
        pid = int(file.stem.rpartition("_")[2])
        if psutil.pid_exists(pid):
            living.append(pid)
        else:
            mark_process_dead(pid, folder)
    return [*MultiProcessCollector(None, folder).collect(), *_of_system(sorted(living))]


def _of_system(pids: list[int]) -> Iterable[Metric]:
    families: dict[str, Metric] = {}
    for pid in pids:
        for found in ProcessCollector(pid=partial(int, pid), registry=None).collect():
            family = families.setdefault(found.name, Metric(found.name, found.documentation, found.type))
            family.samples += [
                sample._replace(labels={**sample.labels, "pid": str(pid)}) for sample in found.samples
            ]
    return families.values()
