"""The far surroundings as a surface: a dome that rays meet which leave the scan.

What lies outside is measured as everything else is, by the frames that see it, and shines as
everything else does. It is so far away that a direction tells its place: across a scan its texels
shift by less than they are wide.
"""

from __future__ import annotations

import math

import numpy as np

from usdbrdf.model.arrays import Double, Float, Int

# Diagonals of the scan from its middle to the dome.
DISTANCE = 200.0
# Faces around and from pole to pole, and texels likewise.
_AROUND, _DOWN = 64, 32
RESOLUTION = (512, 256)


def dome(points: Float, up_axis: str) -> tuple[Float, Int]:
    """Points (V, 3) and triangles (F, 3), seen from inside, about a scan's ``points``, whose axis
    ``up_axis`` ("Y" or "Z") points at a pole."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    radius = DISTANCE * float(np.linalg.norm(high - low))
    azimuth = 2 * np.pi * np.arange(_AROUND) / _AROUND
    height = np.pi * (0.5 - np.arange(1, _DOWN) / _DOWN)
    ring = np.stack(
        [
            np.outer(np.cos(height), np.sin(azimuth)),
            np.repeat(np.sin(height)[:, None], _AROUND, axis=1),
            np.outer(np.cos(height), np.cos(azimuth)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    y_up = np.concatenate([[[0.0, 1.0, 0.0]], ring, [[0.0, -1.0, 0.0]]])
    directions = y_up if up_axis == "Y" else y_up[:, [0, 2, 1]] * [1, -1, 1]
    last = len(y_up) - 1
    triangles = []
    for column in range(_AROUND):
        near, far = column, (column + 1) % _AROUND
        triangles.append((0, 1 + far, 1 + near))
        for row in range(_DOWN - 2):
            a, b = 1 + row * _AROUND + near, 1 + row * _AROUND + far
            triangles += [(a, b, b + _AROUND), (a, b + _AROUND, a + _AROUND)]
        triangles.append((1 + (_DOWN - 2) * _AROUND + near, 1 + (_DOWN - 2) * _AROUND + far, last))
    placed = (low + high) / 2 + radius * directions
    return placed.astype(np.float32), np.array(triangles, np.int32)


def directions_of_dome(corners: Float) -> Double:
    """(..., 3) unit, from the dome's middle to points on it; corners (F, 3, 3) of its faces."""
    flat = corners.reshape(-1, 3).astype(np.float64)
    out = corners - (flat.min(axis=0) + flat.max(axis=0)) / 2
    return np.asarray(out / np.linalg.norm(out, axis=-1, keepdims=True), np.float64)


def lat_long_uv(corners: Float) -> Float:
    """(F, 3, 2) texture coordinates, v up, in the layout of OpenEXR and UsdLux: the top row is the
    pole of the up axis, the middle column looks along +z of a y-up world. corners (F, 3, 3) of the
    faces of a ``dome``, the first of which is the pole."""
    x, y, z = np.moveaxis(directions_of_dome(corners), -1, 0)
    y_up = bool(y[0, 0] > z[0, 0])
    up, ahead = (y, z) if y_up else (z, -y)
    middle = np.stack([x.sum(axis=1), ahead.sum(axis=1)])
    of_face = np.arctan2(*middle)[:, None]
    # Where a face crosses the seam, or ends at a pole, its middle tells the column.
    azimuth = of_face + np.remainder(np.arctan2(x, ahead) - of_face + np.pi, 2 * np.pi) - np.pi
    azimuth = np.where(np.hypot(x, ahead) < 1e-6, of_face, azimuth)
    v = 0.5 + np.arcsin(np.clip(up, -1, 1)) / np.pi
    uv = np.clip(np.stack([0.5 - azimuth / (2 * math.pi), v], axis=-1), 0, 1)
    return np.asarray(uv, np.float32)
