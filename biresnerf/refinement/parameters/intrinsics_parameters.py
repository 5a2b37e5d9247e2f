"""The intrinsics of a set's cameras as parameters of the optimisation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from biresnerf.data.model.dataset import Dataset, IntrinsicsSource
from biresnerf.data.photos.images import ImageSet
from biresnerf.field.adam import Adam
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import RefineIntrinsics
from biresnerf.refinement.numbers.scene import ParameterNumbers
from biresnerf.refinement.parameters.lens_increments import (
    ASPECT,
    COLUMNS,
    DISTORTION,
    FOCAL,
    RefinedPart,
    free_columns,
    increments_between,
    moved_camera,
    units,
)
from biresnerf.refinement.parameters.pose_parameters import dolly_directions

BETAS, EPSILON = (0.9, 0.99), 1e-12


def lenses_of(
    dataset: Dataset,
    images: ImageSet,
    option: RefineIntrinsics,
    held_out: Sequence[int],
    device: torch.device,
    numbers: ParameterNumbers = ParameterNumbers(),
    *,
    dollies: bool = True,
) -> IntrinsicsParameters:
    """The parameters of a set's cameras, free as far as the option allows."""
    return IntrinsicsParameters(
        dataset.cameras,
        [frame.camera for frame in dataset.frames],
        [refined_part(option, dataset.source_of_intrinsics(i)) for i in range(len(dataset.cameras))],
        images.cameras,
        held_out,
        device,
        numbers,
        dollies=dollies,
    )


def refined_part(option: RefineIntrinsics, source: IntrinsicsSource) -> RefinedPart:
    """What is refined of a camera: as requested, or for `auto` the focal length if it was never measured."""
    if option == "auto":
        return "focal" if source in ("exif", "predicted", "guessed") else "none"
    return option


@dataclass(frozen=True)
class FocalCertainty:
    """What an adjustment to feature matches and patches says of a camera's focal length.

    Attributes:
        deviation: standard deviation, as a share of it; None where there was no evidence at all.
        observable: whether that is well below what was known before.
        contradicts: the focal length that the evidence clearly prefers over the one kept, as a share of that; or None.
    """

    deviation: float | None
    observable: bool
    contradicts: float | None = None


