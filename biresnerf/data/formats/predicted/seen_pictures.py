"""Where a photo lies in the smaller picture that a network sees of it, as each program scales, crops and pads.

Sources: vggt/utils/load_fn.py of facebookresearch/vggt, utils/io/input_processor.py of ByteDance-Seed/Depth-Anything-3,
dust3r/utils/image.py of naver/dust3r, which MASt3R uses too. All take the middle of a photo where they crop.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from biresnerf.geometry.camera.camera_models import FullParameters

Size: TypeAlias = tuple[int, int]  # width, height

VGGT, _VGGT_PATCH = 518, 14
_DA3, _DA3_PATCH = 504, 14
_DUST3R, _DUST3R_SMALL, _DUST3R_PATCH = 512, 224, 16


class Seen(NamedTuple):
    """A pixel of the picture is ``scale`` times that of the photo plus ``shift`` (x, y), counted from the corner."""

    scale: tuple[float, float]
    shift: tuple[float, float]

    def lens_of_photo(self, focal: tuple[float, float], centre: tuple[float, float]) -> FullParameters:
        """The photo's lens, by that of the picture."""
        (sx, sy), (x, y) = self.scale, self.shift
        return FullParameters(focal[0] / sx, focal[1] / sy, (centre[0] - x) / sx, (centre[1] - y) / sy)


class Margin(NamedTuple):
    """Empty columns and rows at the left and upper edge of a picture, white or black."""

    columns: float = 0.0
    rows: float = 0.0
    black: bool = False


def seen_by_vggt(photo: Size, picture: Size, margin: Margin) -> Seen:
    """VGGT's: 518 px wide, and cropped to as many in height.

    Margins show that a picture was padded to a square instead: black before scaling, or white after.
    """
    width, height = photo
    if margin.black:
        scale = picture[0] / max(photo)
        left, top = ((max(photo) - length) // 2 * scale for length in photo)
        if max(abs(left - margin.columns), abs(top - margin.rows)) < 1.0:
            return Seen((scale, scale), (left, top))
    narrow = (_patches(width * VGGT / height), VGGT)
    if height > width and not margin.black and margin.columns == (picture[0] - narrow[0]) // 2:
        return _in_the_middle(photo, narrow, picture)
    return _in_the_middle(photo, (VGGT, _patches(height * VGGT / width)), picture)


def _patches(length: float) -> int:
    return round(length / _VGGT_PATCH) * _VGGT_PATCH


def seen_by_depth_anything(photo: Size, picture: Size) -> Seen:
    """Depth Anything 3's: the long side scaled, and either side to the nearest multiple of 14.

    Photos of several shapes are cropped to what all of them have.
    """
    scale = max(picture) / max(photo)
    if all(abs(p * scale - q) <= (_DA3_PATCH + 1) / 2 for p, q in zip(photo, picture, strict=True)):
        return Seen((picture[0] / photo[0], picture[1] / photo[1]), (0.0, 0.0))
    scale = max(_DA3, *picture) / max(photo)
    width, height = ((round(p * scale) + _DA3_PATCH // 2) // _DA3_PATCH * _DA3_PATCH for p in photo)
    return _in_the_middle(photo, (width, height), picture)


def seen_by_dust3r(photo: Size, *, small: bool) -> tuple[Seen, Size]:
    """DUSt3R's and MASt3R's: 512 px long, cropped to multiples of 16; squares to 4 : 3; ``small``: 224 px square."""
    long = round(_DUST3R_SMALL * max(photo) / min(photo)) if small else _DUST3R
    width, height = (round(p * long / max(photo)) for p in photo)
    if small:
        side = 2 * (min(width, height) // 2)
        picture = (side, side)
    else:
        cropped = [p // 2 * 2 // _DUST3R_PATCH * _DUST3R_PATCH for p in (width, height)]
        picture = (cropped[0], cropped[0] * 3 // 4 if width == height else cropped[1])
    shift = [picture[0] / 2 - width // 2, picture[1] / 2 - height // 2]
    return Seen((width / photo[0], height / photo[1]), (shift[0], shift[1])), picture


def _in_the_middle(photo: Size, scaled: Size, picture: Size) -> Seen:
    """Scaled to a size, then cropped or padded alike on both sides."""
    left, top = ((q - s) // 2 for q, s in zip(picture, scaled, strict=True))
    return Seen((scaled[0] / photo[0], scaled[1] / photo[1]), (left, top))
