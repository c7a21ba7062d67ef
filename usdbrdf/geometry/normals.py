"""Shading normals of a triangle soup: smooth on smooth surfaces, sharp at creases."""

from __future__ import annotations

import math

import numpy as np

from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.mesh import doubled_areas, face_normals_and_angles, welded_ids

# The pairs of corners around one vertex grow with the square of their number. Beyond this a vertex
# is the hub of a fan that no smoothing can help; its corners keep their faces' normals.
_MAX_CORNERS = 4096


def corner_normals(points: Float, triangles: Int, crease_angle_deg: float) -> Float:
    """Unit normal of every triangle corner, (F, 3, 3) float32.

    n(corner) ~ sum of angle(c) area(face of c) n(face of c) over the corners c that share the
    corner's position and whose faces lean less than ``crease_angle_deg`` from the corner's own
    face. By their angles alone the narrow faces of a bevel would turn the normals of the wide flat
    ones beside them, all over these: by 2 degrees on the mean in a room of furniture, 0.1 with the
    areas. Triangles of a scan are of one size. Positions count, not vertex numbers, so seams in the
    file leave no seams in the shading. The result depends on nothing but the arguments. A corner of
    a triangle without area gets (0, 0, 1).

    points     (V, 3) float32, finite
    triangles  (F, 3) int32
    """
    if len(triangles) == 0:
        return np.zeros((0, 3, 3), np.float32)
    faces, angles = face_normals_and_angles(points, triangles)
    weights = (angles * doubled_areas(points, triangles)[:, None]).reshape(-1)
    vertex_of_corner = welded_ids(points)[triangles].reshape(-1)
    corners = np.argsort(vertex_of_corner, kind="stable")
    starts = np.searchsorted(
        vertex_of_corner[corners], np.arange(int(vertex_of_corner.max()) + 2)
    ).astype(np.int64)
    # The small margin keeps a crease of exactly the limit smooth whatever the rounding.
    min_cosine = math.cos(math.radians(crease_angle_deg)) - 1e-6
    normals = np.zeros((3 * len(triangles), 3), np.float32)
    _sum_over_neighbours(len(starts) - 1, corners, starts, faces, weights, min_cosine, normals)
    return normals.reshape(-1, 3, 3)


@parallel_kernel
def _sum_over_neighbours(
    start: int, stop: int, corners: Long, starts: Long, faces: Double, weights: Double,
    min_cosine: float, normals: Float,
) -> None:  # fmt: skip
    """Each corner is written by one vertex alone and summed in file order: threads do not show."""
    for vertex in range(start, stop):
        first, last = starts[vertex], starts[vertex + 1]
        alone = last - first > _MAX_CORNERS
        for i in range(first, last):
            own = faces[corners[i] // 3]
            x, y, z = own[0], own[1], own[2]
            if not alone:
                x = y = z = 0.0
                for j in range(first, last):
                    other = faces[corners[j] // 3]
                    cosine = own[0] * other[0] + own[1] * other[1] + own[2] * other[2]
                    if cosine >= min_cosine:
                        x += weights[corners[j]] * other[0]
                        y += weights[corners[j]] * other[1]
                        z += weights[corners[j]] * other[2]
            size = math.sqrt(x * x + y * y + z * z)
            if size > 0.0:
                normals[corners[i], 0] = x / size
                normals[corners[i], 1] = y / size
                normals[corners[i], 2] = z / size
            else:
                normals[corners[i], 2] = 1.0
