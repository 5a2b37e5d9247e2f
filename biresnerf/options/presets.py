"""Values of options that are left out: by preset, by method, and on a GPU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

ComputeDevice = Literal["cpu", "cuda"]
PresetName = Literal["fast", "balanced", "quality", "paper"]
MethodName = Literal["biresnerf", "biresnerf-paper", "baa-ngp", "nerfacc-barf", "barf"]

# A GPU affords larger batches and images at the same number of steps; `paper` is made for one and stays unchanged.
CUDA_SCALE = {"samples_per_step": 4, "max_image_size": 2}

# Each option's value in the presets, in the order of `PresetName`. The last column, `paper`, is Guo et al., Appl. Sci.
# 2023, 13(24), 13333: Table 1 for the encodings; steps, period and floor inferred from its timing tables; rates and
# loss inherited from BAA-NGP, which it builds on.
_BY_PRESET: dict[str, tuple[float, float, float, float]] = {
    "max_image_size": (128, 200, 400, 400),
    "steps": (3000, 8000, 20_000, 40_000),
    "coarse_steps_min": (600, 1600, 3000, 5000),
    "coarse_steps_max": (1200, 3200, 8000, 16_000),
    "check_every": (50, 100, 200, 200),
    "samples_per_step": (2**15, 2**16, 2**17, 2**18),
    "pose_rate": (5e-3, 5e-3, 5e-3, 5e-3),
    "pose_rate_final": (1e-4, 5e-5, 2e-5, 1e-5),
    "field_rate": (1e-2, 1e-2, 1e-2, 1e-2),
    "field_rate_final": (1e-3, 5e-4, 2e-4, 1e-4),
    "warmup_steps": (200, 400, 800, 1000),
    "reconstruction_levels": (8, 12, 16, 16),
    "reconstruction_resolution_max": (1024, 2048, 4096, 4096),
    "table_size_log2": (16, 17, 19, 19),
    "trial_steps": (200, 500, 1000, 1000),
    "orbit_frames": (24, 48, 96, 96),
    "shown_views": (6, 8, 12, 12),
}
PRESETS: dict[PresetName, dict[str, Any]] = {
    preset: {key: values[column] for key, values in _BY_PRESET.items()}
    for column, preset in enumerate(get_args(PresetName))
}

# Of a run that names none. With a GPU the longer one is a matter of a minute.
PRESET_ON: dict[ComputeDevice, PresetName] = {"cpu": "fast", "cuda": "balanced"}
PRESET_IF_LEFT_OUT = "fast on a CPU, balanced on a GPU"

# These keep their proportion to `steps`.
FEWEST_STEPS, FEWEST_OF_STAGE = 20, 10  # of a run, and of what follows from its length
SCALED_BY_STEPS = ("coarse_steps_min", "coarse_steps_max", "check_every", "warmup_steps")

COMMON_VALUES: dict[str, Any] = {
    "holdout": "auto",
    "exposure": "auto",
    "start": "auto",
    "reconstruction_resolution_min": 128,
    "double_pose_step": False,
}

_PUBLISHED = {
    "exposure": "none",
    "start": "given",
    "pose_rate": 1e-3,
    "pose_rate_final": 1e-5,
    "field_rate": 1e-2,
    "field_rate_final": 1e-4,
}
_BAA_NGP = {**_PUBLISHED, "double_pose_step": True}
_BARF = {**_PUBLISHED, "field_rate": 5e-4}

# Values that a method sets in every preset: its published rates and grid.
METHOD_VALUES: dict[MethodName, dict[str, Any]] = {
    "biresnerf": {},
    "biresnerf-paper": _BAA_NGP,
    "baa-ngp": {
        **_BAA_NGP,
        "reconstruction_levels": 16,
        "reconstruction_resolution_min": 14,
        "reconstruction_resolution_max": 4096,
    },
    "nerfacc-barf": _BARF,
    "barf": _BARF,
}

# Values that it sets in the preset `paper` alone: its published length and batch (1024 rays of 128 samples, or of about
# 32 where empty space is skipped).
METHOD_PAPER_VALUES: dict[MethodName, dict[str, Any]] = {
    "nerfacc-barf": {"steps": 200_000, "samples_per_step": 2**15},
    "barf": {"steps": 200_000, "samples_per_step": 2**17},
}


def preset_values(
    preset: PresetName, method: MethodName, device: ComputeDevice, steps: int | None
) -> dict[str, Any]:
    """Values of options that are left out. `steps`: as requested; None if left out as well."""
    values = {**COMMON_VALUES, **PRESETS[preset], **METHOD_VALUES[method]}
    if preset == "paper":
        values |= METHOD_PAPER_VALUES.get(method, {})
    elif device == "cuda":
        values |= {key: values[key] * factor for key, factor in CUDA_SCALE.items()}
    return values if steps is None else values | in_proportion(values, steps)


def in_proportion(values: Mapping[str, Any], steps: int) -> dict[str, int]:
    """The values that depend on the number of steps, scaled to `steps`."""
    ratio = steps / values["steps"]
    # In proportion, trials would be too short to distinguish good poses from better ones.
    trial = {"trial_steps": min(values["trial_steps"], max(FEWEST_OF_STAGE, steps // 4))}
    return {key: max(FEWEST_OF_STAGE, round(values[key] * ratio)) for key in SCALED_BY_STEPS} | trial
