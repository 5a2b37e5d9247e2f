"""A job program for the tests of the page: finds ever more matches in a set, as COLMAP might, until it is ended.

The protocol of `workers.run.job_process` and the library's own previews; no COLMAP, no torch. If the given poses are to
be used, which need no matches, the real program takes over.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import time
from pathlib import Path

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.seeding.seeding_preview import write_seeding_preview
from biresnerf.data.seeding.seeding_progress import SeedingProgress
from biresnerf.progress import Progress

LOOK_S = 0.5
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
folder = Path(sys.argv[1])
order = json.loads((folder / "job.json").read_text())
if order["options"].get("start") == "given":
    os.execv(sys.executable, [sys.executable, "-m", "workers.run.job_process", str(folder)])
preview = folder / order["output"] / "preview"
preview.mkdir(parents=True)
dataset = read_dataset(folder / order["input"])
pairs = list(itertools.combinations(range(len(dataset) - 1), 2))  # the last photo matches none
for look in itertools.count(1):
    found = SeedingProgress(dict.fromkeys(range(len(dataset)), 500), dict.fromkeys(pairs[: 9 * look], 30))
    paths = write_seeding_preview(dataset, found, preview, None)
    progress = Progress(
        stage="seeding",
        fraction=0.01,
        message=f"look {look}",
        preview=tuple(f"preview/{path.name}" for path in paths),
    )
    sys.stdout.write(progress.model_dump_json() + "\n")
    sys.stdout.flush()
    time.sleep(LOOK_S)
    if ended:
        sys.exit(143)
