"""A real browser with a page of another port of this machine: the service takes nothing from it."""

from __future__ import annotations

import base64
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest
from playwright.sync_api import Browser

from tests.service.conftest import Running, zip_of

pytestmark = pytest.mark.server
SEND = """async ([address, archive]) => {
    const bytes = Uint8Array.from(atob(archive), (letter) => letter.charCodeAt(0))
    const sent = {method: 'POST', mode: 'no-cors', body: new Blob([bytes])}
    await fetch(address, sent).catch(() => {})
}"""


class Empty(BaseHTTPRequestHandler):
    """A page without anything."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title>")

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def elsewhere() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Empty) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_what_a_page_of_another_port_sends_changes_nothing(
    browser: Browser, service: Running, elsewhere: str
):
    with httpx.Client(base_url=service.url) as http:
        archive = base64.b64encode(zip_of({"a.png": b"x"})).decode()

        def files_after_sending_from(page_address: str) -> int:
            dataset = http.post("/v1/datasets", json={}).json()["id"]
            page = browser.new_page()
            page.goto(page_address)
            page.evaluate(SEND, [f"{service.url}/v1/datasets/{dataset}/archive", archive])
            page.close()
            return int(http.get(f"/v1/datasets/{dataset}").json()["files"])

        assert files_after_sending_from(elsewhere) == 0
        assert files_after_sending_from(elsewhere.replace("127.0.0.1", "localhost")) == 0
        assert files_after_sending_from(service.url) == 1, "the same from its own page is taken"
