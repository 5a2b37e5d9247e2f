"""Real refinements, made small: whatever a page asks for, a few steps on a few pixels show that it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import biresnerf.commands.poses.make_scene
import biresnerf.pipeline
from biresnerf.options.refine_options import RefineOptions, parse_options

VIEWS, SIZE = 8, 24
# Choices are kept, sizes are not.
KEPT = (
    *("method", "seed", "background", "exposure", "start", "fixed", "refine_intrinsics"),
    *("double_pose_step", "exports"),
)
SMALL = {
    "preset": "fast",
    "device": "cpu",
    "threads": 1,
    "start": "none",  # where nothing is asked for; feature matches have tests of their own
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
    "shown_views": 0,
}


def made_small(options: RefineOptions) -> RefineOptions:
    """The same choices, small. The options must be good as they stand."""
    options.resolved("cpu")
    chosen = {key: getattr(options, key) for key in KEPT}
    return parse_options({**SMALL, **{key: value for key, value in chosen.items() if value is not None}})


@contextmanager
def small_runs() -> Iterator[None]:
    """While it lasts, every refinement of this process is a small one, and every scene that is made."""
    refine: Callable[..., Any] = biresnerf.pipeline.refine_poses
    make: Callable[..., Any] = biresnerf.commands.poses.make_scene.make_scene

    def small(scene: Any, output: Any, options: RefineOptions, *more: Any, **named: Any) -> Any:
        return refine(scene, output, made_small(options), *more, **named)

    def few(output: Any, kind: str = "dome", **named: Any) -> Any:
        return make(output, kind, **{**named, "views": VIEWS, "size": SIZE})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(biresnerf.pipeline, "refine_poses", small)
        patch.setattr(biresnerf.commands.poses.make_scene, "make_scene", few)
        yield
