"""How far a rendered colour is from a photo's, per ray and channel.

Training takes the mean of it, with a weight for each camera; the repair of lost cameras takes the sum.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Loss = Callable[[Tensor, Tensor], Tensor]  # (colour [rays, 3], target [rays, 3]) -> [rays, 3]


def half_squared_error(colour: Tensor, target: Tensor) -> Tensor:
    """Half the squared difference: smooth L1 with beta 1, as no two colours in 0..1 differ by more than 1."""
    return 0.5 * (colour - target) ** 2


def squared_error(colour: Tensor, target: Tensor) -> Tensor:
    """BARF's."""
    return (colour - target) ** 2
