"""Memory as the kernel tells it: of the machine, and of control groups of both versions."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from biresnerf.machine import free_memory, memory_limit

MIB, GIB = 2**20, 2**30


def container(folder: Path, groups: str, limits: dict[str, str]) -> tuple[Path, Path]:
    """The files of a machine whose kernel says so."""
    (folder / "proc/self").mkdir(parents=True)
    (folder / "proc/self/cgroup").write_text(groups)
    for path, limit in limits.items():
        file = folder / "groups" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{limit}\n")
    return folder / "proc", folder / "groups"


V1, V2 = "memory/{}memory.limit_in_bytes", "{}memory.max"
UNLIMITED = str(2**63 - 4096)
MACHINES = {
    "v2, in a container": ("0::/\n", {V2.format(""): str(2 * GIB)}, 2 * GIB),
    "v2, in a group of a limited group": (
        "0::/pod/api\n",
        {V2.format("pod/api/"): "max", V2.format("pod/"): str(3 * GIB), V2.format(""): str(4 * GIB)},
        3 * GIB,
    ),
    "v2, without a limit": ("0::/\n", {V2.format(""): "max"}, None),
    "v1, whose path is the host's": ("4:cpu,memory:/docker/ab\n0::/\n", {V1.format(""): str(GIB)}, GIB),
    "v1, in a limited group": ("4:memory:/a\n", {V1.format("a/"): str(GIB), V1.format(""): UNLIMITED}, GIB),
    "v1, without a limit": ("4:memory:/\n", {V1.format(""): UNLIMITED}, None),
}


@pytest.mark.parametrize("machine", MACHINES)
def test_the_containers_limit_is_the_kernels(tmp_path: Path, machine: str) -> None:
    groups, limits, limit = MACHINES[machine]
    assert memory_limit(*container(tmp_path, groups, limits)) == limit


def test_without_control_groups_nothing_limits(tmp_path: Path) -> None:
    assert memory_limit(tmp_path, tmp_path) is None


FULL = {
    "v2": ("0::/pod\n", {"pod/memory.max": 3 * GIB, "pod/memory.current": 2 * GIB}, 5 * GIB, GIB),
    "v2, with files that nobody uses": (
        "0::/pod\n",
        {"pod/memory.max": 3 * GIB, "pod/memory.current": 2 * GIB, "pod/memory.stat": "inactive_file {}"},
        5 * GIB,
        GIB + 512 * MIB,
    ),
    "v1, with files that nobody uses": (
        "4:memory:/docker/ab\n",
        {
            "memory/memory.limit_in_bytes": 3 * GIB,
            "memory/memory.usage_in_bytes": 2 * GIB,
            "memory/memory.stat": "inactive_file 1\ntotal_inactive_file {}",
        },
        5 * GIB,
        GIB + 512 * MIB,
    ),
    "a machine with less than its group may have": (
        "0::/pod\n",
        {"pod/memory.max": 3 * GIB, "pod/memory.current": 2 * GIB},
        200 * MIB,
        200 * MIB,
    ),
    "a group over its limit": (
        "0::/pod\n",
        {"pod/memory.max": GIB, "pod/memory.current": GIB + MIB},
        5 * GIB,
        0,
    ),
    "no limit": ("0::/\n", {"memory.max": "max", "memory.current": 2 * GIB}, 5 * GIB, 5 * GIB),
}


@pytest.mark.parametrize("machine", FULL)
def test_free_is_what_neither_the_machine_nor_a_limited_group_uses(tmp_path: Path, machine: str) -> None:
    groups, files, available, free = FULL[machine]
    texts = {path: str(text).format(512 * MIB) for path, text in files.items()}
    proc, at = container(tmp_path, groups, texts)
    (proc / "meminfo").write_text(
        f"MemTotal: 999999999 kB\nMemFree: 1 kB\nMemAvailable:   {available // 1024} kB\n"
    )
    assert free_memory(proc, at) == free


def test_nothing_is_known_of_a_machine_without_these_files(tmp_path: Path) -> None:
    assert free_memory(tmp_path, tmp_path) is None


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="not Linux")
def test_this_machine_has_no_more_free_memory_than_psutil_says() -> None:
    free = free_memory()
    assert free is not None
    assert 0 < free <= psutil.virtual_memory().available + GIB
