"""What the increments of a camera pose mean: one class per parametrisation, all with one interface.

Poses are unit_from_cam. Rotations are in radians and translations in quarters of the rig's distance, so that one
learning rate suits every scene.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from biresnerf.geometry.lie import se3_exp, so3_exp
from biresnerf.options.refine_options import PoseParametrisation

Precondition = Callable[[Tensor], Tensor]  # poses [n, 4, 4] -> matrices [n, 6, 6], see `camp_preconditioner`


class Parametrisation(ABC):
    """How increments move cameras from their start poses; zero increments leave them there.

    Attributes:
        length: unit lengths per unit of translation.
        moves_bodies: whether several cameras can share increments and keep their relative poses.
    """

    moves_bodies: ClassVar[bool] = True

    def __init__(self, length: float) -> None:
        self.length = length

    @classmethod
    def create(cls, length: float, precondition: Precondition) -> Parametrisation:
        """The parametrisation of a run; only CamP's uses `precondition`."""
        return cls(length)

    @abstractmethod
    def moved(self, start: Tensor, rotation: Tensor, translation: Tensor, body: Tensor | None) -> Tensor:
        """Poses [n, 3, 4], differentiable, of cameras that start at `start` [n, 3, 4].

        Args:
            rotation, translation: each camera's increments [n, 3]; equal within a body.
            body: index [n] of each camera's body; None where every camera is its own.
        """

    @abstractmethod
    def start_shift(self, start: Tensor, now: Tensor, shift: Tensor) -> Tensor:
        """How far start centres [n, 3] must move for the present centres to move by `shift` [n, 3]."""

    def begin(self, unit_from_cam: Tensor, device: torch.device) -> None:
        """Called once with the start poses [n, 4, 4]."""
        return

    def restart(self, camera: int, unit_from_cam: Tensor) -> None:
        """Called after one camera was given a new start pose, with all present poses [n, 4, 4]."""
        return

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint, to be overwritten in place when one is loaded."""
        return {}


class Se3World(Parametrisation):
    """BARF's: unit_from_cam = exp(rotation, translation) start. A rotation turns the camera about the scene."""

    def moved(self, start: Tensor, rotation: Tensor, translation: Tensor, body: Tensor | None) -> Tensor:
        turn, shift = se3_exp(rotation, translation * self.length)
        centre = (turn @ start[:, :, 3:])[:, :, 0] + shift
        return torch.cat([turn @ start[:, :, :3], centre[:, :, None]], 2)

    def start_shift(self, start: Tensor, now: Tensor, shift: Tensor) -> Tensor:
        turn = now[:, :, :3] @ start[:, :, :3].transpose(1, 2)
        return (turn.transpose(1, 2) @ shift[:, :, None])[:, :, 0]


class So3xR3(Parametrisation):
    """R = exp(rotation) R0, c = c0 + translation. A rotation turns a camera in place, a body about its mean centre."""

    def moved(self, start: Tensor, rotation: Tensor, translation: Tensor, body: Tensor | None) -> Tensor:
        start_centre = start[:, :, 3]
        turn, centre = so3_exp(rotation), start_centre + translation * self.length
        if body is not None:
            arm = start_centre - _mean_centres(start_centre, body)
            centre = centre + ((turn @ arm[:, :, None])[:, :, 0] - arm)
        return torch.cat([turn @ start[:, :, :3], centre[:, :, None]], 2)

    def start_shift(self, start: Tensor, now: Tensor, shift: Tensor) -> Tensor:
        return shift


class CampSo3xR3(So3xR3):
    """`So3xR3` of a preconditioner times the increments, which are then shifts of the picture in units of its size.

    Attributes:
        preconditioner: [n, 6, 6], of the start poses.
    """

    moves_bodies = False
    preconditioner: Tensor

    def __init__(self, length: float, precondition: Precondition) -> None:
        super().__init__(length)
        self._precondition = precondition

    @classmethod
    def create(cls, length: float, precondition: Precondition) -> CampSo3xR3:
        return cls(length, precondition)

    def moved(self, start: Tensor, rotation: Tensor, translation: Tensor, body: Tensor | None) -> Tensor:
        both = self.preconditioner @ torch.cat([rotation, translation], 1)[:, :, None]
        return super().moved(start, both[:, :3, 0], both[:, 3:, 0], body)

    def begin(self, unit_from_cam: Tensor, device: torch.device) -> None:
        self.preconditioner = self._precondition(unit_from_cam).float().to(device)

    def restart(self, camera: int, unit_from_cam: Tensor) -> None:
        self.preconditioner[camera] = self._precondition(unit_from_cam)[camera].to(self.preconditioner)

    def state(self) -> dict[str, Tensor]:
        return {"preconditioner": self.preconditioner}


PARAMETRISATIONS: dict[PoseParametrisation, type[Parametrisation]] = {
    "se3_world": Se3World,
    "so3xr3": So3xR3,
    "so3xr3_camp": CampSo3xR3,
}


def _mean_centres(centre: Tensor, body: Tensor) -> Tensor:
    """The mean centre [n, 3] of each camera's body."""
    sums = torch.zeros_like(centre).index_add(0, body, centre)
    counts = torch.zeros_like(centre).index_add(0, body, torch.ones_like(centre))
    return (sums / counts.clamp(min=1))[body]
