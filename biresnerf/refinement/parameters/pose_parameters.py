"""Camera poses as parameters of the optimisation.

BARF's coordinates: unit_from_cam = exp(rotation, translation) start, so a rotation turns a camera about the scene.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.field.adam import Adam
from biresnerf.field.backends import camera_kernels
from biresnerf.geometry.lie import moved_poses
from biresnerf.refinement.kernels.moved_poses import MovedPoses

EPSILON = 1e-12
SECOND_EPSILON, SECOND_DECAY = 1e-15, 1e-6  # BAA-NGP: its optimiser of the field moves the poses too


class PoseParameters:
    """Increments on given poses ``unit_from_cam`` [n, 4, 4], zero at the start, one row for each rigid body.

    Args:
        length: unit lengths per unit of translation: a quarter of the rig's distance, so that one learning rate suits
            every scene.
        double_step: a second Adam, at the field's rate, takes a step after each of the first's from the same gradient,
            as in BAA-NGP's code.
        body: [n], numbered without gaps: which cameras share their increments; each has its own where left out.
    """

    def __init__(
        self,
        unit_from_cam: Tensor,
        length: float,
        device: torch.device,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        double_step: bool = False,
        body: Tensor | None = None,
    ) -> None:
        self.body = (torch.arange(len(unit_from_cam)) if body is None else body).to(device)
        count = int(self.body.max()) + 1
        self.length, self._length = length, torch.full((1,), length, device=device)
        self.start = unit_from_cam[:, :3].to(torch.float32).to(device)
        self.rotation = torch.zeros(count, 3, device=device, requires_grad=True)
        self.translation = torch.zeros(count, 3, device=device, requires_grad=True)
        self.betas, self.double_step = betas, double_step
        self.restart_adam()

    def __len__(self) -> int:
        return len(self.start)

    def matrices(self) -> Tensor:
        """unit_from_cam [n, 3, 4], differentiable."""
        rotation, translation, device = self.rotation, self.translation, self.start.device
        if device.type == "cpu":
            found: Tensor = MovedPoses.apply(rotation, translation, self.body, self.length, self.start)
            return found
        if kernels := camera_kernels(device):
            return kernels.moved_poses(rotation, translation, self.body, self._length, self.start)
        return self.defined_matrices()

    def defined_matrices(self) -> Tensor:
        """The same by torch's operations, on any device."""
        rotation, translation = self.rotation[self.body], self.translation[self.body]
        return moved_poses(rotation, translation * self.length, self.start)

    def members(self, camera: int) -> list[int]:
        """The cameras of one camera's body, itself included."""
        return torch.nonzero(self.body == self.body[camera])[:, 0].tolist()

    @torch.no_grad()
    def poses(self) -> Tensor:
        """unit_from_cam [n, 4, 4] in float64, without gradient; rotations to that precision."""
        top = self.matrices().double().cpu()
        left, _, right = torch.linalg.svd(top[:, :, :3])
        top[:, :, :3] = left @ right  # the nearest rotation, without float32's rounding
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(len(top), 1, 4)
        return torch.cat([top, bottom], 1)

    def step(self, rate: float, mobility: Tensor | None = None, field_rate: float = 0.0) -> None:
        """A step of Adam, and of the second at `field_rate`; `mobility` [n] is each camera's own factor of both.

        A body moves as far as its least mobile camera.
        """
        before = [(p, p.detach().clone()) for p in (self.rotation, self.translation)]
        self._adam.step(rate)
        if self._second is not None and field_rate > 0:
            self._second.step(field_rate)
        if mobility is not None:
            mobility = torch.ones_like(self.rotation[:, 0]).scatter_reduce(0, self.body, mobility, "amin")
            with torch.no_grad():
                for parameter, kept in before:
                    parameter.copy_(torch.lerp(kept, parameter, mobility[:, None]))
        self._adam.zero_grad()

    @torch.no_grad()
    def dolly(self, log_focal: Tensor) -> None:
        """Move cameras along their axes to compensate a change of their focal lengths [n] at the scene's centre.

        The start poses move; increments and their moments stay.
        """
        now = self.matrices()
        shift = dolly_directions(now) * log_focal.expm1().to(now)[:, None]
        turn = now[:, :, :3] @ self.start[:, :, :3].transpose(1, 2)
        self.start[:, :, 3] += (turn.transpose(1, 2) @ shift[:, :, None])[:, :, 0]

    def restart_adam(self) -> None:
        """Reset the moments, before another optimisation."""
        parameters = [self.rotation, self.translation]
        self._adam = Adam(parameters, betas=self.betas, eps=EPSILON)
        self._second = None
        if self.double_step:
            self._second = Adam(parameters, betas=self.betas, eps=SECOND_EPSILON, weight_decay=SECOND_DECAY)

    def replace(self, camera: int, unit_from_cam: Tensor) -> None:
        """Restart one camera, with its body, at another pose [3, 4] and without momentum."""
        with torch.no_grad():
            self._carry_body(camera, unit_from_cam)
            row = int(self.body[camera])
            for parameter in (self.rotation, self.translation):
                parameter[row] = 0
            for adam in self._adams().values():
                adam.forget_row(row)

    def _carry_body(self, camera: int, unit_from_cam: Tensor) -> None:
        """Set the start poses of a camera's body so that the camera begins at `unit_from_cam` [3, 4]."""
        now = self.matrices()
        turn = unit_from_cam[:, :3] @ now[camera, :, :3].T
        shift = unit_from_cam[:, 3] - turn @ now[camera, :, 3]
        for member in self.members(camera):
            self.start[member] = torch.cat(
                [turn @ now[member, :, :3], (turn @ now[member, :, 3] + shift)[:, None]], 1
            )
        self.start[camera] = unit_from_cam

    @torch.no_grad()
    def place(self, unit_from_cam: Tensor) -> None:
        """Restart all cameras at other poses [n, 4, 4], without momentum."""
        self.start.copy_(unit_from_cam[:, :3])
        for parameter in (self.rotation, self.translation):
            parameter.zero_()
        self.restart_adam()

    def zero_if_finite(self) -> Tensor:
        """Zero; not a number where some increment is not finite. Does not wait for the device."""
        return 0 * (self.rotation.detach() + self.translation.detach()).sum()

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "start": self.start,
            "rotation": self.rotation.detach(),
            "translation": self.translation.detach(),
        }

    def _adams(self) -> dict[str, Adam]:
        return {"adam": self._adam} if self._second is None else {"adam": self._adam, "second": self._second}

    def state(self) -> dict[str, Tensor]:
        state = self._tensors()
        for name, adam in self._adams().items():
            state.update(adam.state(name))
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])
        for name, adam in self._adams().items():
            adam.load_state(name, state)


def dolly_directions(unit_from_cam: Tensor) -> Tensor:
    """Motion of camera centres [n, 3] per unit of log focal length that keeps the origin's plane as it looks.

    A dolly zoom. Cameras that look away from the origin stay.
    """
    forward, centre = unit_from_cam[:, :, 2], unit_from_cam[:, :, 3]
    depth = -(forward * centre).sum(1, keepdim=True)
    return -depth.clamp(min=0) * forward
