"""What this process may use of the machine: processor cores and memory."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

PROC, GROUPS = Path("/proc"), Path("/sys/fs/cgroup")
# Version 1 of control groups writes "no limit" as a huge number.
NO_LIMIT = 2**60


def usable_cores() -> int:
    """Number of usable cores; fewer than the machine has where the process is bound to some of them."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory(proc: Path = PROC, groups: Path = GROUPS) -> int | None:
    """Bytes that this process may still take, by its machine and its control groups; None where neither says.

    What the kernel holds of files that nobody has used lately counts as free.
    """
    machine = _number(proc / "meminfo", r"^MemAvailable:\s+(\d+) kB")
    found = [] if machine is None else [1024 * machine]
    for folder, limit in _limits(proc, groups):
        for now, inactive in (
            ("memory.current", "inactive_file"),
            ("memory.usage_in_bytes", "total_inactive_file"),
        ):
            used = _number(folder / now, r"^(\d+)")
            if used is not None:
                given_up = _number(folder / "memory.stat", rf"^{inactive} (\d+)") or 0
                found.append(max(0, limit - max(0, used - given_up)))
    return min(found, default=None)


def memory_limit(proc: Path = PROC, groups: Path = GROUPS) -> int | None:
    """The lowest limit of this process's control groups (version 2 or 1), bytes; None if there is none."""
    return min((limit for _, limit in _limits(proc, groups)), default=None)


def _limits(proc: Path, groups: Path) -> Iterator[tuple[Path, int]]:
    """Folders of this process's memory control groups that have a limit, and the limit."""
    for path in group_files("memory.max", "memory.limit_in_bytes", proc, groups):
        limit = _number(path, r"^(\d+)")  # or "max"
        if limit is not None and limit < NO_LIMIT:
            yield path.parent, limit


def _number(path: Path, pattern: str) -> int | None:
    """What the pattern finds in a file of the kernel; None where it has no such line."""
    with suppress(OSError):
        found = re.search(pattern, path.read_text(), re.MULTILINE)
        return None if found is None else int(found[1])
    return None


def group_files(name: str, name_in_v1: str, proc: Path = PROC, groups: Path = GROUPS) -> list[Path]:
    """Possible paths of the file in this process's memory control groups, innermost first.

    Inside a container its own group is the root.
    """
    try:
        lines = (proc / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0" and not controllers:
            root, file = groups, name
        elif "memory" in controllers.split(","):
            root, file = groups / "memory", name_in_v1
        else:
            continue
        group = root / path.lstrip("/")
        found += [folder / file for folder in (group, *group.parents) if folder.is_relative_to(root)]
    return found
