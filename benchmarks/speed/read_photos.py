"""What reading photos takes: ``python -m benchmarks.speed.read_photos [--photos 200]``.

Makes JPEG photos of 12 MP, as `large_set` does. In a process of its own their headers are read, and then they are
decoded to working size. Prints the seconds of each, how many cores were busy, and the most memory that the process
held. The photos are removed at the end.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.speed.large_set import HEIGHT, WIDTH, make_set


def measured(path: Path, size: int) -> dict[str, float]:
    """Seconds, busy cores and memory of reading the set of a transforms file."""
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.photos.images import load_images

    found: dict[str, float] = {}
    started, busy = time.monotonic(), time.process_time()
    dataset = read_dataset(path)
    found["headers, s"] = time.monotonic() - started
    started, busy = time.monotonic(), time.process_time()
    images = load_images(dataset, size)
    seconds = time.monotonic() - started
    found |= {"pixels, s": seconds, "busy cores": (time.process_time() - busy) / seconds}
    found["result, MiB"] = images.pixels.nbytes / 2**20
    found["most memory, MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, default=200)
    parser.add_argument("--size", type=int, default=400, help="Long side of the photos at work, px.")
    parser.add_argument(
        "--one", type=Path, help=argparse.SUPPRESS
    )  # the transforms file, in a process of its own
    asked = parser.parse_args()
    if asked.one:
        print(json.dumps(measured(asked.one, asked.size)))
        return
    with tempfile.TemporaryDirectory(prefix="biresnerf-read-photos-") as folder:
        path = make_set(Path(folder), [asked.photos])[asked.photos]
        command = [sys.executable, "-m", "benchmarks.speed.read_photos", *sys.argv[1:], "--one", str(path)]
        answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    print(f"{asked.photos} photos of {WIDTH} x {HEIGHT} px, to {asked.size} px")
    for name, value in json.loads(answer.stdout.splitlines()[-1]).items():
        print(f"{name}: {value:.1f}")


if __name__ == "__main__":
    main()
