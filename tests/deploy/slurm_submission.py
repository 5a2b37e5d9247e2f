"""The program that submits workers, as a module."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

from tests.deploy.manifests import ROOT

SUBMIT = ROOT / "deploy/slurm/submit_workers.py"


def submission() -> ModuleType:
    """The script, loaded."""
    spec = importlib.util.spec_from_file_location("submit_workers", SUBMIT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module
