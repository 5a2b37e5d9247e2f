"""Metrics of the web processes that share a port: a scrape reaches one of them, which answers for all.

prometheus_client keeps their counters in files that all of them read (`PROMETHEUS_MULTIPROC_DIR`, set by
`service.processes`). Counters of ended processes stay, gauges go.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Literal

import psutil
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import Metric
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead

from service.processes import COUNTERS_VARIABLE

# Of gauges: the sum over living processes.
LIVING: Literal["livesum"] = "livesum"


def prepare() -> None:
    """Before the first metric is made: a process may get the number of one that ended."""
    folder = os.environ.get(COUNTERS_VARIABLE)
    if folder:
        mark_process_dead(os.getpid(), folder)


def collected(registry: CollectorRegistry) -> Iterable[Metric]:
    """The metrics of this process, or of all that share its port; then those of the system have a label `pid`."""
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
