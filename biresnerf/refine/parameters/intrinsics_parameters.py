"""The intrinsics of a set's cameras as parameters of the optimisation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from biresnerf.data.model.dataset import Dataset, IntrinsicsSource
from biresnerf.data.photos.images import ImageSet
from biresnerf.field.adam_state import adam_state, load_adam_state
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera, FullParameters
from biresnerf.options.refine_options import RefineIntrinsics
from biresnerf.refine.parameters.pose_parameters import dolly_directions

RefinedPart = Literal["none", "focal", "all"]

BETAS, EPSILON = (0.9, 0.99), 1e-12
# Columns of the increments: logarithms of the focal length and of fy/fx, the principal point in focal lengths, and the
# nine coefficients of `Intrinsics.distortion`, in the unit that moves the image's corner by its own distance.
FOCAL, ASPECT, CENTRE, DISTORTION = 0, 1, slice(2, 4), slice(4, 13)
COLUMNS = 13
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k4", "k5", "k6", "p1", "p2")  # of a fisheye, else of FULL_OPENCV
# The corner's distance r by which a unit of each coefficient moves it is r to this power.
_POWERS = (3, 5, 7, 9, 3, 5, 7, 2, 2)
# Expected standard deviations of the increments, and the weight of this prior in the loss: parameters without
# evidence in the photos stay.
DEVIATIONS = (0.2, 0.02, 0.05, 0.05, *(0.1,) * 9)
PRIOR_WEIGHT = 1e-6


def lenses_of(
    dataset: Dataset,
    images: ImageSet,
    option: RefineIntrinsics,
    held_out: Sequence[int],
    device: torch.device,
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
        dollies=dollies,
    )


def refined_part(option: RefineIntrinsics, source: IntrinsicsSource) -> RefinedPart:
    """What is refined of a camera: as requested, or for `auto` the focal length if it was never measured."""
    if option == "auto":
        return "focal" if source in ("exif", "guessed") else "none"
    return option


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
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        of_image: Sequence[int],
        parts: Sequence[RefinedPart],
        working: Sequence[Camera],
        held_out: Sequence[int],
        device: torch.device,
        *,
        dollies: bool = True,
    ) -> None:
        self.dollies = dollies
        self.parts = tuple(parts)
        self.given = Intrinsics.from_cameras(working).to(device)
        self.of_image = torch.tensor(of_image, dtype=torch.int64, device=device)
        self.is_training = torch.ones(len(working), 1, dtype=torch.bool, device=device)
        self.is_training[list(held_out)] = False
        self.free = torch.stack([_free(c, part) for c, part in zip(cameras, parts, strict=True)]).to(device)
        self.unit = torch.stack([_units(camera) for camera in cameras]).to(device)
        self.precision = PRIOR_WEIGHT / torch.tensor(DEVIATIONS, dtype=torch.float64, device=device) ** 2
        self.increments = torch.zeros(len(cameras), COLUMNS, dtype=torch.float64, device=device)
        self.increments.requires_grad_()
        self._adam = torch.optim.Adam([self.increments], betas=BETAS, eps=EPSILON)
        used = self.free[:, DISTORTION].any(0)
        groups = zip(self.given.terms, (used[:4], used[4:7], used[7:]), strict=True)
        above, below, tangential = (max(t, int(g.nonzero().max()) + 1 if g.any() else 0) for t, g in groups)
        self.given = replace(self.given, terms=(above, below, tangential))
        self._present = self.given

    @classmethod
    def held(cls, working: Sequence[Camera], device: torch.device) -> IntrinsicsParameters:
        """Intrinsics that stay as they are."""
        return cls(working, range(len(working)), ["none"] * len(working), working, [], device)

    @property
    def moving(self) -> bool:
        """Whether anything may be refined."""
        return bool(self.free.any())

    @property
    def intrinsics(self) -> Intrinsics:
        """Every image's present intrinsics at working size, without gradient."""
        return self._present

    def differentiable(self) -> Intrinsics:
        """The same as a function of the increments."""
        q = (self.increments * self.free)[self.of_image]
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
            self.increments.grad += 2 * self.precision * before
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()
        self.forget_gradients()
        if not focal:
            with torch.no_grad():
                self.increments[:, FOCAL] = before[:, FOCAL]
        return self._moved(before)

    @torch.no_grad()
    def _moved(self, before: Tensor) -> Tensor:
        if self.moving:
            self._present = self.differentiable()
        moved = ((self.increments - before) * self.free)[:, FOCAL][self.of_image]
        return moved if self.dollies else torch.zeros_like(moved)

    def forget_gradients(self) -> None:
        self._adam.zero_grad(set_to_none=True)

    def refined(self, dataset: Dataset) -> Dataset:
        """The set with its cameras as they are now, each in its own model; moved ones have the source ``refined``."""
        if not self.moving:
            return dataset
        sources: list[IntrinsicsSource] = [
            dataset.source_of_intrinsics(i) if part == "none" else "refined"
            for i, part in enumerate(self.parts)
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
        increments = (self.increments.detach() * self.free).cpu()
        units = self.unit.cpu()
        return tuple(
            camera if self.parts[row] == "none" else _moved_camera(camera, increments[row], units[row])
            for camera, row in zip(cameras, rows, strict=True)
        )

    def state(self) -> dict[str, Tensor]:
        if not self.moving:
            return {}
        return {"increments": self.increments.detach(), **adam_state("adam", self._adam)}

    @torch.no_grad()
    def load_state(self, state: dict[str, Tensor]) -> None:
        if not self.moving:
            return
        self.increments.copy_(state["increments"])
        load_adam_state("adam", self._adam, state)
        self._moved(self.increments)


def _free(camera: Camera, part: RefinedPart) -> Tensor:
    """Which columns may move, bool [COLUMNS]: those asked for that the camera's model has."""
    free = torch.zeros(COLUMNS, dtype=torch.bool)
    if part == "none":
        return free
    free[FOCAL] = True
    if part == "all":
        names, fisheye = MODEL_PARAMETERS[camera.model], camera.full().fisheye
        free[ASPECT] = "fx" in names
        free[CENTRE] = True
        # A fisheye's k4 is the fourth of the numerator, a perspective lens's the first of the denominator.
        places = range(4) if fisheye else (0, 1, 2, 4, 5, 6, 7, 8)
        for place in places:
            free[DISTORTION.start + place] = _COEFFICIENTS[place] in names
    return free


def _units(camera: Camera) -> Tensor:
    """By how much a unit of each distortion increment changes its coefficient [9]."""
    full = camera.full()
    x, y = max(full.cx, camera.width - full.cx) / full.fx, max(full.cy, camera.height - full.cy) / full.fy
    corner = (x * x + y * y) ** 0.5
    return torch.tensor([corner ** (1 - power) for power in _POWERS], dtype=torch.float64)


def _moved_camera(camera: Camera, increments: Tensor, unit: Tensor) -> Camera:
    """A camera with increments [COLUMNS], in the same model."""
    p, q = camera.full(), increments
    above_below_tangential = (q[DISTORTION] * unit).tolist()
    places = range(4) if p.fisheye else (0, 1, 2, 4, 5, 6, 7, 8)
    coefficients = {
        _COEFFICIENTS[i]: getattr(p, _COEFFICIENTS[i]) + above_below_tangential[i] for i in places
    }
    moved: FullParameters = p._replace(
        fx=p.fx * float(q[FOCAL].exp()),
        fy=p.fy * float((q[FOCAL] + q[ASPECT]).exp()),
        cx=p.cx + float(q[2]) * p.fx,
        cy=p.cy + float(q[3]) * p.fy,
        **coefficients,
    )
    values = moved._asdict() | {"f": moved.fx}
    return replace(camera, params=tuple(values[name] for name in MODEL_PARAMETERS[camera.model]))
