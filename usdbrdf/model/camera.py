"""Pinhole cameras: where they stand, rays through their pixels, and points in their pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from usdbrdf.model.arrays import Double, Float


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera and the size of its picture.

    world_from_camera  (4, 4), rigid, in the world's unit; x right, y up, looks down -z
    intrinsics         fx, fy, cx, cy in pixels, first pixel's centre at (0.5, 0.5), y down
    width, height      of the picture, in pixels
    name               of the picture
    """

    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int
    name: str = ""

    @property
    def eye(self) -> Double:
        """(3,) where it stands."""
        return self.world_from_camera[:3, 3]

    def at_size(self, width: int, height: int) -> Camera:
        """The same picture with another number of pixels."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        intrinsics = (fx * x, fy * y, cx * x, cy * y)
        return replace(self, intrinsics=intrinsics, width=width, height=height)

    def at_width(self, width: int) -> Camera:
        """The same picture, so wide, its pixels' shape kept as nearly as can be."""
        return self.at_size(width, max(1, round(self.height * width / self.width)))

    def rows(self, low: int, high: int) -> Camera:
        """The same picture's rows from ``low`` to ``high``, which may lie beyond its border."""
        fx, fy, cx, cy = self.intrinsics
        return replace(self, intrinsics=(fx, fy, cx, cy - low), height=high - low)

    def pixels(self, stride: int = 1) -> Double:
        """(R, 2) x, y of every ``stride``-th pixel's centre, row by row."""
        x = np.arange(0, self.width, stride) + 0.5
        y = np.arange(0, self.height, stride) + 0.5
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def rays(self, pixels: Double) -> tuple[Float, Float]:
        """Through pixel coordinates (R, 2): origins and unit directions, (R, 3) float32, world."""
        fx, fy, cx, cy = self.intrinsics
        in_camera = np.stack(
            [(pixels[:, 0] - cx) / fx, (cy - pixels[:, 1]) / fy, np.full(len(pixels), -1.0)],
            axis=-1,
        )
        in_camera /= np.linalg.norm(in_camera, axis=-1, keepdims=True)
        directions = in_camera @ self.world_from_camera[:3, :3].T
        origins = np.broadcast_to(self.eye, directions.shape)
        return (
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
        )

    def project(self, points: Double | Float) -> Double:
        """Pixel coordinates (P, 2) of world points (P, 3) before the camera."""
        camera_from_world = np.linalg.inv(self.world_from_camera)
        in_camera = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        fx, fy, cx, cy = self.intrinsics
        x, y, depth = in_camera[:, 0], in_camera[:, 1], -in_camera[:, 2]
        return np.stack([cx + fx * x / depth, cy - fy * y / depth], axis=-1)


def is_of_turned(
    intrinsics: tuple[float, float, float, float], width: float, height: float
) -> bool:
    """Whether fx, fy, cx, cy are those of a picture of these sides that was turned by a quarter:
    the axis lies clearly nearer to the middle of that one."""
    _, _, x, y = intrinsics
    here = max(abs(x / width - 0.5), abs(y / height - 0.5))
    there = max(abs(x / height - 0.5), abs(y / width - 0.5))
    return bool(2 * there < here)
