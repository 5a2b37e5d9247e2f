"""Telling a job that ran out of memory from one that crashed, and what a second try does with less."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from biresnerf.wire.problems import JobError

# What a second try takes instead: the divisor, or what is subtracted, and the least that is allowed.
DIVIDED: dict[str, tuple[int, int]] = {"samples_per_step": (4, 1024), "max_image_size": (2, 64)}
LOWERED: dict[str, tuple[int, int]] = {"table_size_log2": (2, 10)}
CHOSEN: dict[str, str] = {"seeding_effort": "low"}


def smaller_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that a second try uses with less; empty where nothing is left to lessen."""
    changed: dict[str, Any] = {}
    for name, (divisor, least) in DIVIDED.items():
        changed[name] = max(least, options[name] // divisor) if options.get(name) else None
    for name, (by, least) in LOWERED.items():
        changed[name] = max(least, options[name] - by) if options.get(name) else None
    lessened = {name: value for name, value in changed.items() if value is not None and value < options[name]}
    return lessened | {name: least for name, least in CHOSEN.items() if options.get(name, least) != least}


def out_of_memory(smaller: Mapping[str, Any], log_tail: str) -> JobError:
    """The error of a job that ran out of memory and is not tried again."""
    tried = ", ".join(f"{name}={value}" for name, value in smaller.items())
    return JobError(
        code="out_of_memory",
        detail="The job needs more memory than the machine has"
        + (f", also in a second try with {tried}." if tried else "."),
        hint="Ask for smaller images (max_image_size), fewer samples_per_step, a smaller table_size_log2 or "
        "fewer images, or use a machine (or GPU) with more memory.",
        log_tail=log_tail,
    )


class OomKills:
    """Counts the processes that the kernel has killed for want of memory, in this container or on this machine.

    The container's own count where there is one (control groups of version 2 or 1), else the machine's.
    """

    def __init__(self, proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> None:
        self._files = [*_group_files(proc, groups), proc / "vmstat"]

    def count(self) -> int | None:
        """How many so far; none where the kernel does not say."""
        for path in self._files:
            try:
                found = re.search(r"^oom_kill (\d+)$", path.read_text(), re.MULTILINE)
            except OSError:
                continue
            if found is not None:
                return int(found[1])
        return None


def _group_files(proc: Path, groups: Path) -> list[Path]:
    """Where this process's memory control group counts; inside a container its own group is the root."""
    found = []
    try:
        lines = (proc / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return []
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0" and not controllers:
            found += [groups / path.lstrip("/") / "memory.events", groups / "memory.events"]
        elif "memory" in controllers.split(","):
            memory = groups / "memory"
            found += [memory / path.lstrip("/") / "memory.oom_control", memory / "memory.oom_control"]
    return found
