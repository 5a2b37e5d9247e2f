"""How near to the truth the field's own optimum lies: ``python -m benchmarks.method.field_floor SET...``.

SET holds true poses. One run starts from them and holds them for half of its steps: freed, they go where photos and
field want them. Another starts from noise. Neither adjusts all cameras. The difference between their errors is lost on
the way, and not missing from the photos.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from biresnerf.arrays import Array
from biresnerf.commands.settings_option import parse_settings
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options
from biresnerf.pipeline import Observer, refine_poses
from biresnerf.refinement.optimise.methods import Method, find_method
from biresnerf.refinement.optimise.schedule import Schedule
from biresnerf.studies.scenes import with_poses

HELD = 0.5  # of the steps


class HeldFirst(Schedule):
    """Poses stand still until the field is learned."""

    def pose_rate(self, step: int, switch: int | None) -> float:
        """Zero for the first half of the steps."""
        return 0.0 if step < HELD * self.steps else super().pose_rate(step, switch)


def field_end(
    start: Dataset,
    method: Method,
    options: dict[str, object],
    seen: Callable[[Array], object] = lambda _poses: None,
) -> Array:
    """The poses [n, 4, 4] that the run of a field ends with; ``seen`` gets those at each check."""
    ends: list[Array] = []

    def at_check(poses: Array) -> dict[str, float]:
        seen(poses)
        return {}

    with tempfile.TemporaryDirectory() as work:
        refine_poses(
            start,
            Path(work, "out"),
            parse_options(
                {"preset": "fast", "start": "given", "verdict": False, "orbit_frames": 0, **options}
            ),
            observer=Observer(
                at_check, lambda _scene, optimiser: ends.append(optimiser.poses.poses().numpy())
            ),
            method=replace(method, adjustment=False),
        )
    return ends[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", type=Path, nargs="+", metavar="SET")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="options")
    asked = parser.parse_args()
    options = {"seed": asked.seed, **parse_settings(tuple(asked.options))}
    ours = find_method("biresnerf")
    for path in asked.sets:
        dataset = read_dataset(path)
        truth = dataset.world_from_cam
        noisy = with_poses(dataset, perturb_poses(truth, asked.noise, asked.seed))
        for name, start, method in (
            ("the truth, held", dataset, replace(ours, schedule=HeldFirst)),
            (f"noise {asked.noise:g}", noisy, ours),
        ):
            found = pose_error(field_end(start, method, options), truth).aligned.rotation_deg
            print(f"{path}, from {name}: {found.mean:.3f} deg, worst {found.max:.2f}", flush=True)


if __name__ == "__main__":
    main()
