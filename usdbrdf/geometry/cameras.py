"""Pinhole cameras: rays through pixels, and world points into pixels.

Camera frame: x right, y up, looks down -z (OpenGL, and UsdGeomCamera). Pixel frame: x right,
y down, first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]


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
