"""Telling a job that ran out of memory from one that crashed, and what a second try does with less."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from biresnerf.options.refine_options import OPTIONS, ResolvedOptions
from biresnerf.wire.problems import JobError
from workers.process.memory_limits import GROUPS, PROC, group_files


def smaller_options(options: ResolvedOptions) -> dict[str, Any]:
    """Options of a second try that change to take less memory; empty if none can."""
    now = options.model_dump()
    less = {name: o.smaller(now[name]) for name, o in OPTIONS.items() if o.smaller is not None}
    return {name: value for name, value in less.items() if value != now[name]}


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

    def __init__(self, proc: Path = PROC, groups: Path = GROUPS) -> None:
        counts = group_files("memory.events", "memory.oom_control", proc, groups)
        self._files = [*counts, proc / "vmstat"]

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
