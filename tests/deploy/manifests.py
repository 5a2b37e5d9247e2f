"""The Kubernetes manifests as kubectl renders them, without a cluster."""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
MANIFESTS = ROOT / "deploy/kubernetes"
OVERLAYS = ("cpu", "gpu")
OLDEST_KUSTOMIZE = 5

Manifest = dict[str, Any]


@functools.cache
def _why_not() -> str | None:
    if shutil.which("kubectl") is None:
        return "there is no kubectl"
    said = subprocess.run(
        ["kubectl", "version", "--client", "-o", "json"], capture_output=True, text=True, check=True
    )
    version = json.loads(said.stdout).get("kustomizeVersion", "v0")
    if int(version.lstrip("v").partition(".")[0]) < OLDEST_KUSTOMIZE:
        return "there is no kubectl of 1.27 or later"
    return None


def render(folder: Path) -> list[Manifest]:
    """What `kubectl kustomize` makes of a folder; skips the test where that cannot be asked."""
    if (why := _why_not()) is not None:
        pytest.skip(f"{why}: the Kubernetes manifests are not rendered")
    done = subprocess.run(["kubectl", "kustomize", str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "a warning of what will not work for ever"
    return list(yaml.safe_load_all(done.stdout))


@functools.cache
def rendered(overlay: str) -> tuple[Manifest, ...]:
    return tuple(render(MANIFESTS / "overlays" / overlay))


def only(manifests: tuple[Manifest, ...], kind: str, name: str) -> Manifest:
    (found,) = [item for item in manifests if item["kind"] == kind and item["metadata"]["name"] == name]
    return found


def pod_templates(manifests: tuple[Manifest, ...]) -> Iterator[tuple[str, Manifest]]:
    """Name and pod template of each object that makes pods."""
    for item in manifests:
        spec = item.get("spec", {})
        spec = spec.get("jobTargetRef", spec.get("jobTemplate", {}).get("spec", spec))
        template = spec.get("template")
        if template is not None:
            yield item["metadata"]["name"], template


def container(template: Manifest) -> Manifest:
    (one,) = template["spec"]["containers"]
    return one
