"""The preprocessing of photos by VGGT, Depth Anything 3 and DUSt3R, after their sources, on coordinate images.

Each photo is two channels with the x and y of every pixel's centre. After scaling, cropping and padding, they show
where in the picture the photo lies, without a formula for it.
"""

from __future__ import annotations

import numpy as np
from PIL import Image


def coordinates(size):
    """The two channels [h, w] of a photo."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return x, y


def resize(channels, size):
    return [
        np.asarray(Image.fromarray(one.astype(np.float32)).resize(size, Image.Resampling.BICUBIC))
        for one in channels
    ]


def pad(channels, size, value=np.nan):
    """In the middle of a larger picture."""
    height, width = channels[0].shape
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    spare = ((top, size[1] - height - top), (left, size[0] - width - left))
    return [np.pad(one, spare, constant_values=value) for one in channels]


def vggt_crop(channels):
    height, width = channels[0].shape
    scaled = resize(channels, (518, round(height * (518 / width) / 14) * 14))
    start = max(0, (scaled[0].shape[0] - 518) // 2)
    return [one[start : start + 518] for one in scaled]


def vggt_pad(channels):
    height, width = channels[0].shape
    if width >= height:
        size = 518, round(height * (518 / width) / 14) * 14
    else:
        size = round(width * (518 / height) / 14) * 14, 518
    return pad(resize(channels, size), (518, 518))


def vggt_square(channels):
    side = max(channels[0].shape)
    known = resize([np.ones_like(channels[0])], channels[0].shape[::-1])
    padded = pad([*channels, *known], (side, side), 0.0)
    x, y, inside = resize(padded, (518, 518))
    return [np.where(inside > 0.999, one, np.nan) for one in (x, y)]


def da3_resize(channels):
    height, width = channels[0].shape
    scale = 504 / max(width, height)
    first = max(1, round(width * scale)), max(1, round(height * scale))

    def nearest(length):
        down = length // 14 * 14
        return down + 14 if abs(down + 14 - length) <= abs(length - down) else down

    return resize(resize(channels, first), (nearest(first[0]), nearest(first[1])))


def da3_together(pictures):
    """Pictures of several shapes are cropped to what all have."""
    height = min(one[0].shape[0] for one in pictures)
    width = min(one[0].shape[1] for one in pictures)
    found = []
    for channels in pictures:
        top, left = (channels[0].shape[0] - height) // 2, (channels[0].shape[1] - width) // 2
        found.append([one[top : top + height, left : left + width] for one in channels])
    return found


def vggt_together(pictures):
    """Pictures of several shapes are padded to what all fit in."""
    height = max(one[0].shape[0] for one in pictures)
    width = max(one[0].shape[1] for one in pictures)
    return [pad(channels, (width, height)) for channels in pictures]


def dust3r(channels, size=512):
    height, width = channels[0].shape
    long = size if size == 512 else round(224 * max(width / height, height / width))
    scaled = resize(channels, tuple(round(p * long / max(width, height)) for p in (width, height)))
    height, width = scaled[0].shape
    cx, cy = width // 2, height // 2
    if size == 224:
        half_x = half_y = min(cx, cy)
    else:
        half_x, half_y = ((2 * cx) // 16) * 16 / 2, ((2 * cy) // 16) * 16 / 2
        if width == height:
            half_y = 3 * half_x / 4
    rows, columns = slice(int(cy - half_y), int(cy + half_y)), slice(int(cx - half_x), int(cx + half_x))
    return [one[rows, columns] for one in scaled]


def lens_of_picture(channels, lens):
    """The intrinsic matrix of the picture, by where the photo's coordinates are in it."""
    matrix = np.eye(3)
    for axis in (0, 1):
        middle = channels[axis].shape[axis] // 2
        along = channels[axis].take(middle, axis)
        there = np.flatnonzero(np.isfinite(along))[8:-8]  # away from edges, which scaling bends
        per_pixel, first = np.polyfit(there + 0.5, along[there], 1)
        matrix[axis, axis] = lens[axis] / per_pixel
        matrix[axis, 2] = (lens[2 + axis] - first) / per_pixel
    return matrix


def as_colours(channels, margin):
    """A picture [3, h, w] that is grey where the photo is, and has the program's value in its margins."""
    grey = np.where(np.isfinite(channels[0]), 0.5, margin).astype(np.float32)
    return np.stack([grey] * 3)
