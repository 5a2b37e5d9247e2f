"""What the page weighs, and how soon it can be used: `python -m benchmarks.service.web_page [--runs N]`.

Starts a service, runs one small job on it, and opens the list and the job's page in Chromium, each time with an empty
cache: on this machine's own network, and on a line of 1.6 Mbit/s with 150 ms to and fro. A page can be used from when
its main control is drawn and no task of more than 50 ms runs any more.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import statistics
import tempfile
import time
import zipfile
from collections import defaultdict
from pathlib import Path

import httpx
from playwright.sync_api import Browser, sync_playwright

from biresnerf.data.synthetic.scene import write_synthetic_scene
from service.commands.temporary_service import temporary_service

CONTROLS = {"list": ".drop-buttons .act", "job": ".scene-slider input"}
QUIET_MS = 1500
PATIENCE_MS = 300_000
LINES = {
    "this machine": None,
    "1.6 Mbit/s, 150 ms": {
        "offline": False,
        "downloadThroughput": 1.6e6 / 8,
        "uploadThroughput": 0.75e6 / 8,
        "latency": 150,
    },
}
OPTIONS = {
    "preset": "fast",
    "steps": 300,
    "max_image_size": 64,
    "samples_per_step": 8192,
    "start": "given",
    "trial_steps": 50,
    "orbit_frames": 8,
}
# Notes when the control appeared and when the last long task ended, both in ms since the page was asked for.
WATCH = """selector => {
  window.seen = {shown: null, busy: 0};
  new PerformanceObserver(list => list.getEntries().forEach(
    task => { window.seen.busy = task.startTime + task.duration; })).observe({type: "longtask", buffered: true});
  const look = () => {
    if (document.querySelector(selector)) window.seen.shown = performance.now();
    else requestAnimationFrame(look);
  };
  look();
}"""


def _finished_job(url: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        write_synthetic_scene(Path(folder), n_views=24, size=96, seed=1)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for path in sorted(Path(folder).rglob("*")):
                archive.write(path, path.relative_to(folder))
    with httpx.Client(base_url=f"{url}/v1", timeout=90.0) as http:
        form = {"options": json.dumps(OPTIONS)}
        job = http.post("/jobs", data=form, files={"archive": packed.getvalue()}).raise_for_status().json()
        while job["state"] in {"queued", "running"}:
            job = http.get(f"/jobs/{job['id']}", params={"wait": 60}).raise_for_status().json()
    if job["state"] != "succeeded":
        raise SystemExit(f"the job {job['state']}: {job['error']}")
    return str(job["id"])


def _visit(browser: Browser, url: str, control: str, line: dict[str, float] | None) -> dict[str, float]:
    """Bytes over the wire by kind, and milliseconds, of one visit with an empty cache."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    wire = context.new_cdp_session(page)
    wire.send("Network.enable")
    if line is not None:
        wire.send("Network.emulateNetworkConditions", line)
    kinds: dict[str, str] = {}
    found: dict[str, float] = defaultdict(float)
    wire.on("Network.responseReceived", lambda said: kinds.update({said["requestId"]: said["type"]}))

    def count(said: dict[str, float | str]) -> None:
        found[f"{kinds.get(str(said['requestId']), 'Other')} bytes"] += float(said["encodedDataLength"])

    wire.on("Network.loadingFinished", count)
    page.add_init_script(f"({WATCH})({json.dumps(control)})")
    page.goto(url)
    page.wait_for_selector(control, timeout=PATIENCE_MS)
    quiet = f"() => performance.now() - Math.max(window.seen.busy, window.seen.shown) > {QUIET_MS}"
    page.wait_for_function(quiet, timeout=PATIENCE_MS)
    found["total bytes"] = sum(value for name, value in found.items() if name.endswith(" bytes"))
    found["first paint ms"] = page.evaluate(
        "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    )
    usable = page.evaluate("Math.max(window.seen.busy, window.seen.shown)")
    found["usable ms"] = max(usable, found["first paint ms"])
    context.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        raise SystemExit("There is no Chromium; on Debian: apt install chromium")
    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with temporary_service() as url, sync_playwright() as playwright:
        pages = {"list": f"{url}/", "job": f"{url}/#/jobs/{_finished_job(url)}"}
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        began = time.strftime("%Y-%m-%d %H:%M")
        print(f"{began}, Chromium {browser.version}, median of {runs} visits with an empty cache")
        for name, address in pages.items():
            for line, conditions in LINES.items():
                visits = [_visit(browser, address, CONTROLS[name], conditions) for _ in range(runs)]
                print(f"\n{name}, {line}")
                for figure in visits[0]:
                    print(f"  {figure:<20} {statistics.median(visit[figure] for visit in visits):>10,.0f}")
        browser.close()


if __name__ == "__main__":
    main()
