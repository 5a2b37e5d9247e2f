"""Shows a run's photos, poses and matches while COLMAP works, before there is a field that could be rendered."""

from __future__ import annotations

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.seeding.seed_poses import Seeding
from biresnerf.data.seeding.seeding_preview import write_seeding_preview
from biresnerf.data.seeding.seeding_progress import SeedingProgress
from biresnerf.progress import OnProgress, Progress
from biresnerf.write.output_folder import PREVIEW, OutputFolder


class ShowSeeding:
    """Reports what `seed_poses` tells, with a preview each time; `end` shows the poses to start from.

    Where it leaves by an error, it takes its files along.

    Args:
        dataset: as it was given.
    """

    def __init__(self, dataset: Dataset, folder: OutputFolder, report: OnProgress) -> None:
        self._dataset, self._folder, self._report = dataset, folder, report
        self._found: SeedingProgress | None = None  # as COLMAP is not asked

    def __enter__(self) -> ShowSeeding:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._folder.drop_preview()

    def __call__(self, found: SeedingProgress) -> None:
        """More is known."""
        self._found = found
        given = self._dataset.posed.all()
        message = "comparing the poses with feature matches" if given else "COLMAP looks for poses"
        if found.matches:
            message += f": {len(found.matches)} pairs of photos match"
        elif found.features:
            message += f": features of {len(found.features)} of {len(self._dataset)} photos found"
        poses = refined_set(self._dataset, self._dataset.world_from_cam) if given else None
        paths = write_seeding_preview(self._dataset, found, self._folder.path / PREVIEW, poses)
        self._tell(message, [path.name for path in paths])

    def end(self, seeding: Seeding) -> None:
        """The poses that the run starts from, where COLMAP was asked: others may be tried before they move."""
        if self._found is None:
            return
        first = seeding.candidates[0]
        poses = refined_set(
            seeding.dataset,
            first.world_from_cam,
            given=[frame.world_from_cam for frame in self._dataset.frames],
            pose_sources=first.sources,
        )
        paths = write_seeding_preview(self._dataset, self._found, self._folder.path / PREVIEW, poses)
        self._tell(f"{len(poses)} poses to start from", [path.name for path in paths])

    def _tell(self, message: str, names: list[str]) -> None:
        shown = tuple(f"{PREVIEW}/{name}" for name in names)
        self._report(Progress(stage="seeding", fraction=0.01, message=message, preview=shown))
