"""Quick start and README, line by line as they are written, in the environment that their own lines make."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.documented import PYTHON, ROOT, commands_of
from tests.service.conftest import short_folder
from tests.service.free_port import free_port

WANTED = "BIRESNERF_TEST_INSTALL"
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(
        WANTED not in os.environ, reason=f"set {WANTED}, as make release does: it installs anew"
    ),
]
PAGES = ("docs/quick-start.md", "README.md")
# What the second page says again, or in further ways.
SAID_BEFORE = ("git clone ", "python3 -m venv ", "pip install ", "make ")
# How this machine reaches what is installed; npm's file is in the home folder.
REGISTRIES, NPM = ("pip_", "ssl_", "npm_", "node_", "http_", "https_", "no_proxy"), ".npmrc"
# A set of the reader's own.
PHOTOS = "biresnerf make-scene photos --views 8 --size 48 --noise 0.05 --seed 2"


def test_a_reader_gets_what_the_pages_say_by_their_lines_alone(tmp_path):
    if (Path.home() / NPM).is_file():
        shutil.copyfile(Path.home() / NPM, tmp_path / NPM)
    with short_folder() as data:
        environment = {
            # The Python that runs the tests, and what every system has.
            "PATH": f"{sys.base_prefix}/bin:/usr/local/bin:/usr/bin:/bin",
            "HOME": str(tmp_path),
            "LANG": "C.UTF-8",
            "BIRESNERF_DATA_DIR": str(data / "data"),
            "BIRESNERF_PORT": (port := str(free_port())),
            "BIRESNERF_URL": f"http://127.0.0.1:{port}",
            **{name: value for name, value in os.environ.items() if name.lower().startswith(REGISTRIES)},
        }
        script = "\n".join(("trap 'kill $(jobs -p) 2>/dev/null; wait' EXIT", *lines_of_pages()))
        done = subprocess.run(
            ["bash", "-euxo", "pipefail", "-c", script],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=3000,
            check=False,
        )
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    folder = tmp_path / "biresnerf"
    for result in ("refined", "out", "fetched", "quick", "result"):
        assert (folder / result / "report.html").is_file(), result
        assert (folder / result / "transforms.json").is_file(), result


def lines_of_pages() -> Iterator[str]:
    """The commands of both pages, each once; the service runs beside those that follow it."""
    said = set()
    for page in PAGES:
        for command in commands_of(ROOT / page):
            text = command.text
            if text in said or (page != PAGES[0] and text.startswith(SAID_BEFORE)):
                continue
            said.add(text)
            if text.startswith("git clone "):
                text = f"git clone --quiet {shlex.quote(str(ROOT))} biresnerf && cd biresnerf"
            if command.language == PYTHON:
                text = f"python - <<'END'\n{text}\nEND"
            if text == "biresnerf up":
                text = 'biresnerf up & until curl -sf "$BIRESNERF_URL/readyz" >/dev/null; do sleep 1; done'
            yield text
            if text.startswith("pip install "):
                yield PHOTOS
