"""Values of options that are left out: by preset, by method, and on a GPU."""

from __future__ import annotations

from typing import Any, Literal

ComputeDevice = Literal["cpu", "cuda"]
PresetName = Literal["fast", "balanced", "quality", "paper"]
MethodName = Literal["biresnerf", "biresnerf-paper", "baa-ngp", "nerfacc-barf", "barf"]

# A GPU affords larger batches and images at the same number of steps; `paper` is made for one and stays as it is.
CUDA_SCALE = {"samples_per_step": 4, "max_image_size": 2}

PRESETS: dict[PresetName, dict[str, Any]] = {
    "fast": {
        "max_image_size": 128,
        "steps": 3000,
        "coarse_steps_min": 600,
        "coarse_steps_max": 1200,
        "check_every": 50,
        "samples_per_step": 2**15,
        "pose_rate": 5e-3,
        "pose_rate_final": 1e-4,
        "field_rate": 1e-2,
        "field_rate_final": 1e-3,
        "warmup_steps": 200,
        "reconstruction_levels": 8,
        "reconstruction_resolution_max": 1024,
        "table_size_log2": 16,
        "trial_steps": 200,
        "orbit_frames": 24,
        "shown_views": 6,
    },
    "balanced": {
        "max_image_size": 200,
        "steps": 8000,
        "coarse_steps_min": 1600,
        "coarse_steps_max": 3200,
        "check_every": 100,
        "samples_per_step": 2**16,
        "pose_rate": 5e-3,
        "pose_rate_final": 5e-5,
        "field_rate": 1e-2,
        "field_rate_final": 5e-4,
        "warmup_steps": 400,
        "reconstruction_levels": 12,
        "reconstruction_resolution_max": 2048,
        "table_size_log2": 17,
        "trial_steps": 500,
        "orbit_frames": 48,
        "shown_views": 8,
    },
    "quality": {
        "max_image_size": 400,
        "steps": 20_000,
        "coarse_steps_min": 3000,
        "coarse_steps_max": 8000,
        "check_every": 200,
        "samples_per_step": 2**17,
        "pose_rate": 5e-3,
        "pose_rate_final": 2e-5,
        "field_rate": 1e-2,
        "field_rate_final": 2e-4,
        "warmup_steps": 800,
        "reconstruction_levels": 16,
        "reconstruction_resolution_max": 4096,
        "table_size_log2": 19,
        "trial_steps": 1000,
        "orbit_frames": 96,
        "shown_views": 12,
    },
    # Guo et al., Appl. Sci. 2023, 13(24), 13333: Table 1 for the encodings; steps, period and floor inferred
    # from its timing tables; rates and loss inherited from BAA-NGP, which it builds on.
    "paper": {
        "max_image_size": 400,
        "steps": 40_000,
        "coarse_steps_min": 5000,
        "coarse_steps_max": 16_000,
        "check_every": 200,
        "samples_per_step": 2**18,
        "pose_rate": 5e-3,
        "pose_rate_final": 1e-5,
        "field_rate": 1e-2,
        "field_rate_final": 1e-4,
        "warmup_steps": 1000,
        "reconstruction_levels": 16,
        "reconstruction_resolution_max": 4096,
        "table_size_log2": 19,
        "trial_steps": 1000,
        "orbit_frames": 96,
        "shown_views": 12,
    },
}

# These keep their proportion to `steps`.
SCALED_BY_STEPS = ("coarse_steps_min", "coarse_steps_max", "check_every", "warmup_steps")

COMMON_VALUES: dict[str, Any] = {
    "holdout": "auto",
    "exposure": "auto",
    "start": "auto",
    "reconstruction_resolution_min": 128,
    "double_pose_step": False,
}

_BAA_NGP = {
    "exposure": "none",
    "start": "given",
    "double_pose_step": True,
    "pose_rate": 1e-3,
    "pose_rate_final": 1e-5,
    "field_rate": 1e-2,
    "field_rate_final": 1e-4,
}
_BARF = {
    "exposure": "none",
    "start": "given",
    "pose_rate": 1e-3,
    "pose_rate_final": 1e-5,
    "field_rate": 5e-4,
    "field_rate_final": 1e-4,
}

# What a method takes instead of the preset's values, whatever the preset: its published rates and grid.
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

# And in the preset `paper`: its published length and batch (1024 rays of 128 samples; pruned, of about 32).
METHOD_PAPER_VALUES: dict[MethodName, dict[str, Any]] = {
    "biresnerf": {},
    "biresnerf-paper": {},
    "baa-ngp": {},
    "nerfacc-barf": {"steps": 200_000, "samples_per_step": 2**15},
    "barf": {"steps": 200_000, "samples_per_step": 2**17},
}


def preset_values(
    preset: PresetName, method: MethodName, device: ComputeDevice, steps: int | None
) -> dict[str, Any]:
    """Values of options that are left out. `steps`: as requested; None if left out as well."""
    values = {**COMMON_VALUES, **PRESETS[preset], **METHOD_VALUES[method]}
    if preset == "paper":
        values |= METHOD_PAPER_VALUES[method]
    elif device == "cuda":
        values |= {key: values[key] * factor for key, factor in CUDA_SCALE.items()}
    if steps is not None:
        ratio = steps / values["steps"]
        for key in SCALED_BY_STEPS:
            values[key] = max(10, round(values[key] * ratio))
        # In proportion, trials would be too short to distinguish good poses from better ones.
        values["trial_steps"] = max(10, min(values["trial_steps"], steps // 4))
    return values
