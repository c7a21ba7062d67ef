"""Pinhole cameras: where they stand, rays through their pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from usdbrdf.model.arrays import Double, Float


def pixel_centres(width: int, height: int, stride: int = 1) -> Double:
    """(R, 2) x, y of every ``stride``-th pixel's centre, row by row."""
    x = np.arange(0, width, stride) + 0.5
    y = np.arange(0, height, stride) + 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def camera_rays(
    world_from_camera: Double, intrinsics: Double, pixels: Double
) -> tuple[Float, Float]:
    """Rays through pixels (R, 2): origins and unit directions, (R, 3) float32 in the world."""
    fx, fy, cx, cy = intrinsics
    in_camera = np.stack(
        [(pixels[:, 0] - cx) / fx, (cy - pixels[:, 1]) / fy, np.full(len(pixels), -1.0)], axis=-1
    )
    in_camera /= np.linalg.norm(in_camera, axis=-1, keepdims=True)
    directions = in_camera @ world_from_camera[:3, :3].T
    origins = np.broadcast_to(world_from_camera[:3, 3], directions.shape)
    return np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)


@dataclass(frozen=True, kw_only=True)
class View:
    """A pinhole camera and the size of its picture.

    world_from_camera  (4, 4) metres; x right, y up, looks down -z
    intrinsics         fx, fy, cx, cy in pixels, first pixel's centre at (0.5, 0.5), y down
    """

    name: str
    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int

    def at_width(self, width: int) -> View:
        """The same picture with another number of pixels."""
        height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        lens = (fx * x, fy * y, cx * x, cy * y)
        return replace(self, intrinsics=lens, width=width, height=height)
