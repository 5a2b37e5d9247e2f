"""Camera poses as parameters of the optimisation."""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.field.adam_state import adam_state, load_adam_state
from biresnerf.geometry.lie import se3_exp, so3_exp
from biresnerf.options.refine_options import PoseParametrisation

EPSILON = 1e-12
SECOND_EPSILON, SECOND_DECAY = 1e-15, 1e-6  # BAA-NGP's settings for the field, whose Adam owns the poses too


class PoseParameters:
    """Increments on given poses ``unit_from_cam0`` [n, 4, 4], zero at the start, one row for each rigid body.

    Three parametrisations, with rotation in radians and translation in quarters of the rig's distance, so that one
    learning rate suits every scene:

    - ``se3_world``: unit_from_cam = exp(rotation, translation) unit_from_cam0; a rotation orbits the scene.
    - ``so3xr3``: R = exp(rotation) R0, c = c0 + translation; a rotation turns the camera in place, and a body of
      several about the middle of their centres.
    - ``so3xr3_camp``: the same of `preconditioner` [n, 6, 6] times the parameters (`camp_preconditioner`), which are
      then shifts of the picture, in sizes of it.

    `double_step`: a second Adam, at the field's rate, takes a step after each of the first's from the same gradient,
    as in BAA-NGP's code.

    `body` [n], numbered without gaps, says which cameras share their increments; each is its own where left out.
    """

    def __init__(
        self,
        unit_from_cam: Tensor,
        parametrisation: PoseParametrisation,
        length: float,
        device: torch.device,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        double_step: bool = False,
        preconditioner: Tensor | None = None,
        body: Tensor | None = None,
    ) -> None:
        if (parametrisation == "so3xr3_camp") != (preconditioner is not None):
            raise ValueError("a preconditioner goes with so3xr3_camp, and with it alone")
        count = len(unit_from_cam) if body is None else int(body.max()) + 1
        # None where every camera is its own body.
        self.body = body.to(device) if body is not None and count < len(body) else None
        if self.body is not None and preconditioner is not None:
            raise ValueError("so3xr3_camp knows no bodies of several cameras")
        self.parametrisation, self.length = parametrisation, length
        self.start = unit_from_cam[:, :3].to(torch.float32).to(device)
        self.rotation = torch.zeros(count, 3, device=device, requires_grad=True)
        self.translation = torch.zeros(count, 3, device=device, requires_grad=True)
        self.preconditioner = None if preconditioner is None else preconditioner.float().to(device)
        self.betas, self.double_step = betas, double_step
        self.restart_adam()

    def __len__(self) -> int:
        return len(self.start)

    def matrices(self) -> Tensor:
        """unit_from_cam [n, 3, 4], differentiable."""
        rotation0, centre0 = self.start[:, :, :3], self.start[:, :, 3]
        turn, shift = self.rotation, self.translation
        if self.preconditioner is not None:
            both = self.preconditioner @ torch.cat([turn, shift], 1)[:, :, None]
            turn, shift = both[:, :3, 0], both[:, 3:, 0]
        if self.body is not None:
            turn, shift = turn[self.body], shift[self.body]
        shift = shift * self.length
        if self.parametrisation == "se3_world":
            rotation, translation = se3_exp(turn, shift)
            centre = (rotation @ centre0[:, :, None])[:, :, 0] + translation
        else:
            rotation, centre = so3_exp(turn), centre0 + shift
            if self.body is not None:
                arm = centre0 - self._middle(centre0)
                centre = centre + ((rotation @ arm[:, :, None])[:, :, 0] - arm)
        return torch.cat([rotation @ rotation0, centre[:, :, None]], 2)

    def _middle(self, centres: Tensor) -> Tensor:
        """The mean centre [n, 3] of each camera's body."""
        assert self.body is not None
        ones = torch.ones_like(centres)
        sums = torch.zeros_like(self.rotation).index_add(0, self.body, centres)
        return (sums / torch.zeros_like(self.rotation).index_add(0, self.body, ones))[self.body]

    def members(self, camera: int) -> list[int]:
        """The cameras of one's body, itself among them."""
        if self.body is None:
            return [camera]
        return torch.nonzero(self.body == self.body[camera])[:, 0].tolist()

    @torch.no_grad()
    def poses(self) -> Tensor:
        """unit_from_cam [n, 4, 4] in float64, without gradient; rotations to that precision."""
        top = self.matrices().double().cpu()
        left, _, right = torch.linalg.svd(top[:, :, :3])
        top[:, :, :3] = (
            left @ right
        )  # the nearest rotation: what is written must not carry float32's rounding
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(len(top), 1, 4)
        return torch.cat([top, bottom], 1)

    def step(self, rate: float, mobility: Tensor | None = None, field_rate: float = 0.0) -> None:
        """A step of Adam, and of the second at `field_rate`; `mobility` [n] is each camera's own factor of both.

        A body moves as far as its least mobile camera.
        """
        self._adam.param_groups[0]["lr"] = rate
        before = [(p, p.detach().clone()) for p in (self.rotation, self.translation)]
        self._adam.step()
        if self._second is not None and field_rate > 0:
            self._second.param_groups[0]["lr"] = field_rate
            self._second.step()
        if mobility is not None:
            if self.body is not None:
                least = torch.ones_like(self.rotation[:, 0])
                mobility = least.scatter_reduce(0, self.body, mobility, "amin")
            with torch.no_grad():
                for parameter, kept in before:
                    parameter.copy_(torch.lerp(kept, parameter, mobility[:, None]))
        self.forget_gradients()

    @torch.no_grad()
    def dolly(self, log_focal: Tensor) -> None:
        """Move cameras along their axes as a change of their focal lengths [n] asks, so that the centre looks the same.

        Their starting places move: increments and their moments stay as they are.
        """
        now = self.matrices()
        move = dolly_directions(now) * log_focal.expm1().to(now)[:, None]
        if self.parametrisation == "se3_world":
            turn = now[:, :, :3] @ self.start[:, :, :3].transpose(1, 2)
            move = (turn.transpose(1, 2) @ move[:, :, None])[:, :, 0]
        self.start[:, :, 3] += move

    def restart_adam(self) -> None:
        """Forget the moments: what follows is another optimisation."""
        parameters = [self.rotation, self.translation]
        self._adam = torch.optim.Adam(parameters, betas=self.betas, eps=EPSILON)
        self._second = None
        if self.double_step:
            self._second = torch.optim.Adam(
                parameters, betas=self.betas, eps=SECOND_EPSILON, weight_decay=SECOND_DECAY
            )

    @torch.no_grad()
    def replace(self, row: int, unit_from_cam: Tensor) -> None:
        """Start one camera, and its body with it, over from another pose [3, 4], without the momentum so far."""
        now, members = self.matrices(), self.members(row)
        turn = unit_from_cam[:, :3] @ now[row, :, :3].T
        shift = unit_from_cam[:, 3] - turn @ now[row, :, 3]
        for member in members:
            self.start[member] = torch.cat(
                [turn @ now[member, :, :3], (turn @ now[member, :, 3] + shift)[:, None]], 1
            )
        self.start[row] = unit_from_cam
        row = row if self.body is None else int(self.body[row])
        for parameter in (self.rotation, self.translation):
            parameter[row] = 0
            for adam in (self._adam, self._second):
                for moment in adam.state.get(parameter, {}).values() if adam is not None else ():
                    if moment.shape == parameter.shape:
                        moment[row] = 0

    def forget_gradients(self) -> None:
        self._adam.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        state = {
            "start": self.start,
            "rotation": self.rotation.detach(),
            "translation": self.translation.detach(),
        }
        if self.preconditioner is not None:
            state["preconditioner"] = self.preconditioner
        state.update(adam_state("adam", self._adam))
        if self._second is not None:
            state.update(adam_state("second", self._second))
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.start.copy_(state["start"])
            self.rotation.copy_(state["rotation"])
            self.translation.copy_(state["translation"])
            if self.preconditioner is not None:
                self.preconditioner.copy_(state["preconditioner"])
        load_adam_state("adam", self._adam, state)
        if self._second is not None:
            load_adam_state("second", self._second, state)


def dolly_directions(unit_from_cam: Tensor) -> Tensor:
    """Where camera centres [n, 3] go for each unit of the log of their focal length: back from the origin's plane.

    What lies there looks the same then, and what lies near it nearly so: a dolly zoom. Cameras that look away stay.
    """
    forward, centre = unit_from_cam[:, :, 2], unit_from_cam[:, :, 3]
    depth = -(forward * centre).sum(1, keepdim=True)
    return -depth.clamp(min=0) * forward
