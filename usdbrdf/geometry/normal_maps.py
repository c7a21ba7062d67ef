"""What a coarse mesh shows of the fine one in whose place it stands: the point of the fine surface
that each of its texels shows, and the fine normals as a map in the coarse mesh's tangent space.

The space is that of glTF and UsdPreviewSurface: x along growing u, y along growing v (up in the
picture), z along the coarse normal; corners get the tangents that MikkTSpace gives them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.mesh import face_normals_and_angles
from usdbrdf.transport.rays import Hits, RayScene

# No normal of a map leans more than this from the coarse surface's, as a cosine: renderers divide
# by it, and a surface that turns its back to the viewer is black.
_LEAST_Z = 0.05
# Surfaces that face the other way, which a ray goes through to one that is meant.
_SHEETS = 4


def corner_tangents(
    points: Float | Double, triangles: Int, corner_normals: Float, corner_uv: Float
) -> Float:
    """(F, 3, 4) float32: of every triangle corner a unit tangent across its normal, along growing
    u, and the sign s of the bitangent s (n x t), along growing v.

    As MikkTSpace (M. Mikkelsen, "Simulation of wrinkled surfaces revisited", 2008) has it: at each
    corner its triangle's direction of u, flattened along the corner's normal; of corners with one
    position, normal, uv and sign the mean, by the angles that their triangles have there.

    points (V, 3); triangles (F, 3); corner_normals (F, 3, 3), unit; corner_uv (F, 3, 2), v up
    """
    corner = np.asarray(points, np.float64)[triangles]
    normals, uv = corner_normals.astype(np.float64), corner_uv.astype(np.float64)
    (e1, e2), (a, b) = ((x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (corner, uv))
    sign = np.where(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0, -1.0, 1.0)
    along = (e1 * b[:, 1:] - e2 * a[:, 1:]) * sign[:, None]
    tangents = _across(np.repeat(along[:, None], 3, axis=1), normals)
    onward = _across(np.roll(corner, -1, axis=1) - corner, normals)
    back = _across(np.roll(corner, -2, axis=1) - corner, normals)
    angles = np.arccos(np.clip((onward * back).sum(axis=2), -1, 1))
    signs = np.repeat(sign[:, None, None], 3, axis=1)
    rows = np.concatenate([corner, normals, uv, signs], axis=2).reshape(-1, 9)
    _, group = np.unique(rows.astype(np.float32), axis=0, return_inverse=True)
    weighted = (tangents * angles[..., None]).reshape(-1, 3)
    group = group.ravel()
    sums = np.zeros((int(group.max(initial=-1)) + 1, 3))
    np.add.at(sums, group, weighted)
    found = _across(sums[group].reshape(-1, 3, 3), normals)
    # Where there is none, as in a triangle without area in the picture, any direction across.
    axis: Double = np.eye(3)[np.abs(normals).argmin(axis=2)]
    found = np.where(np.abs(found).max(axis=2, keepdims=True) > 0, found, _across(axis, normals))
    return np.concatenate([found, signs], axis=2).astype(np.float32)


def _across(vectors: Double, normals: Double) -> Double:
    """Unit vectors (..., 3) in the planes across unit normals; zero where nothing is left."""
    flat = vectors - normals * (normals * vectors).sum(axis=-1, keepdims=True)
    size = np.linalg.norm(flat, axis=-1, keepdims=True)
    least = 1e-9 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(flat, size, out=np.zeros_like(flat), where=size > least))


def interpolated(corner_values: Float, hits: Hits) -> Float:
    """(R, C) float32: values (F, 3, C) of triangle corners at the points that rays hit."""
    own = corner_values[hits.face]
    u, v = hits.u[:, None], hits.v[:, None]
    return np.asarray((1 - u - v) * own[:, 0] + u * own[:, 1] + v * own[:, 2], np.float32)


def seen_along_normals(
    fine: RayScene, positions: Float, normals: Float, reach_m: float
) -> tuple[Hits, Bool]:
    """The point of a fine surface that each of R points of a coarse one stands for: the nearest one
    along the coarse normal, to either side, that faces the same way; and whether there is one.

    positions, normals  (R, 3) float32, on the coarse surface, normals of unit length
    reach_m             no fine point is farther
    """
    facing = face_normals_and_angles(fine.points, fine.triangles)[0]
    # From a little behind: where both surfaces meet, rounding lets either be in front.
    behind = np.float32(1e-3 * reach_m) + 8 * np.float32(1.2e-7) * np.abs(positions).max(initial=0)
    nearest = np.full(len(positions), np.inf, np.float32)
    best = Hits(np.full(len(positions), -1, np.int32), *np.zeros((3, len(positions)), np.float32))
    for sign in (np.float32(1), np.float32(-1)):
        waiting, passed = np.arange(len(positions)), np.full(len(positions), -behind, np.float32)
        for _ in range(_SHEETS):
            directions = np.ascontiguousarray(sign * normals[waiting])
            start = positions[waiting] + directions * passed[:, None]
            hits = fine.closest(start.astype(np.float32), directions)
            away = hits.distance + passed
            near = (hits.face >= 0) & (away <= reach_m)
            same = np.einsum("rc,rc->r", facing[hits.face], normals[waiting]) > 0
            better = near & same & (np.abs(away) < nearest[waiting])
            nearest[waiting[better]] = np.abs(away[better])
            for known, new in zip(best, hits, strict=True):
                known[waiting[better]] = new[better]
            # Behind the other side of something thin lies the side that is meant.
            on = near & ~same
            waiting, passed = waiting[on], away[on] + behind
            if not len(waiting):
                break
    return best, np.isfinite(nearest)


def at(hits: Hits, index: Long) -> Hits:
    """Some of them, in any order."""
    return Hits(hits.face[index], hits.u[index], hits.v[index], hits.distance[index])


def nearest_of(positions: Float, known: Bool) -> Long:
    """(R,) int64: of points (R, 3) the nearest that is known, itself where it is; one is."""
    index = np.flatnonzero(known)
    found = np.arange(len(positions))
    if len(index) < len(positions):
        _, nearest = cKDTree(positions[index]).query(positions[~known])
        found[~known] = index[nearest]
    return found


def in_tangent_space(vectors: Float, normals: Float, tangents: Float) -> Float:
    """(R, 3) float32 unit normals in frames of unit normals (R, 3) and tangents (R, 4), which need
    not be quite across them; none leans more from z than a renderer can show."""
    t, b = _frame(normals, tangents)
    local = np.stack([(vectors * axis).sum(axis=1) for axis in (t, b, normals)], axis=1)
    local[:, 2] = np.maximum(local[:, 2], _LEAST_Z)
    return np.asarray(local / np.linalg.norm(local, axis=1, keepdims=True), np.float32)


def from_tangent_space(local: Float, normals: Float, tangents: Float) -> Float:
    """The inverse of ``in_tangent_space``, as a renderer does it: (R, 3) float32, unit."""
    t, b = _frame(normals, tangents)
    x, y, z = (local[:, k, None] for k in range(3))
    return unit(x * t + y * b + z * normals)


def unit(vectors: Float | Double) -> Float:
    """(R, 3) float32: vectors at length 1; zero stays."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-30), np.float32)


def _frame(normals: Float, tangents: Float) -> tuple[Double, Double]:
    upright = normals.astype(np.float64)
    t = _across(tangents[:, :3].astype(np.float64), upright)
    return t, np.cross(upright, t) * tangents[:, 3:]


def sampled(image: Float, uv: Float, wrap: str) -> Float:
    """(R, C) float32: bilinear lookup in an image (H, W, C) at uv (R, 2), v up; ``wrap``, "clamp",
    "repeat" or "mirror", is what lies beyond 0 to 1."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    found = np.zeros((len(uv), image.shape[2]), np.float32)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        across = np.abs(1 - right - (x - left))
        along = np.abs(1 - down - (y - top))
        row, column = _wrapped(top + down, height, wrap), _wrapped(left + right, width, wrap)
        found += (across * along).astype(np.float32)[:, None] * image[row, column]
    return found


def _wrapped(index: Long, count: int, wrap: str) -> Long:
    if wrap == "repeat":
        return index % count
    if wrap == "mirror":
        folded = index % (2 * count)
        return np.minimum(folded, 2 * count - 1 - folded)
    return np.clip(index, 0, count - 1)
