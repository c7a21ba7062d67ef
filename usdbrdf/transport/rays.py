"""Closest hits over the triangle soup."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np

from usdbrdf.errors import UsdBrdfError
from usdbrdf.model.arrays import Float, Int
from usdbrdf.transport.embree import EmbreeScene, closest_hits, empty_hits
from usdbrdf.transport.embree import Hits as Hits

# Rays are traced one at a time without Python's lock: chunks this long keep every core busy.
_CHUNK = 1 << 16
BOX_FACES = 64


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
        self._scene = EmbreeScene(points, triangles)
        self.points, self.triangles = self._scene.points, self._scene.triangles
        self._pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1)

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

    @property
    def address(self) -> int:
        """What the compiled loops of ``embree`` know the scene by, as long as this object lives."""
        return self._scene.address

    def closest(self, origins: Float, directions: Float) -> Hits:
        """First hit of R rays: directions (R, 3), origins (P, 3), 1 <= P <= R, ray r from r % P,
        all float32 in the world frame."""
        count = len(directions)
        hits: Hits = empty_hits(count)
        in_turn = len(origins) < count

        def trace(part: slice) -> None:
            closest_hits(
                self.address, origins if in_turn else origins[part], directions[part],
                Hits._make(values[part] for values in hits),
            )  # fmt: skip

        self._in_chunks(count, len(origins) if in_turn else 1, trace)
        return hits

    def _in_chunks(self, count: int, whole: int, trace: Callable[[slice], None]) -> None:
        """Rays 0 to count in parts of a multiple of ``whole``."""
        step = max(1, _CHUNK // whole) * whole
        parts = [slice(start, min(start + step, count)) for start in range(0, count, step)]
        if len(parts) == 1:
            trace(parts[0])
        else:
            list(self._pool.map(trace, parts))


def lift_from_surface(positions: Float, normals: Float, diagonal_m: float) -> Float:
    """Origins just above the surface, so that a ray does not hit the triangle it starts on.

    The lift is 1e-5 of the scene's diagonal plus the float32 spacing of the coordinates themselves
    (positions, normals (R, 3) float32, metres).
    """
    spacing = 4 * np.float32(1.2e-7) * np.abs(positions).max(axis=-1, keepdims=True)
    lifted = positions + normals * (np.float32(1e-5 * diagonal_m) + spacing)
    return np.ascontiguousarray(lifted, np.float32)
