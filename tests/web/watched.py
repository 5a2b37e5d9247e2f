"""A page under watch: its requests, its errors, and its faults in accessibility and layout."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from playwright.sync_api import BrowserContext, ConsoleMessage, Page, Route

ROOT = Path(__file__).resolve().parents[2]
SCREENSHOTS = ROOT / "build" / "screenshots"
AXE = ROOT / "node_modules" / "axe-core" / "axe.min.js"
DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 360, "height": 740}
NARROW = {"width": 390, "height": 844}
# On a machine that others use as well.
PATIENCE_MS = 480_000
# Targets of 24 px are the one rule that axe leaves off.
AXE_OPTIONS = "{resultTypes: ['violations'], rules: {'target-size': {enabled: true}}}"
# Words with _ that can be read once all is unfolded, but for logs, lines to copy and the codes of errors.
NAMES_OF_CODE = """() => {
    const folded = [...document.querySelectorAll("details:not([open], .error-code)")];
    const left = [...document.querySelectorAll("pre")].map((element) => [element, element.style.display]);
    for (const element of folded) element.open = true;
    for (const [element] of left) element.style.display = "none";
    const text = document.body.innerText;
    for (const element of folded) element.open = false;
    for (const [element, display] of left) element.style.display = display;
    return text.split(/\\s+/).filter((word) => /[a-z]_[a-z]/.test(word));
}"""
# What of a page's accessibility may not be wrong.
SERIOUS = {"serious", "critical"}


@dataclass
class Watched:
    """A page, and what it asked for and complained of."""

    page: Page
    outside: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def screenshot(self, name: str, *, full: bool = True) -> None:
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=SCREENSHOTS / f"{name}.png", full_page=full)

    def findings(self) -> list[str]:
        """What axe finds wrong here, by rule and place, and names of the code where people read."""
        # Files keep their names, and so do the fields in them.
        names = [
            word for word in self.page.evaluate(NAMES_OF_CODE) if not {".", "/"} & {*word.rstrip(".,;:")}
        ]
        return [f"a name of the code: {name}" for name in names] + self._serious_findings()

    def _serious_findings(self) -> list[str]:
        # A script tag would be against the page's own policy.
        self.page.evaluate(AXE.read_text())
        found: dict[str, Any] = self.page.evaluate(f"axe.run(document, {AXE_OPTIONS})")
        return [
            f"{one['id']}: {node['target']} {node['html']} {node['failureSummary']}"
            for one in found["violations"]
            if one["impact"] in SERIOUS
            for node in one["nodes"]
        ]

    def findings_in_each_look(self) -> list[str]:
        """The same in light and dark, wide and 390 px; and where one has to scroll sideways or has a small target."""
        found = []
        for scheme in ("dark", "light"):
            for size in (NARROW, DESKTOP):
                self.page.emulate_media(color_scheme=scheme)
                self.page.set_viewport_size(size)
                here = self.findings() + (["it overflows"] if self.overflows() else [])
                found += [f"{scheme}, {size['width']} px: {one}" for one in here]
        return found

    def overflows(self) -> bool:
        """Whether one would have to scroll sideways."""
        width = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
        return bool(self.page.evaluate(width))


def complaint(said: ConsoleMessage) -> list[str]:
    """What the browser says is wrong; a preview that another one replaced meanwhile is not."""
    replaced = "/artifacts/preview/" in said.location["url"] and "404" in said.text
    return [said.text] if said.type == "error" and not replaced else []


def watched_page(context: BrowserContext, origin: str) -> Watched:
    """A page that reaches the service alone; what else it asks for is refused and noted."""
    watched = Watched(context.new_page())

    def decide(route: Route) -> None:
        url = route.request.url
        if url.startswith((origin, "blob:", "data:")):
            route.continue_()
        else:
            watched.outside.append(url)
            route.abort()

    context.route("**/*", decide)
    watched.page.on("pageerror", lambda error: watched.complaints.append(str(error)))
    watched.page.on("console", lambda said: watched.complaints.extend(complaint(said)))
    watched.page.set_default_timeout(PATIENCE_MS)
    return watched
