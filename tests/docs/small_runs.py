"""Real refinements, made small: whatever a page asks for, a few steps on a few pixels show that it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import biresnerf.pipeline
from biresnerf.config import RefineOptions, parse_options

# Choices are kept, sizes are not.
KEPT = (
    *("method", "seed", "background", "exposure", "start", "fixed", "refine_intrinsics", "detector"),
    *("pose_parametrisation", "wiring", "double_pose_step", "packs"),
)
SMALL = {
    "preset": "fast",
    "device": "cpu",
    "threads": 1,
    "steps": 20,
    "max_image_size": 24,
    "samples_per_step": 1024,
    "pose_resolution_max": 16,
    "reconstruction_levels": 1,
    "reconstruction_resolution_max": 128,
    "table_size_log2": 10,
    "holdout": 0,
    "trial_steps": 0,
    "orbit_frames": 0,
}


def made_small(options: RefineOptions) -> RefineOptions:
    """The same choices, small. The options must be good as they stand."""
    options.resolved()
    return parse_options({**{key: getattr(options, key) for key in KEPT}, **SMALL})


@contextmanager
def small_runs() -> Iterator[None]:
    """While it lasts, every refinement of this process is a small one."""
    real: Callable[..., Any] = biresnerf.pipeline.refine_poses

    def small(scene: Any, output: Any, options: RefineOptions, *more: Any, **named: Any) -> Any:
        return real(scene, output, made_small(options), *more, **named)

    biresnerf.pipeline.refine_poses = small
    try:
        yield
    finally:
        biresnerf.pipeline.refine_poses = real
