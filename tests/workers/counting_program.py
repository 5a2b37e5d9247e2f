"""A job program that counts: the same protocol as `workers.run.job_process`, with faults on request and without torch.

The dataset's ``plan.json`` says how many steps, how long each takes and what goes wrong.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from biresnerf.options.refine_options import parse_options
from biresnerf.progress import Progress

folder = Path(sys.argv[1])
order = json.loads((folder / "job.json").read_text())
plan = json.loads((folder / order["input"] / "plan.json").read_text())
output = folder / order["output"]
state = output / "checkpoint" / "latest.json"
stopping = []
signal.signal(signal.SIGTERM, lambda *_: stopping.append(True))


whole = not order["options"].get("photos")
if whole and "parts" not in order and plan.get("parts"):
    asked = [{**order["options"], "photos": [f"{n}.jpg"], "verdict": False} for n in range(plan["parts"])]
    (folder / "split.json").write_text(json.dumps(asked))
    sys.exit(6)
if not whole and order["options"]["photos"][0] in plan.get("bad_parts", ()):
    plan["refuse"] = True


def tell(step: int, stage: str = "coarse", **reported: Any) -> None:
    total = plan["steps"]
    progress = Progress(
        stage=stage, step=step, steps_total=total, fraction=step / total, metrics={"loss": 1.0 / (step + 1)},
        **reported,
    )  # fmt: skip
    sys.stdout.write(progress.model_dump_json() + "\n")
    sys.stdout.flush()


def save(step: int) -> None:
    state.parent.mkdir(parents=True, exist_ok=True)
    fresh = state.with_suffix(".new")
    fresh.write_text(json.dumps({"step": step, "chain": chain}))
    fresh.rename(state)
    tell(step, checkpoint="checkpoint/latest.json")


def show(step: int) -> None:
    """A preview, as the refinement shows how far it is."""
    (output / "preview").mkdir(exist_ok=True)
    (output / "preview" / "poses.json").write_text(json.dumps({"step": step}))
    (output / "preview" / "report.json").write_text(json.dumps({"state": "partial", "steps": step}))
    tell(step, preview=("preview/poses.json", "preview/report.json", "../outside"))


begun = json.loads(state.read_text()) if state.exists() else {"step": 0, "chain": plan.get("seed", "")}
start, chain = begun["step"], begun["chain"]
with open(plan["journal"], "a") as journal:
    knows_database = "BIRESNERF_DATABASE_URL" in os.environ
    device = os.environ.get("CUDA_VISIBLE_DEVICES")
    said = {
        "pid": os.getpid(), "from": start, "database": knows_database, "at": time.time(), "device": device,
        "photos": order["options"].get("photos", []),
    }  # fmt: skip
    journal.write(json.dumps(said) + "\n")
sys.stderr.write(f"counting from {start}\n")
sys.stdout.write("a line of a library that is no report\n")
if plan.get("outdated") and state.exists():
    said = {
        "code": "checkpoint_invalid",
        "detail": "was written by another version.",
        "where": "",
        "hint": "",
    }
    (folder / "error.json").write_text(json.dumps(said))
    sys.exit(2)
if plan.get("refuse"):
    said = {
        "code": "pose_file_invalid",
        "detail": "pose 3 has NaN.",
        "where": "transforms.json",
        "hint": "Mend it.",
    }
    (folder / "error.json").write_text(json.dumps(said))
    sys.exit(2)
options = parse_options(order["options"]).resolved(plan.get("device", "cpu"))
tell(start, "preparing", options=options)
for step in range(start + 1, plan["steps"] + 1):
    time.sleep(plan["step_s"])
    # Right at the end only if no step was lost, repeated or begun from another state.
    chain = hashlib.sha256(f"{chain}{step}".encode()).hexdigest()
    tell(step)
    if step % plan.get("checkpoint_every", 5) == 0:
        save(step)
    if step == 7 and "no_room" in plan and Path(plan["no_room"]).exists():
        sys.exit(5)  # as `workers.run.job_process` says that the disk is full
    if plan.get("die_at") == step or step - start == plan.get("die_every"):
        sys.stderr.write("dying now\n")
        sys.stderr.flush()
        if "oom_counter" in plan:
            said, count = Path(plan["oom_counter"]).read_text().split()
            Path(plan["oom_counter"]).write_text(f"{said} {int(count) + 1}\n")
        os.kill(os.getpid(), signal.SIGKILL)
    if step % plan.get("preview_every", 10**9) == 0:
        show(step)
    if plan.get("hungry", 0) and step == 3 and options.max_image_size > plan["hungry"]:
        sys.exit(4)  # as `workers.run.job_process` says that memory ran out
    if stopping and plan.get("slow_to_end"):
        (output / "poses.json").write_text("half of a result")
    elif stopping and not plan.get("deaf"):
        save(step)
        (output / "poses.json").write_text(json.dumps({"step": step}))
        (output / "report.json").write_text(json.dumps({"state": "partial", "steps": step}))
        sys.exit(143)
joined = {
    part.name: sorted(path.name for path in part.iterdir()) for part in sorted((folder / "parts").glob("*"))
}
report = {"steps": plan["steps"], "from": start, "chain": chain, "joined": joined}
(output / "report.json").write_text(json.dumps(report))
if plan.get("poses"):
    (output / "poses.json").write_text("{}")
(output / "renders").mkdir()
(output / "renders" / "one.png").write_bytes(b"\x89PNG counted")
tell(plan["steps"], "exporting")
