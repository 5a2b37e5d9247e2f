"""All files say the same about the project."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata

import biresnerf
from docs.generate.pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
# Until the project has an address of its own; to be replaced in all files at once.
ADDRESS = PROJECT["urls"]["Homepage"]


def said(key: str) -> str:
    found = re.search(rf"^{key}: (.+)$", (ROOT / "CITATION.cff").read_text("utf-8"), flags=re.M)
    assert found is not None
    return found[1]


def test_the_citation_is_of_this_licence_and_names_no_version_that_could_be_old():
    assert re.search(r"^version:", (ROOT / "CITATION.cff").read_text("utf-8"), flags=re.M) is None
    assert said("license") == PROJECT["license"]
    assert said("abstract") == PROJECT["description"]


def test_the_licence_comes_with_the_package():
    assert PROJECT["license-files"] == ["LICENSE"]
    first_lines = (ROOT / "LICENSE").read_text("utf-8").split("\n", 3)[:3]
    assert [line.strip() for line in first_lines] == ["", "Apache License", "Version 2.0, January 2004"]


def test_the_version_is_that_of_the_package_in_images_and_in_what_is_installed():
    dockerfile = (ROOT / "Dockerfile").read_text("utf-8")
    assert re.findall(r"^ARG VERSION=(.+)$", dockerfile, flags=re.M) == [biresnerf.__version__]
    assert metadata.version("biresnerf") == biresnerf.__version__


def test_all_files_name_one_address():
    assert said("repository-code") == ADDRESS
    assert all(url.startswith(ADDRESS) for url in PROJECT["urls"].values())
    for page in ("README.md", "docs/quick-start.md"):
        assert set(re.findall(r"git clone (\S+)", (ROOT / page).read_text("utf-8"))) == {ADDRESS}


def test_the_workflow_tries_each_python_that_the_package_names():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text("utf-8")
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    matrices = [re.findall(r"[\d.]+", row) for row in re.findall(r"python: \[(.+)\]", workflow)]
    assert matrices == [pythons[1:], pythons]  # the whole run has the first


def test_badges_say_what_the_package_says():
    readme = (ROOT / "README.md").read_text("utf-8")
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    for name, value in {
        "version": biresnerf.__version__,
        "python": f"{pythons[0]} to {pythons[-1]}",
        "licence": PROJECT["license"],
    }.items():
        shown = re.search(rf"!\[([^\]]+)\]\(docs/pictures/badge_{name}\.svg\)", readme)
        assert shown is not None
        assert shown[1] == f"{name} {value}"
        assert f">{value}</text>" in (ROOT / f"docs/pictures/badge_{name}.svg").read_text("utf-8")
