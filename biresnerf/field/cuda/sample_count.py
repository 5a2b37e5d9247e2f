"""How many samples rays have: known on the device, copied to the host without waiting."""

from __future__ import annotations

import torch
from torch import Tensor


class SampleCount:
    """Remembers the last count that has arrived, as samples a ray and unit length of interval."""

    def __init__(self, device: torch.device) -> None:
        self._on_device = device.type == "cuda"
        self._arriving = torch.zeros(1, dtype=torch.int32, pin_memory=self._on_device)
        self._arrived = torch.cuda.Event() if self._on_device else None
        self._waiting: tuple[int, float] | None = None
        self._density: float | None = None

    def note(self, total: Tensor, rays: int, interval: float) -> None:
        """Request the count `total` [1] of this many rays marched at `interval`."""
        self._arriving.copy_(total, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record()
        self._waiting = (rays, interval)

    def latest(self) -> int:
        """The count last requested, after waiting for it; 0 if there is none. Call before the next `note`."""
        if self._arrived is not None and self._waiting is not None:
            self._arrived.synchronize()
        count = int(self._arriving)
        if self._waiting is not None:
            rays, interval = self._waiting
            self._density = count * interval / max(1, rays)
            self._waiting = None
        return count

    def expected(self, rays: int, interval: float) -> int | None:
        """The count to expect of other rays, from the last one; None if there is none."""
        return None if self._density is None else round(self._density * rays / interval)

    def forget(self) -> None:
        self._waiting = self._density = None
