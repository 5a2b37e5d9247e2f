"""A full report on the CUDA backend from a machine with a GPU, in one file: ``python -m benchmarks.gpu.report``.

Runs from a plain checkout; only torch, Triton, Numba and NumPy must be installed. Other missing packages are named, and
taken from ``--wheels FOLDER``, which ``--gather FOLDER`` fills on a machine with a network. Each part is a process with
a time limit; if it fails, the next one follows. The file is written progressively. The parts, in order:

machine, kernels against the definition, ms a step of the field against plain torch and of the whole optimisation, whole
runs of each SET and a made scene with noisy poses in each preset, a profile of the kernels, and the tests that need a
GPU.

With ``--device cpu`` the same command runs without a GPU: kernels in Triton's interpreter, and runs on the CPU.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).resolve().parents[2]
# What a refinement and the tests import, and the packages that bring it. `imageio-ffmpeg` reads videos only.
NEEDED = {
    "pydantic": ("pydantic", "pydantic-core", "annotated-types", "typing-extensions", "typing-inspection"),
    "safetensors": ("safetensors",),
    "imageio": ("imageio",),
    "imageio_ffmpeg": ("imageio-ffmpeg",),
    "PIL": ("pillow",),
    "click": ("click",),
    "rich": ("rich", "markdown-it-py", "mdurl", "pygments"),
    "tqdm": ("tqdm",),
    "scipy": ("scipy",),
    "pycolmap": ("pycolmap",),
    "pytest": ("pytest", "pluggy", "iniconfig", "packaging"),
    "hypothesis": ("hypothesis", "sortedcontainers"),
}
PRESETS = "fast,balanced,paper"
GPU_TESTS = (
    "tests/field/cuda",
    "tests/field/test_device_occupancy.py",
    "tests/refinement/optimise/test_async_metrics.py",
    "tests/refinement/optimise/test_cuda_step.py",
    "tests/refinement/optimise/test_device_memory.py",
)
VERSIONS = """
import importlib.metadata as m, platform, torch
print("Python", platform.python_version(), platform.platform())
for name in ("torch", "triton", "numba", "numpy", "pydantic", "pycolmap"):
    try: print(name, m.version(name))
    except m.PackageNotFoundError: print(name, "is not installed")
