"""Embree: closest hits and occlusion over the triangle soup. The only importer of embreex."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from usdbrdf.errors import UsdBrdfError

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# embreex traces one ray at a time and releases the GIL: chunks this long keep every core busy
# while the Python overhead of a call stays far below a per cent.
_CHUNK = 1 << 16
BOX_FACES = 64


@dataclass(frozen=True, kw_only=True)
class Hits:
    """First surfaces along R rays.

    face      (R,) int32, index of the triangle, -1 where the ray left the scene
    u, v      (R,) float32, hit = (1-u-v) p0 + u p1 + v p2
    distance  (R,) float32, in units of the direction's length; meaningless where face is -1
    """

    face: Int
    u: Float
    v: Float
    distance: Float


class RayScene:
    """A committed Embree scene. Results do not depend on the number of threads.

    points (V, 3) float32, triangles (F, 3) int32: what it was made of
    """

    def __init__(self, points: Float, triangles: Int) -> None:
        """points (V, 3) float32 finite; triangles (F, 3) int32 inside [0, V).

        Embree reports neither bad indices nor NaN triangles, so both are refused here.
        """
        if triangles.size == 0:
            raise UsdBrdfError("a ray scene needs at least one triangle")
        if triangles.min() < 0 or triangles.max() >= len(points) or not np.isfinite(points).all():
            raise UsdBrdfError("a ray scene got a face index out of range or a non-finite vertex")
        self.points: Float = np.ascontiguousarray(points, np.float32)
        self.triangles: Int = np.ascontiguousarray(triangles, np.int32)
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, self.points, self.triangles)
        self._pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1)
        # Embree commits lazily inside the first query, which is not safe from two threads at once.
        self.closest(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    @cached_property
    def boxes(self) -> Float:
        """Low and high corner of the box around every BOX_FACES triangles in turn, (B, 2, 3)."""
        first = np.arange(0, len(self.triangles), BOX_FACES)
        low = np.full((len(first), 3), np.inf, np.float32)
        high = -low
        for corner in range(3):
            at = self.points[self.triangles[:, corner]]
            low = np.minimum(low, np.minimum.reduceat(at, first))
            high = np.maximum(high, np.maximum.reduceat(at, first))
        return np.stack([low, high], axis=1)

    def closest(self, origins: Float, directions: Float) -> Hits:
        """First hit of each ray; origins and directions (R, 3) float32 in the world frame."""
        if len(origins) <= _CHUNK:
            found = self._scene.run(origins, directions, output=True)
            return Hits(face=found["primID"], u=found["u"], v=found["v"], distance=found["tfar"])
        face = np.full(len(origins), -1, np.int32)
        u, v, distance = (np.zeros(len(origins), np.float32) for _ in range(3))

        def trace(part: slice) -> None:
            found: dict[str, Any] = self._scene.run(origins[part], directions[part], output=True)
            face[part] = found["primID"]
            u[part], v[part], distance[part] = found["u"], found["v"], found["tfar"]

        self._in_chunks(len(origins), trace)
        return Hits(face=face, u=u, v=v, distance=distance)

    def occluded(self, origins: Float, directions: Float, distances: Float) -> Bool:
        """True where anything lies between 0 and ``distances`` along each ray, (R,) bool."""
        blocked = np.zeros(len(origins), np.bool_)

        def trace(part: slice) -> None:
            found = self._scene.run(
                origins[part], directions[part], dists=distances[part], query="OCCLUDED"
            )
            blocked[part] = found >= 0

        self._in_chunks(len(origins), trace)
        return blocked

    def _in_chunks(self, count: int, trace: Callable[[slice], None]) -> None:
        parts = [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]
        if len(parts) == 1:
            trace(parts[0])
        else:
            list(self._pool.map(trace, parts))


def lift_from_surface(positions: Float, normals: Float, scene_size: float) -> Float:
    """Origins just above the surface, so that a ray does not hit the triangle it starts on.

    The lift is 1e-5 of the scene's size plus the float32 spacing of the coordinates themselves
    (positions, normals (R, 3) float32; scene_size in the same unit).
    """
    spacing = 4 * np.float32(1.2e-7) * np.abs(positions).max(axis=-1, keepdims=True)
    lifted = positions + normals * (np.float32(1e-5 * scene_size) + spacing)
    return np.ascontiguousarray(lifted, np.float32)