class IntrinsicsParameters:
    """Increments on the intrinsics of the set's cameras, zero at the start, one row per camera.

    A camera keeps its model: a coefficient that the model does not have stays zero, and one focal length stays one.
    Held-out photos have no effect.

    Args:
        cameras: of the set, at full size.
        of_image: index of each image's camera.
        parts: what of each camera may move.
        working: each image's camera at working size.
        held_out: images without effect here; they only move their own pose.
        dollies: whether cameras move with their focal length; not where some are fixed or belong to a rig.

    Attributes:
        moving: whether anything may be refined.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        of_image: Sequence[int],
        parts: Sequence[RefinedPart],
        working: Sequence[Camera],
        held_out: Sequence[int],
        device: torch.device,
        numbers: ParameterNumbers = ParameterNumbers(),
        *,
        dollies: bool = True,
    ) -> None:
        self.dollies = dollies
        self.parts = tuple(parts)
        self.given = Intrinsics.from_cameras(working).to(device)
        self.of_image = torch.tensor(of_image, dtype=torch.int64, device=device)
        self.is_training = torch.ones(len(working), 1, dtype=torch.bool, device=device)
        self.is_training[list(held_out)] = False
        free = torch.stack([free_columns(c, part) for c, part in zip(cameras, parts, strict=True)])
        self.moving = bool(free.any())
        self.free = free.to(device)
        self.unit = torch.stack([units(camera) for camera in cameras]).to(device)
        deviations = torch.tensor(numbers.lens_deviations, dtype=torch.float64, device=device)
        self.precision = numbers.lens_prior / deviations**2
        self.increments = torch.zeros(len(cameras), COLUMNS, dtype=torch.float64, device=device)
        self.increments.requires_grad_()
        self._adam = Adam([self.increments], betas=BETAS, eps=EPSILON)
        self._present: Intrinsics | None = None
        self.certainty: tuple[FocalCertainty | None, ...] = (None,) * len(cameras)
        self._show()

    @classmethod
    def held(cls, working: Sequence[Camera], device: torch.device) -> IntrinsicsParameters:
        """Intrinsics that stay as they are."""
        return cls(working, range(len(working)), ["none"] * len(working), working, [], device)

    @property
    def intrinsics(self) -> Intrinsics:
        """Every image's present intrinsics at working size, without gradient."""
        if self._present is None:
            with torch.no_grad():
                self._present = self.differentiable()
        return self._present

    def differentiable(self) -> Intrinsics:
        """The same as a function of the increments."""
        q = torch.where(self.free, self.increments, self.increments.detach())[self.of_image]
        q = torch.where(self.is_training, q, q.detach())
        given = self.given
        return replace(
            given,
            fx=given.fx * q[:, FOCAL].exp(),
            fy=given.fy * (q[:, FOCAL] + q[:, ASPECT]).exp(),
            cx=given.cx + q[:, 2] * given.fx,
            cy=given.cy + q[:, 3] * given.fy,
            distortion=given.distortion + q[:, DISTORTION] * self.unit[self.of_image],
        )

    def with_gradient(self, unit_from_cam: Tensor) -> tuple[Tensor, Intrinsics]:
        """The same poses [n, 3, 4], but as a function of the focal lengths, and the intrinsics.

        Poses and focal lengths are nearly exchangeable: alone, a focal length could change only as fast as all cameras
        follow. So cameras move with it (see `PoseParameters.dolly`), and its gradient includes that motion.
        """
        if not self.dollies:
            return unit_from_cam, self.differentiable()
        q = (self.increments * self.free)[:, FOCAL][self.of_image, None]
        q = torch.where(self.is_training, q, q.detach())
        move = (q - q.detach()).to(unit_from_cam) * dolly_directions(unit_from_cam.detach())
        return torch.cat([unit_from_cam[:, :, :3], (unit_from_cam[:, :, 3] + move)[:, :, None]], 2), (
            self.differentiable()
        )

    def step(self, rate: float, *, focal: bool = True) -> Tensor:
        """A step of Adam; returns the log focal length by which each image's camera is to dolly, [images].

        Args:
            focal: whether focal lengths take part.
        """
        before = self.increments.detach().clone()
        if self.increments.grad is not None:
            self.increments.grad += 2 * self.precision * before * self.free
        self._adam.step(rate)
        self._adam.zero_grad()
        self._present = None
        with torch.no_grad():
            if not focal:
                self.increments[:, FOCAL] = before[:, FOCAL]
            moved = ((self.increments - before) * self.free)[:, FOCAL][self.of_image]
        return moved if self.dollies else torch.zeros_like(moved)

    @torch.no_grad()
    def place(self, before: Sequence[Camera], after: Sequence[Camera]) -> None:
        """Replace the set's intrinsics, `before`, by others of the same models, without history."""
        for row, (old, new) in enumerate(zip(before, after, strict=True)):
            self.increments[row] = increments_between(old, new, self.unit[row].cpu())
        self._adam.forget()
        self._show()

    @property
    def _placed(self) -> list[bool]:
        """For each camera, whether it differs from the set's."""
        return [bool(moved) for moved in (self.increments != 0).any(1).tolist()]

    @torch.no_grad()
    def _show(self) -> None:
        """The present intrinsics, computed with every coefficient that a camera has or may get."""
        used = (self.free | (self.increments != 0))[:, DISTORTION].any(0)
        groups = zip(self.given.terms, (used[:4], used[4:7], used[7:]), strict=True)
        above, below, tangential = (max(t, int(g.nonzero().max()) + 1 if g.any() else 0) for t, g in groups)
        self.given = replace(self.given, terms=(above, below, tangential))
        self._present = None

    def be_certain(self, certainty: tuple[FocalCertainty | None, ...]) -> None:
        """Set what is known of each focal length from now on."""
        self.certainty = certainty

    def at(self, increments: Tensor) -> IntrinsicsParameters:
        """These lenses at another moment's increments [cameras, columns], for reading only."""
        other = copy(self)
        other.increments = increments.to(self.increments)
        return other

    @property
    def refined_parts(self) -> tuple[RefinedPart, ...]:
        """The parts of each camera that were refined, in any way."""
        bent = (self.increments[:, DISTORTION] != 0).any(1).tolist()
        return tuple(
            part if part != "none" or not placed else "all" if other else "focal"
            for part, placed, other in zip(self.parts, self._placed, bent, strict=True)
        )

    def refined(self, dataset: Dataset) -> Dataset:
        """The set with its cameras as they are now, each in its own model; moved ones have the source ``refined``."""
        refined = self.refined_parts
        if not any(part != "none" for part in refined):
            return dataset
        sources: list[IntrinsicsSource] = [
            dataset.source_of_intrinsics(i) if part == "none" else "refined" for i, part in enumerate(refined)
        ]
        return replace(
            dataset,
            cameras=self._moved_cameras(dataset.cameras, range(len(dataset.cameras))),
            intrinsics_sources=tuple(sources),
        )

    def refined_working(self, working: Sequence[Camera]) -> tuple[Camera, ...]:
        """Each image's camera, at any size, as it is now."""
        return self._moved_cameras(working, self.of_image.tolist())

    def _moved_cameras(self, cameras: Sequence[Camera], rows: Iterable[int]) -> tuple[Camera, ...]:
        increments, units, refined = self.increments.detach().cpu(), self.unit.cpu(), self.refined_parts
        return tuple(
            camera if refined[row] == "none" else moved_camera(camera, increments[row], units[row])
            for camera, row in zip(cameras, rows, strict=True)
        )

    def state(self) -> dict[str, Tensor]:
        if not (self.moving or any(self._placed)):
            return {}
        return {"increments": self.increments.detach(), **self._adam.state("adam")}

    @torch.no_grad()
    def load_state(self, state: dict[str, Tensor]) -> None:
        if "increments" not in state:
            return
        self.increments.copy_(state["increments"])
        self._adam.load_state("adam", state)
        self._show()
