"""What the README and the pages say about options and files is true."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from biresnerf.options.presets import PRESETS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "SECURITY.md", "examples/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").glob("[!R]*.md")),
]


def test_every_preset_is_named():
    text = (ROOT / "README.md").read_text()
    paragraph = next(part for part in text.split("\n\n") if part.startswith("`--preset`"))
    assert set(PRESETS) <= set(re.findall(r"`(\w+)`", paragraph))


def test_every_page_is_in_the_index():
    index = ROOT / "docs/README.md"
    listed = set(re.findall(r"\]\(([^)#]+)\)", index.read_text()))
    pages = [page for page in PAGES if page.parent == index.parent and page != index]
    assert [page.name for page in pages if page.name not in listed] == []


def test_the_quick_start_is_read_in_two_minutes():
    words = re.sub(r"```.*?```", "", (ROOT / "docs/quick-start.md").read_text(), flags=re.DOTALL).split()
    assert len(words) < 2 * 200  # words a minute of technical prose


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_that_exist(page):
    links = re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text())
    for path, anchor in links:
        if "://" in path:
            continue
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Those of its headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.M)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def test_every_make_target_of_the_readme_exists():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), flags=re.M))
    named = set(re.findall(r"(?:^|`)make ([a-z]+)", (ROOT / "README.md").read_text(), flags=re.M))
    assert {"demo", "test"} <= named <= targets


# Imports nothing but the distributions named on the command line, then runs the lines from standard input.
ONLY_THESE = """
import importlib.abc, importlib.metadata, sys
allowed = set(sys.argv[1].split(","))
owners = {}
for module, names in importlib.metadata.packages_distributions().items():
    owners[module] = {name.lower().replace("_", "-").replace(".", "-") for name in names}
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        owned = owners.get(name.partition(".")[0], set())
        if owned and not owned & allowed:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import matplotlib
matplotlib.use("Agg")
exec(sys.stdin.read())
"""


def test_the_python_of_the_readme_runs_with_what_its_install_line_installs(tmp_path):
    text = (ROOT / "README.md").read_text()
    extras = re.search(r"pip install -c constraints.txt '\.\[([\w,]+)\]'", text)
    assert extras is not None
    code = next(block for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
    refined = re.compile(r"biresnerf\.refine\([^)]*\)")
    assert refined.search(code)
    # The page's finished example stands for the run, which tests/docs makes. It holds no COLMAP model.
    code = code.replace('result.to_colmap("sparse")\n', "")
    code = refined.sub(f"biresnerf.load({str(ROOT / 'service/example')!r})", code)
    allowed = ",".join(sorted(distributions("biresnerf", set(extras.group(1).split(",")))))
    command = [sys.executable, "-c", ONLY_THESE, allowed]
    done = subprocess.run(command, input=code, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "improved" in done.stdout


def distributions(name: str, extras: set[str]) -> set[str]:
    """The names of all that pip would install for a distribution with these extras, itself included."""
    found, waiting = {canonicalize_name(name)}, [(name, extras)]
    while waiting:
        one, wanted = waiting.pop()
        for line in importlib.metadata.requires(one) or []:
            needed = Requirement(line)
            chosen = (
                [needed.marker.evaluate({"extra": extra}) for extra in (*wanted, "")]
                if needed.marker
                else [True]
            )
            key = canonicalize_name(needed.name)
            if any(chosen) and (key not in found or needed.extras):
                found.add(key)
                try:
                    waiting.append((needed.name, set(needed.extras)))
                    importlib.metadata.requires(needed.name)
                except importlib.metadata.PackageNotFoundError:
                    waiting.pop()
    return found
