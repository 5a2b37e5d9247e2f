"""A camera's intrinsics in a file's terms: COLMAP's model name and parameters, in pixels."""

from __future__ import annotations

from dataclasses import dataclass

from biresnerf.geometry.camera.camera_models import FullParameters, full_parameters, smallest_model


@dataclass(frozen=True)
class Camera:
    """Intrinsics: COLMAP model name, image size (px) and parameters in COLMAP's order.

    Pixels; the centre of the first pixel lies at (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def full(self) -> FullParameters:
        """These intrinsics with all coefficients written out, and whether they are a fisheye's."""
        return full_parameters(self.model, self.params)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same picture resampled to ``width`` x ``height`` px.

        The true ratios are used, so a model with one focal length may have to become one with two.
        """
        a, b = width / self.width, height / self.height
        p = self.full()
        scaled = p._replace(fx=p.fx * a, fy=p.fy * b, cx=p.cx * a, cy=p.cy * b)
        model, params = smallest_model(scaled, self.model)
        return Camera(model, width, height, params)
