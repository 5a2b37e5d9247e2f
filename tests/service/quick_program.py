"""A job program for the tests: the protocol of `workers.run.job_process`, real result files, no torch.

`steps` says how many steps, `seed` how many milliseconds each takes; `threads=77` fails as a diverged job does. A job
that asks for parts is split into three.
Matches contradict all photos where `seed` is above 30.
"""

from __future__ import annotations

import json
import math
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any

from biresnerf.options.refine_options import parse_options
from biresnerf.progress import Progress
from biresnerf.report import Report
from service.docs.examples import example_of
from service.web_page import EXAMPLE
from workers.records import EXIT_SPLIT, SPLIT_NAME

folder = Path(sys.argv[1])
order = json.loads((folder / "job.json").read_text())
source, output = folder / order["input"], folder / order["output"]
steps, step_s = 0, 0.0
stopping = []
signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))


def tell(stage: str, step: int, **reported: Any) -> None:
    progress = Progress(
        stage=stage,
        step=step,
        steps_total=steps,
        fraction=step / steps,
        eta_s=(steps - step) * step_s,
        metrics={"loss": 1.0 / (step + 1)},
        **reported,
    )
    sys.stdout.write(progress.model_dump_json() + "\n")
    sys.stdout.flush()


if order.get("task") == "export":
    for form in order["options"]["formats"]:
        (output / f"{form}.txt").write_text("exported")
    sys.exit(0)
if order.get("split", {}).get("above", 1000) < 1000:
    (folder / SPLIT_NAME).write_text(json.dumps([{**order["options"], "photos": [name]} for name in "abc"]))
    sys.exit(EXIT_SPLIT)
resolved = parse_options(order["options"]).resolved("cpu")
options = resolved.model_dump(mode="json")
steps, step_s = options["steps"], options["seed"] / 1000
tell("preparing", 0, options=resolved)
sys.stderr.write("images read\nline 2\n")
if options["threads"] == 77:
    said = {"code": "diverged", "detail": "The loss is not finite.", "where": "", "hint": ""}
    (folder / "error.json").write_text(json.dumps(said))
    sys.exit(3)
for step in range(1, steps + 1):
    time.sleep(step_s)
    stage = "coarse" if step < steps / 2 else "fine"
    tell(stage, step)
    if step % 20 == 0:
        (output / "preview").mkdir(exist_ok=True)
        (output / "preview" / "poses.json").write_text(json.dumps({"step": step}))
        tell(stage, step, preview=("preview/poses.json",))
    if stopping:
        partial = {"state": "partial", "options": options, "images": []}
        (output / "poses.json").write_text(json.dumps({"step": step}))
        (output / "report.json").write_text(json.dumps(partial))
        sys.exit(143)
poses = next(source.rglob("transforms*.json"))
shutil.copy(poses, output / "transforms.json")
(output / "colmap" / "sparse" / "0").mkdir(parents=True)
for table in ("cameras", "images", "points3D"):
    (output / "colmap" / "sparse" / "0" / f"{table}.bin").write_bytes(bytes(8))
# Three photos of a real result; `seed` turns them apart, by as many degrees times their number.
document = json.loads((EXAMPLE / "poses.json").read_text())
document["images"] = [{**pose, "name": name} for pose, name in zip(document["images"], "abc", strict=False)]
for number, pose in enumerate(document["images"]):
    turn = math.radians(number * options["seed"])
    for row in pose["world_from_cam"]:
        x, y = row[:2]
        row[:2] = (x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn))
(output / "poses.json").write_text(json.dumps(document))
(output / "renders").mkdir()
(output / "renders" / "orbit.mp4").write_bytes(bytes(range(256)) * 40)
(output / "renders" / "Blick über «Dach».png").write_bytes(b"\x89PNG")
verdict = {
    "verdict": "kept_input",
    "returned": "input",
    "compared_with": "given",
    "why": ["No better."],
    "moved_px": 1,
}
example = example_of(Report)
known = {"known_from": "matches", "rotation_deg": 0.08}
image = {**example["images"][0], "uncertainty": known, "contradicted": options["seed"] > 30}
images = [
    {**image, "name": name, "moved_deg": moved, "trial_psnr_before": before, "trial_psnr_after": after}
    for name, moved, before, after in (("a", 1.0, None, None), ("b", 3.0, 20.0, 21.0), ("c", 2.0, 20.0, 24.0))
]
report = {**example, "options": options, "verdict": verdict, "images": images}
(output / "report.json").write_text(json.dumps(report))
tell("exporting", steps)
