"""The documentation as a site: it builds without a warning, loads nothing from elsewhere, and is searched offline."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.docs.documented import PAGES, ROOT

CHROMIUM = shutil.which("chromium")
# Elements that a browser fetches without being asked, and where they say what.
FETCHED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "video": "src"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("MkDocs is not installed: pip install 'biresnerf[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, text=True,
                          capture_output=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


class _Fetched(HTMLParser):
    """What a page makes a browser load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.diagrams = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.diagrams += "mermaid" in (values.get("class") or "")
        if tag in FETCHED:
            self.found.append(values.get(FETCHED[tag]) or "")


def test_every_page_is_on_the_site_and_none_loads_anything_from_another_host(site):
    pages = {
        page.relative_to(site).as_posix(): _Fetched(page.read_text("utf-8")) for page in site.rglob("*.html")
    }
    expected = {page.relative_to(ROOT).with_suffix(".html").as_posix() for page in PAGES}
    assert {re.sub(r"README\.html$", "index.html", name) for name in expected} <= set(pages)
    loaded = {address for page in pages.values() for address in page.found}
    styles = {
        address
        for style in site.rglob("*.css")
        for address in re.findall(r"""(?:url\(|@import)\s*["']?([^"')\s]+)""", style.read_text("utf-8"))
    }
    assert any(address.endswith(".js") for address in loaded)
    assert [address for address in loaded | styles if re.match(r"(https?:)?//", address)] == []
    # The theme would fetch Mermaid, which draws them, from another host.
    assert [name for name, page in pages.items() if page.diagrams] == []


@pytest.mark.browser
def test_the_site_is_searched_where_it_was_opened_as_files(site):
    if CHROMIUM is None:
        pytest.skip(
            "There is no Chromium (Debian: apt install chromium): the page is not tested in a browser."
        )
    api = pytest.importorskip("playwright.sync_api")
    asked: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.goto((site / "index.html").as_uri())
        page.click(".md-search__input")
        page.keyboard.type("Satterthwaite")
        page.wait_for_selector(".md-search-result__link", state="attached")
        first = page.locator(".md-search-result__link").first.get_attribute("href")
        browser.close()
    assert first is not None
    assert "/docs/estimator.html" in first
    assert [address for address in asked if not address.startswith("file:")] == []


def test_the_pages_that_llms_txt_names_are_there():
    names = re.findall(r"\]\(([^)]+)\)", (ROOT / "docs/llms.txt").read_text("utf-8"))
    assert len(names) > 15
    assert [name for name in names if not (ROOT / "docs" / name).is_file()] == []