print("CUDA", torch.version.cuda, torch.cuda.get_device_name() if torch.cuda.is_available() else "torch finds no GPU")
"""


@dataclass(frozen=True)
class Part:
    """One command of the report, with a name to choose it by."""

    name: str
    command: tuple[str, ...]
    limit_s: float


def parts(asked: argparse.Namespace, work: Path) -> Iterator[Part]:
    """The parts, in order."""
    python, scene = (sys.executable, "-m"), work / "made"
    biresnerf = (*python, "biresnerf.command_line")
    settings = tuple(
        word for setting in (f"device={asked.device}", *asked.set) for word in ("--set", setting)
    )
    yield Part("machine", ("nvidia-smi",), 60)
    yield Part("versions", (sys.executable, "-c", VERSIONS), 120)
    yield Part("kernels", (*python, "biresnerf.field.cuda.device_check", asked.device), 300)
    if asked.device == "cuda":
        yield Part("steps", (*python, "benchmarks.gpu.cuda_step"), 300)
        yield Part("whole-steps", (*python, "benchmarks.gpu.whole_step", "--profile"), 300)
    yield Part("scene", (*biresnerf, "make-scene", str(scene), "--views", asked.views, "--size", "400"), 300)
    for path in (*asked.sets, *([scene] if scene.exists() else [])):
        for preset in asked.presets.split(","):
            output = work / f"{path.name}-{preset}"
            run = (*biresnerf, "compare", str(path), "-o", str(output), "--preset", preset, *settings)
            yield Part("runs", run, asked.run_limit)
    if asked.device == "cuda":
        yield Part("profile", (*python, "benchmarks.gpu.cuda_step", "--profile"), 300)
        # Without the project's settings, which require plugins that these tests do not need.
        alone = ("-c", os.devnull, "--rootdir", str(ROOT), "-p", "no:cacheprovider")
        yield Part("tests", (*python, "pytest", "-v", "--tb=short", *alone, *GPU_TESTS), 600)


def missing() -> list[str]:
    """The required packages that this Python lacks."""
    return [
        package
        for module, packages in NEEDED.items()
        if importlib.util.find_spec(module) is None
        for package in packages
    ]


def gather(folder: Path, python: str, only: list[str]) -> None:
    """Fill a folder with wheels of all or some packages, for another Linux machine with this Python version."""
    target = (
        "--python-version",
        python,
        "--platform",
        "manylinux_2_28_x86_64",
        "--platform",
        "manylinux2014_x86_64",
    )
    packages = only or [name for names in NEEDED.values() for name in names]
    constraints = ("-c", str(ROOT / "constraints.txt"), "--only-binary", ":all:", "--no-deps", *target)
    download = (sys.executable, "-m", "pip", "download", "-q", "-d", str(folder), *constraints, *packages)
    subprocess.run(download, check=True)


def environment(asked: argparse.Namespace, work: Path) -> dict[str, str]:
    """The parts' environment: the checkout comes first on the path, then the wheels' packages."""
    unpacked = work / "packages"
    for wheel in sorted(asked.wheels.glob("*.whl")) if asked.wheels else ():
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(unpacked)
    interpreter = {"TRITON_INTERPRET": "1"} if asked.device == "cpu" else {}
    path = os.pathsep.join((str(ROOT), str(unpacked), os.environ.get("PYTHONPATH", "")))
    return os.environ | interpreter | {"PYTHONPATH": path.rstrip(os.pathsep), "PYTHONUNBUFFERED": "1"}


def run(part: Part, variables: dict[str, str], report: TextIO) -> str:
    """Run a part; returns how it ended. Its output goes to the report at once, even if this process dies."""
    try:
        done = subprocess.run(
            part.command,
            cwd=ROOT,
            env=variables,
            stdout=report,
            stderr=subprocess.STDOUT,
            timeout=part.limit_s,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {part.limit_s:g} s"
    except FileNotFoundError as error:
        return f"not there: {error}"
    return f"exit status {done.returncode}"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu.report", description=__doc__.splitlines()[0]
    )
    parser.add_argument("sets", nargs="*", type=Path, metavar="SET", help="folders with true poses")
    parser.add_argument("--out", type=Path, default=Path("gpu-report.txt"))
    parser.add_argument("--parts", help="only these, such as kernels,runs")
    parser.add_argument("--presets", default=PRESETS)
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="an option of all runs"
    )
    parser.add_argument("--views", default="60", help="photos of the made scene")
    parser.add_argument("--run-limit", type=float, default=600, help="seconds that a run may take")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--wheels", type=Path, help="a folder of wheels with what is missing here")
    parser.add_argument("--gather", type=Path, help="only fill such a folder, for --python")
    parser.add_argument("--python", default="3.12")
    parser.add_argument("--only", metavar="PACKAGE,...", help="those that a report named as missing")
    asked = parser.parse_args()
    if asked.gather:
        gather(asked.gather, asked.python, asked.only.split(",") if asked.only else [])
        return
    asked.sets = [path.resolve() for path in asked.sets]
    with tempfile.TemporaryDirectory() as folder, asked.out.open("w") as report:
        if lacking := missing():
            report.write(f"missing here, and needed from --wheels: {' '.join(lacking)}\n\n")
        variables = environment(asked, Path(folder))
        for part in parts(asked, Path(folder)):
            if asked.parts and part.name not in asked.parts.split(","):
                continue
            print(part.name, *part.command)
            report.write(f"===== {part.name}\n$ {' '.join(part.command)}\n")
            report.flush()
            began = time.monotonic()
            status = run(part, variables, report)
            report.write(f"{part.name}: {status}, {time.monotonic() - began:.1f} s\n\n")
            report.flush()
    print(f"see {asked.out}")


if __name__ == "__main__":
    main()
