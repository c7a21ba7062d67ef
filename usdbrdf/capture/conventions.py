"""Readings of camera poses that are mixed up with ours: OpenGL axes, world from camera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from usdbrdf.model.arrays import Double

# OpenCV's camera (y down, looking down +z) has OpenGL's second and third axis reversed.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
# What nerfstudio's documents of 2022 had done to the world without saying so.
OLD_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def opengl_from_opencv(world_from_camera: Double) -> Double:
    """(..., 4, 4) poses of cameras that look down +z with y down, as our cameras stand."""
    # Not a product of matrices: of an infinite number that would make others NaN, with a warning.
    return np.asarray(world_from_camera * np.diag(_FLIP), np.float64)


def _transposed(pose: Double) -> Double:
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3].T
    return turned


def _turned(axis: int, quarters: int) -> Callable[[Double], Double]:
    """Poses turned about y (1) or z (2) by quarters, with the mesh that somebody has turned so."""
    first, second = (2, 0) if axis == 1 else (0, 1)
    quarter = np.eye(4)
    quarter[[first, second], [first, second]] = 0
    quarter[first, second], quarter[second, first] = -1, 1
    turn = np.linalg.matrix_power(quarter, quarters)
    return lambda pose: np.asarray(turn @ pose, np.float64)


def _beside_turned_meshes() -> dict[str, Callable[[Double], Double]]:
    return {
        f"beside a mesh turned by {90 * quarters} degrees about {'xyz'[axis]} (turn it back)": (
            _turned(axis, quarters)
        )
        for axis in (2, 1)
        for quarters in (1, 2, 3)
    }


# Mix-ups of conventions that are tried where the poses do not fit the mesh.
CONVENTIONS: dict[str, Callable[[Double], Double]] = {
    "OpenCV axes (negate columns 2 and 3)": opengl_from_opencv,
    "camera-from-world matrices (invert them)": lambda m: np.asarray(np.linalg.inv(m)),
    "camera-from-world with OpenCV axes (invert, then negate columns 2 and 3)": (
        lambda m: opengl_from_opencv(np.asarray(np.linalg.inv(m)))
    ),
    "rotations transposed (transpose them, keep the positions)": _transposed,
    "y-up poses beside a z-up mesh": lambda m: _Z_UP_FROM_Y_UP @ m,
    "z-up poses beside a y-up mesh": lambda m: _Z_UP_FROM_Y_UP.T @ m,
    "upside down beside the mesh, as Meshroom's are (negate its y and z)": lambda m: _FLIP @ m,
    "nerfstudio's axes of 2022 (state applied_transform)": lambda m: OLD_NERFSTUDIO @ m,
    **_beside_turned_meshes(),
}
