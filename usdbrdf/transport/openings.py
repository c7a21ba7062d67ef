"""Where light comes in from outside: triangles of a box around the scene, which rays can be sent to
as to any lamp's.

A window is no surface: what shines there lies far behind it, and few cosine-distributed rays find
it. But whatever leaves the scene leaves a box around it, and what brings much light leaves it near
the window. A triangle of the box is as bright as what points of the surface receive through it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.environment import Environment, pixels_of_directions
from usdbrdf.transport.rays import RayScene, lift_from_surface
from usdbrdf.transport.warps import cosine_rays

# Cells of the box along its longest side; by how much of its diagonal it is larger than the scene;
# how many points look for the openings, with how many rays each; random numbers of their own.
_CELLS, _MARGIN, _POINTS, _RAYS, _SEED = 64, 1e-3, 1 << 14, 64, 0x09E4
# Points that see more of the outside than this, as walls' outer sides do, find its light without
# being sent there.
_OPEN = 0.5


class Openings(NamedTuple):
    """C triangles of a box around the scene, two for each of its cells.

    box       (3, 3) float64: the lowest corner, the sides of a cell, the number of cells along each
              axis (all 0: there is no box)
    corners   (C, 3, 3) float64, metres; their normals point inwards; area (C,) m^2
    weight    (C,) float64, W/(m^2 sr) m^2: what all points receive through each, over pi
    arriving  W/(m^2 sr), what they receive from anywhere, the mean over a hemisphere
    """

    box: Double
    corners: Double
    area: Double
    weight: Double
    arriving: float


NO_OPENINGS = Openings(np.zeros((3, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0), 0.0)


def openings_of(
    scene: Scene, texels: Texels, rays: RayScene, brightness: Double, environment: Environment
) -> Openings:
    """Of a scene whose faces shine with ``brightness`` (F,), W/(m^2 sr), in its surroundings."""
    area = np.where(texels.interior, texels.area, 0).astype(np.float64)
    if not environment.image.any() or not area.any():
        return NO_OPENINGS
    low, high = scene.points.min(axis=0), scene.points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    box = _box_around(low.astype(np.float64), high.astype(np.float64), _MARGIN * diagonal)
    corners = _corners_of(box)
    # Texels of equal steps of the summed area: evenly over the surface.
    steps = area.sum() * (np.arange(_POINTS) + 0.5) / _POINTS
    index = np.minimum(np.searchsorted(np.cumsum(area), steps), len(area) - 1)
    normal = texels.normal[index]
    origin = lift_from_surface(texels.position[index], normal, diagonal)
    # Ray by ray of all points, and so are the arrays below.
    towards = cosine_rays(normal, np.arange(_POINTS), _SEED, _RAYS)
    origin = np.tile(origin, (_RAYS, 1))
    face = rays.closest(origin, towards).face
    leaves = face < 0
    counts = np.tile(leaves.reshape(_RAYS, _POINTS).mean(axis=0) <= _OPEN, _RAYS)
    out, within = np.flatnonzero(leaves & counts), np.flatnonzero(~leaves & counts)
    if not len(out):
        return NO_OPENINGS
    height, width, _ = environment.image.shape
    pixel = pixels_of_directions(towards[out], height, width, environment.z_up)
    outside = environment.image.reshape(-1, 3).max(axis=1)[pixel].astype(np.float64)
    met = _openings_met(box, origin[out], towards[out])
    of_ray = area.sum() / len(towards)
    return Openings(
        box=box,
        corners=corners,
        area=np.linalg.norm(np.cross(*np.diff(corners, axis=1).transpose(1, 0, 2)), axis=1) / 2,
        weight=of_ray * np.bincount(met, outside, len(corners)),
        arriving=float((outside.sum() + brightness[face[within]].sum()) / counts.sum()),
    )


def _box_around(low: Double, high: Double, margin: float) -> Double:
    side = high - low + 2 * margin
    count = np.maximum(np.ceil(_CELLS * side / side.max()), 1)
    return np.stack([low - margin, side / count, count])


def _corners_of(box: Double) -> Double:
    """(C, 3, 3) of all triangles, numbered as ``opening_at`` does."""
    lowest, cell, count = box
    parts = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        i, j = np.meshgrid(np.arange(count[a]), np.arange(count[b]), indexing="ij")
        for high in (0, 1):
            at = np.zeros((*i.shape, 2, 3, 3))
            for triangle, steps in enumerate((((0, 0), (1, 0), (0, 1)), ((1, 1), (0, 1), (1, 0)))):
                # The other way round on the upper side: normals point inwards.
                for corner, (u, v) in enumerate(steps if not high else (steps[0], *steps[:0:-1])):
                    at[:, :, triangle, corner, a] = i + u
                    at[:, :, triangle, corner, b] = j + v
            at[..., axis] = high * count[axis]
            parts.append(at.reshape(-1, 3, 3))
    return np.asarray(lowest + cell * np.concatenate(parts))


@loop
def opening_at(
    box: Double, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> tuple[int, float]:
    """The triangle of the box through which a ray from inside it leaves, and how many times its
    direction away that is."""
    origin, direction = (x, y, z), (dx, dy, dz)
    nearest, side, start, first = np.inf, 0, 0, 0
    for axis in range(3):
        cells = int(box[2, (axis + 1) % 3] * box[2, (axis + 2) % 3])
        along = direction[axis]
        if along != 0:
            up = 1 if along > 0 else 0
            distance = (box[0, axis] + up * box[1, axis] * box[2, axis] - origin[axis]) / along
            if distance < nearest:
                nearest, side, start = distance, axis, first + 2 * up * cells
        first += 4 * cells
    a, b = (side + 1) % 3, (side + 2) % 3
    u = (origin[a] + nearest * direction[a] - box[0, a]) / box[1, a]
    v = (origin[b] + nearest * direction[b] - box[0, b]) / box[1, b]
    i = min(max(int(u), 0), int(box[2, a]) - 1)
    j = min(max(int(v), 0), int(box[2, b]) - 1)
    beyond = 1 if (u - i) + (v - j) > 1 else 0
    return start + 2 * (i * int(box[2, b]) + j) + beyond, nearest


@loop
def _openings_met(box: Double, origin: Float, direction: Float) -> Long:
    """(R,) of rays that leave."""
    met = np.empty(len(origin), np.int64)
    for r in range(len(origin)):
        x, w = origin[r], direction[r]
        met[r], _ = opening_at(box, x[0], x[1], x[2], w[0], w[1], w[2])
    return met
