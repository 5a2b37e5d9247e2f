"""All that a machine with a GPU can tell of the CUDA backend, in one file: ``python -m benchmarks.gpu.gpu_report``.

Checks the kernels, runs the tests that need a GPU, times steps and a whole job on a made scene, and writes what each
command printed to gpu-report.txt. The kernels are compiled on the way.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPORT = Path("gpu-report.txt")
LIMIT_S = 900
PYTHON = (sys.executable, "-m")


def commands(work: Path) -> list[tuple[str, ...]]:
    """What is run, in this order."""
    scene, biresnerf = work / "scene", (str(Path(sys.executable).parent / "biresnerf"),)
    gpu_tests = ("tests/field/cuda", "tests/field/test_device_occupancy.py", "tests/refinement/optimise")
    return [
        ("nvidia-smi",),
        (*biresnerf, "doctor"),
        (*PYTHON, "biresnerf.field.cuda.device_check"),
        (*PYTHON, "pytest", "-q", "-n", "0", *gpu_tests),
        (*PYTHON, "benchmarks"),
        (*biresnerf, "make-scene", str(scene), "--views", "60", "--size", "400", "--seed", "1"),
        (*biresnerf, "refine", str(scene), "-o", str(work / "out"), "--preset", "fast", "--device", "cuda"),
        (*biresnerf, "evaluate", str(work / "out"), f"{scene}.truth.json"),
        ("nvidia-smi",),
    ]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, REPORT.open("w") as report:
        for command in commands(Path(folder)):
            print(*command)
            began = time.monotonic()
            try:
                done = subprocess.run(
                    command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S
                )
                status, output = str(done.returncode), done.stdout
            except subprocess.TimeoutExpired as error:
                status, output = "none in time", str(error.stdout)
            except FileNotFoundError as error:
                status, output = "not there", str(error)
            seconds = time.monotonic() - began
            report.write(f"$ {' '.join(command)}\n{output}\nexit status {status}, {seconds:.1f} s\n\n")
            report.flush()
    print(f"see {REPORT}")


if __name__ == "__main__":
    main()
