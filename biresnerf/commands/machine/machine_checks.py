"""The checks of `biresnerf doctor` that need no service, one function each."""

from __future__ import annotations

import importlib.util
import json
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, TypeAlias

_COMPILE_S, _IMPORT_S = 900.0, 120.0
_WORK_BYTES = 2**30
_SLOW_S = 6.0  # loading from the cache takes less, compiling far more
# Processor time: on a busy machine loading takes long, too.
_TIME_KERNELS = """
import time
from biresnerf.compile_kernels import compile_kernels
began = time.process_time()
compile_kernels()
print(time.process_time() - began)
"""
_FIND_GPU = """
import json, torch
from biresnerf.field.backends import cuda_problem, gpu_faults
problem = cuda_problem()
faults = () if problem else gpu_faults(torch.device("cuda"))
print(json.dumps([problem, None if problem else torch.cuda.get_device_name(), faults]))
"""

# good: works; missing: only something optional is unavailable; broken: should work and does not.
State = Literal["good", "missing", "broken"]


@dataclass(frozen=True)
class Found:
    """The result of one check, with a hint on what to do unless it is good."""

    name: str
    state: State
    detail: str
    hint: str = ""


Check: TypeAlias = Callable[[], Found]


def versions() -> Found:
    """Python, and the packages that results depend on."""
    known = []
    for name in ("biresnerf", "torch", "numba", "numpy", "pycolmap"):
        try:
            known.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return Found("versions", "good", f"Python {platform.python_version()}, {', '.join(known)}")


def processor() -> Found:
    """Cores that this process may use."""
    from biresnerf.commands.machine.this_machine import describe_machine

    return Found("processor", "good", describe_machine())


def kernels() -> Found:
    """The CPU kernels, compiled or loaded in a process of their own."""
    hint = "Reinstall numba and its llvmlite: pip install --force-reinstall numba"
    output = _in_child("kernels", _TIME_KERNELS, _COMPILE_S, hint)
    if isinstance(output, Found):
        return output
    seconds = float(output.split()[-1])
    how = "compiled" if seconds > _SLOW_S else "loaded from the cache"
    return Found("kernels", "good", f"{how} in {seconds:.1f} s of processor time")


def gpu() -> Found:
    """Whether the CUDA kernels can run, and compute what they should. A GPU is optional."""
    hint = "Reinstall torch: https://pytorch.org/get-started/locally/"
    output = _in_child("GPU", _FIND_GPU, _COMPILE_S, hint)
    if isinstance(output, Found):
        return output
    problem, name, faults = json.loads(output.splitlines()[-1])
    if problem is not None:
        return Found(
            "GPU", "missing", f"not used: {problem}", "Optional: the CPU kernels do the same. docs/cuda.md"
        )
    if faults:
        return Found(
            "GPU", "broken", f"{name}: {'; '.join(faults)}",
            "Plain torch takes the place of its kernels. Update the driver, or use --device cpu. docs/cuda.md",
        )  # fmt: skip
    return Found("GPU", "good", f"{name}, kernels checked")


def colmap() -> Found:
    """pycolmap, loaded in a process of its own as `refine` does."""
    if importlib.util.find_spec("pycolmap") is None:
        return Found(
            "COLMAP", "missing", "is not installed: images without poses cannot be registered",
            "pip install 'biresnerf[colmap]'",
        )  # fmt: skip
    code = "import zlib, pycolmap; print(pycolmap.__version__)"
    output = _in_child("COLMAP", code, _IMPORT_S, "pip install --force-reinstall pycolmap")
    return (
        output
        if isinstance(output, Found)
        else Found("COLMAP", "good", f"pycolmap {output.strip()}, in its own process")
    )


def photos() -> Found:
    """What reads photos that Pillow alone does not."""
    from biresnerf.data.photos.kinds.photo_kinds import INSTALL, PHOTO_KINDS, is_readable

    unread = [kind.name for kind in PHOTO_KINDS if not is_readable(kind)]
    if unread:
        return Found("photos", "missing", f"{', '.join(unread)} cannot be read", INSTALL)
    return Found("photos", "good", f"{', '.join(kind.name for kind in PHOTO_KINDS)} can be read")


def video() -> Found:
    """The encoder for the orbit video."""
    import imageio_ffmpeg

    try:
        return Found("video", "good", Path(imageio_ffmpeg.get_ffmpeg_exe()).name)
    except RuntimeError as error:
        return Found("video", "broken", str(error), "pip install --force-reinstall imageio-ffmpeg")


def report_page() -> Found:
    """The built parts of report.html."""
    from biresnerf.viewer.report_html import BUNDLE

    if (BUNDLE / "report.js").is_file():
        return Found("report page", "good", "built")
    return Found("report page", "missing", "is not built: results come without report.html", "make web")


def scratch() -> Found:
    """Free space for temporary files."""
    folder = Path(tempfile.gettempdir())
    free = shutil.disk_usage(folder).free
    detail = f"{free / 2**30:.1f} GiB free in {folder}"
    if free > _WORK_BYTES:
        return Found("work files", "good", detail)
    return Found("work files", "broken", detail, "Free some space, or set TMPDIR to another folder.")


CHECKS: Sequence[Check] = (versions, processor, kernels, gpu, colmap, photos, video, report_page, scratch)


def _in_child(name: str, code: str, limit_s: float, hint: str) -> str | Found:
    """What Python code prints in a child process; or a broken check ``name`` if it fails."""
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Found(name, "broken", f"did not answer within {limit_s:.0f} s", hint)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        return Found(name, "broken", f"failed ({done.returncode}): {last[0]}", hint)
    return done.stdout
