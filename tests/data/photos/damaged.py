"""Reads files with damaged bytes, in a process of its own: ``python -m tests.data.photos.damaged FOLDER SEED COUNT``.

Prints a JSON line for each try before and after it, so that a crash shows what it was reading.
"""

from __future__ import annotations

import json
import random
import resource
import sys
import time
import traceback
from pathlib import Path

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.image_files import DAMAGED, open_image, quiet_pillow, read_header
from biresnerf.data.photos.video.video_frames import VideoReading
from biresnerf.errors import InputError

VIDEO = ".mp4"
HEAD = 400  # bytes in which most of a file's structure lies


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Some bytes others, mostly near the beginning; a part left out, doubled, or cut off at the end."""
    out = bytearray(content)
    for _ in range(chance.choice([1, 2, 8, 64])):
        last = len(out) if chance.random() < 0.3 else min(HEAD, len(out))
        at = chance.randrange(last)
        out[at] = chance.choice(
            [0, 0x7F, 0x80, 0xFF, chance.randrange(256), out[at] ^ (1 << chance.randrange(8))]
        )
    begin = chance.randrange(len(out))
    end = min(len(out), begin + chance.choice([1, 4, 100, 5000]))
    cut = chance.random()
    if cut < 0.15:
        del out[begin:]
    elif cut < 0.3:
        del out[begin:end]
    elif cut < 0.4:
        out[begin:begin] = out[begin:end]
    return bytes(out)


def read(path: Path) -> str:
    """What comes of it: read, a fault by its code, or damaged, which readers of photos make a fault of."""
    try:
        if path.suffix == VIDEO:
            read_dataset(path, videos=VideoReading(4))
        else:
            read_header(path, path.name)
            with quiet_pillow(), open_image(path, path.name) as image:
                image.load()
    except InputError as error:
        return error.fault.code
    except DAMAGED:
        return "damaged"
    return "read"


def say(**facts: object) -> None:
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


def main(folder: Path, seed: int, count: int) -> None:
    for source in sorted(folder.iterdir()):
        if not source.is_file():
            continue
        for number in range(count):
            chance = random.Random(f"{seed} {source.name} {number}")
            place = folder / "damaged" / f"{source.name}_{number}"
            place.mkdir(parents=True)
            path = place / source.name
            path.write_bytes(damaged(source.read_bytes(), chance))
            say(begins=str(path))
            started = time.monotonic()
            try:
                outcome = read(path)
            except Exception:  # noqa: BLE001 - what nobody foresaw is what the test is for
                outcome = traceback.format_exc()
            say(file=str(path), outcome=outcome, s=time.monotonic() - started)
    say(peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
