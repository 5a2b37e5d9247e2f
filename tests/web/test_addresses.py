"""Sets that the service fetches, and files that it sends, as the page shows them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from tests.service.conftest import PROGRAM, Running, finished
from tests.web.conftest import zip_of
from tests.web.watched import Watched

pytestmark = pytest.mark.jobs_by(PROGRAM)


TUS = {"Tus-Resumable": "1.0.0"}


class Elsewhere(BaseHTTPRequestHandler):
    """Somebody's server: it has one archive, and gives and takes only once it is ready to."""

    content = b""
    ready: threading.Event

    def do_GET(self) -> None:
        known = self.path.startswith("/set.zip")
        if known:
            self.ready.wait(60)
        self.answer(200 if known else 404, self.content if known else b"")

    def do_PUT(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.ready.wait(60)
        self.answer(200 if self.path.startswith("/all.zip") else 403, b"")

    def answer(self, status: int, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def elsewhere() -> Iterator[str]:
    Elsewhere.ready = threading.Event()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    Elsewhere.ready.set()
    server.shutdown()
    server.server_close()


def test_a_set_that_the_service_fetches_shows_what_comes_and_what_cannot_be_had(
    tab: Watched, service: Running, api: httpx.Client, kitchen: Path, tmp_path: Path, elsewhere: str
) -> None:
    page = tab.page
    Elsewhere.content = zip_of(kitchen, tmp_path / "set.zip").read_bytes()
    dataset = api.post("/datasets", json={"name": "far away"}).json()["id"]
    files = [{"url": f"{elsewhere}/set.zip?key=SECRET"}, {"url": f"{elsewhere}/no.png", "path": "no.png"}]
    assert api.post(f"/datasets/{dataset}/fetches", json={"files": files}).status_code < 300
    page.goto(f"{service.url}/#/datasets/{dataset}")
    shown = page.get_by_role("region", name="Files that the service fetches")
    expect(shown.get_by_role("status")).to_contain_text("The service fetches 1 file from 127.0.0.1")
    expect(shown.get_by_role("alert")).to_contain_text("A file could not be fetched")
    expect(shown.get_by_role("alert")).to_contain_text("127.0.0.1 answers 404.")
    expect(shown.get_by_role("alert")).to_contain_text("no.png")
    tab.screenshot("fetches")
    assert tab.findings_in_each_look() == []
    assert "SECRET" not in page.content()
    (lost,) = (
        each["id"] for each in api.get(f"/datasets/{dataset}/fetches").json()["items"] if each["error"]
    )
    assert api.delete(f"/uploads/{lost}", headers=TUS).status_code == 204
    Elsewhere.ready.set()
    page.get_by_role("button", name="That is all: check them").click()
    expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()
    assert (tab.complaints, tab.outside) == ([], [])


def test_a_job_shows_what_became_of_the_files_that_are_sent(
    tab: Watched, service: Running, api: httpx.Client, kitchen: Path, tmp_path: Path, elsewhere: str
) -> None:
    page = tab.page
    dataset = api.post("/datasets", json={"name": "near"}).json()["id"]
    api.post(f"/datasets/{dataset}/archive", content=zip_of(kitchen, tmp_path / "set.zip").read_bytes())
    assert api.post(f"/datasets/{dataset}/finalize").json()["state"] == "ready"
    to = {"archive": f"{elsewhere}/all.zip?key=SECRET", "files": {"log.txt": f"{elsewhere}/log?key=SECRET"}}
    options = {"preset": "fast", "steps": 20, "threads": 77}
    asked = {"dataset_id": dataset, "options": options, "deliver": to}
    job = api.post("/jobs", json=asked).json()["id"]
    page.goto(f"{service.url}/#/jobs/{job}")
    shown = page.get_by_role("region", name="Deliveries")
    expect(shown.get_by_role("status").first).to_contain_text(
        "will be sent to 127.0.0.1 once the job is over"
    )
    finished(httpx.Client(base_url=service.url), job)
    Elsewhere.ready.set()
    expect(shown.get_by_text("All files in one zip: sent to 127.0.0.1 on ")).to_be_visible()
    expect(shown.get_by_role("alert")).to_contain_text("log.txt could not be sent to 127.0.0.1")
    expect(shown.get_by_role("alert")).to_contain_text("127.0.0.1 answers 403")
    tab.screenshot("deliveries")
    assert tab.findings_in_each_look() == []
    assert "SECRET" not in page.content()
    assert (tab.complaints, tab.outside) == ([], [])
