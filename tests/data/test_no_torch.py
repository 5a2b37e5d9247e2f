"""The package `biresnerf.data` works without torch: the service validates uploads with it."""

from __future__ import annotations

import pkgutil
import subprocess
import sys

import biresnerf.data


def test_no_module_of_the_data_room_loads_torch_numba_or_pycolmap():
    names = [m.name for m in pkgutil.walk_packages(biresnerf.data.__path__, "biresnerf.data.")]
    program = f"import sys, {', '.join(names)}; print([m for m in ('torch', 'numba', 'pycolmap') if m in sys.modules])"
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert answer.stdout.strip() == "[]"
