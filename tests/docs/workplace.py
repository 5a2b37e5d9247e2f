"""Where documented commands run: a folder with everything that pages name, and one real service."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from click.testing import CliRunner

import biresnerf.pipeline
from biresnerf.command_line import cli
from biresnerf.commands.poses.make_scene import make_scene
from biresnerf.options.refine_options import RefineOptions
from tests.docs.forms_of_commands import command_context, words_of
from tests.docs.small_runs import SIZE, VIEWS, small_runs
from tests.service.conftest import Running, finished, new_dataset, operator, ready_dataset

# They load torch, so they run in this process; all others run as a shell runs them.
LOCAL = {"refine", "export", "make-scene", "evaluate", "convert", "inspect"}
# What pages call a set of photos with poses, and its true poses.
SETS = ("photos", "INPUT", "SCENE", "lego_100")
TRUTHS = ("TRUTH", "reference")


@dataclass(frozen=True)
class Workplace:
    """A folder for one page's commands.

    Attributes:
        folder: where they run.
        service: the real service that they ask.
        job: one that is done.
    """

    folder: Path
    service: Running
    job: str

    def run(self, text: str) -> None:
        """Runs a shell command with what it names put in its place. Raises AssertionError where it fails."""
        text = self._with_real_names(text)
        variables, words = words_of(text)
        if words and words[0] == "biresnerf":
            self._make_room(words[1:])
            if words[1] in LOCAL and not variables:
                return self._run_here(words[1:])
        if words and words[0] == "python":
            return self._run_script(Path(words[1]), words[2:])
        self._run_in_shell(text)

    def run_python(self, text: str) -> None:
        """Runs a block of Python where the page's files are. Raises what it raises."""
        shutil.rmtree(self.folder / "out", ignore_errors=True)  # as in `_make_room`
        text = text.replace("http://127.0.0.1:8000", self.service.url)
        with chdir(self.folder), small_runs():
            exec(compile(self._with_real_names(text), "documented.py", "exec"), {"__name__": "documented"})

    def _run_here(self, words: list[str]) -> None:
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            with chdir(self.folder), small_runs():
                done = CliRunner().invoke(cli, words, catch_exceptions=False, standalone_mode=False)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        assert done.exit_code == 0, done.output
        assert done.return_value in (None, 0), done.output

    def _run_script(self, script: Path, words: list[str]) -> None:
        """A script in this process, which makes its refinement small."""
        before = sys.argv, list(sys.path)
        try:
            sys.argv = [str(script), *words]
            sys.path.insert(0, str(script.parent))
            with chdir(self.folder), small_runs():
                runpy.run_path(str(script), run_name="__main__")
        finally:
            sys.argv, sys.path[:] = before

    def _run_in_shell(self, text: str) -> None:
        (self.folder / ".curlrc").write_text("silent\nshow-error\nfail-with-body\nmax-time = 60\n")
        environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "CURL_HOME": str(self.folder),
            "BIRESNERF_URL": self.service.url,
            "BIRESNERF_DATA_DIR": str(self.service.data_dir),
            "api": f"{self.service.url}/v1",
            "NO_COLOR": "1",
        }
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, f"{text}\nsaid:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"

    def _make_room(self, words: list[str]) -> None:
        """Another command of the page may have written to the same place, which is refused."""
        output = command_context(words).params.get("output")
        if output is not None and words[0] not in {"export", "make-scene"}:
            shutil.rmtree(self.folder / output, ignore_errors=True)

    def _with_real_names(self, text: str) -> str:
        for pattern, real in self._names().items():
            if re.search(pattern, text):
                text = re.sub(pattern, real() if callable(real) else real, text)
        return text

    def _names(self) -> dict[str, str | Callable[[], str]]:
        """What stands for something in the pages, and what it is here; made where it is named."""
        return {
            r"\bJOB(?=/cancel)|(?<=cancel )JOB\b": self._new_job,
            r"\bJOB\b|\bjob_…": self.job,
            r"\bBATCH\b": self._new_batch,
            r"\bDS\b": self._new_dataset,
            r"\bds_…": self._ready_dataset,
            r"\bUP\b": self._new_upload,
            r"\bbrn_…": lambda: self._new_key()["key"],
            r"\bkey_01J…": lambda: self._new_key()["id"],
            r"\bwhsec_…": "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
            r"https://hooks\.example\.org/poses": "http://127.0.0.1:9/in",
            r"https://photos\.example\.org/": "http://127.0.0.1:9/",
            r"http://127\.0\.0\.1:80[08]0": self.service.url,
            r"/backups/biresnerf": str(self.folder / "backup"),
            r"\bexamples/(?=\w+\.py)": f"{Path(__file__).resolve().parents[2]}/examples/",
        }

    def _http(self) -> httpx.Client:
        return httpx.Client(base_url=self.service.url, timeout=60.0)

    def _new_job(self) -> str:
        with self._http() as http:
            body = {"dataset_id": ready_dataset(http, self.folder / "photos")}
            return str(http.post("/v1/jobs", json=body).json()["id"])

    def _new_batch(self) -> str:
        with self._http() as http:
            body = {"jobs": [{"dataset_id": ready_dataset(http, self.folder / "photos")}]}
            return str(http.post("/v1/batches", json=body).json()["id"])

    def _new_dataset(self) -> str:
        with self._http() as http:
            return new_dataset(http)

    def _ready_dataset(self) -> str:
        with self._http() as http:
            return ready_dataset(http, self.folder / "photos")

    def _new_upload(self) -> str:
        length = str((self.folder / "photos.zip").stat().st_size)
        with self._http() as http:
            headers = {"Tus-Resumable": "1.0.0", "Upload-Length": length}
            made = http.post(f"/v1/datasets/{new_dataset(http)}/uploads", headers=headers)
            return made.headers["location"].rsplit("/", 1)[1]

    def _new_key(self) -> Any:
        return operator(self.service.data_dir, "keys", "create", "documented")

    def clear_the_queue(self) -> None:
        """Ends what the page has left waiting, which nobody looks at."""
        with self._http() as http:
            for job in http.get("/v1/jobs", params={"limit": 100}).json()["items"]:
                if job["state"] in {"queued", "running"}:
                    http.post(f"/v1/jobs/{job['id']}/cancel")


def furnish(folder: Path) -> Path:
    """Puts the sets and truths that pages name into a new folder; returns it."""
    make_scene(folder / "photos", views=VIEWS, size=SIZE, seed=1)
    for name in SETS[1:]:
        (folder / name).symlink_to("photos")
    for name in TRUTHS:
        (folder / name).mkdir()
        shutil.copyfile(folder / "photos.truth.json", folder / name / "transforms.json")
    with zipfile.ZipFile(folder / "photos.zip", "w") as archive:
        for path in sorted((folder / "photos").rglob("*")):
            archive.write(path, path.relative_to(folder))
    return folder


def make_result(folder: Path) -> None:
    """A finished refinement of the photos, which pages call OUT, and another one, OUT2."""
    with small_runs():
        for seed, name in enumerate(("OUT", "OUT2")):
            options = RefineOptions(preset="fast", seed=seed)
            biresnerf.pipeline.refine_poses(folder / "photos", folder / name, options)


def done_job(service: Running, photos: Path) -> str:
    """A finished job on the photos."""
    with httpx.Client(base_url=service.url, timeout=60.0) as http:
        body = {"dataset_id": ready_dataset(http, photos), "options": {"preset": "fast"}}
        job = http.post("/v1/jobs", json=body).json()
        done = finished(http, job["id"], 300.0)
    assert done["state"] == "succeeded", done
    return str(done["id"])
