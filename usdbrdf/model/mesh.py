"""Triangle meshes as they were captured, and polygons as triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.polygons import OTHER_DIAGONAL, ears, fans_that_leave

# What a person may ask about an object: of shading, of the fit; and what is then not fitted.
LAMP, METAL, GLASS, REFIT = "lamp", "metal", "glass", "refit"
OF_SHADE, OF_FIT = (LAMP, "not-lamp"), ("ignore", METAL, GLASS, REFIT)
DIRECTIVES = (*OF_FIT, *OF_SHADE)
LEFT_OUT = ("ignore", GLASS)
# What the status of a fit is where frames do not determine it, but tell of it, or may.
IN_PART = ("bounded", "undetermined")


@dataclass(frozen=True, kw_only=True)
class ObjectLabel:
    """One object of the segmentation: a USD identifier, the name as captured, its class, and which
    of ``DIRECTIVES`` the capture has for it, "" for none."""

    identifier: str
    label: str
    class_name: str = ""
    directive: str = ""


class ObjectName(NamedTuple):
    """What a capture calls an object; of a Segmentation."""

    label: str
    class_name: str = ""
    directive: str = ""


@dataclass(frozen=True, kw_only=True)
class ScanMesh:
    """All triangles of the scan in one soup, in scene units.

    points          (V, 3) float32
    triangles       (F, 3) int32, counter-clockwise seen from outside
    corner_normals  (F, 3, 3) float32, unit shading normals
    face_object     (F,) int32, index into Scan.objects
    """

    points: Float
    triangles: Int
    corner_normals: Float
    face_object: Int

    @cached_property
    def face_normals(self) -> Double:
        """(F, 3) of unit length, as the faces are wound; zeros without area."""
        return face_normals_and_angles(self.points, self.triangles)[0]

    @cached_property
    def diagonal(self) -> float:
        """Of the box around all points, in their unit."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))


@dataclass(frozen=True, kw_only=True)
class ScanGeometry:
    """The captured surface as a file holds it, in the file's own units.

    mesh                      USD: world transforms applied; corner normals are NaN where the file
                              has none to use
    has_normals               (F,) bool: the file gives the face's normals; None: it gives none
    usd_geometry              the file, if it is USD and is to be referenced, not copied
    object_prims              of USD, per object, its path below the default prim ("." is the prim
                              itself)
    meters_per_unit, up_axis  "Y" or "Z"; None where the file does not say
    warnings                  sentences about what was left out or simplified
    label_source              who divided it into objects: "capture"; or we did, into "connected"
                              parts; or it is yet to be "segmented"
    """

    mesh: ScanMesh
    objects: tuple[ObjectLabel, ...]
    has_normals: Bool | None = None
    usd_geometry: Path | None = None
    object_prims: tuple[str, ...] = ()
    meters_per_unit: float | None = None
    up_axis: str | None = None
    warnings: tuple[str, ...] = ()
    label_source: str = "capture"


# What a value of a primvar belongs to: a polygon's corner, a point, a point of the surface, a
# polygon, the whole mesh.
INTERPOLATIONS = ("faceVarying", "vertex", "varying", "uniform", "constant")


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """T triangles of P polygons with C corners in all.

    triangles  (T, 3) int32, point indices, counter-clockwise seen from outside
    corners    (T, 3) int32, index of each triangle corner among the C polygon corners
    polygon    (T,) int32, the polygon that each triangle came from
    """

    triangles: Int
    corners: Int
    polygon: Int

    def element_of_corner(self, interpolation: str) -> Int:
        """(T, 3) int32: which value of a primvar of this interpolation each corner has."""
        by_interpolation: tuple[Int, ...] = (
            self.corners,
            self.triangles,
            self.triangles,
            np.repeat(self.polygon[:, None], 3, axis=1),
            np.zeros_like(self.triangles),
        )
        return by_interpolation[INTERPOLATIONS.index(interpolation)]


def triangulate(
    counts: Int | Long,
    indices: Int | Long,
    *,
    left_handed: bool = False,
    holes: Int | None = None,
    points: Array | None = None,
) -> Triangulation:
    """Fans from each polygon's first corner; polygons that are holes or have no area disappear.

    counts   (P,) corners per polygon
    indices  (C,) point of each corner
    holes    numbers of polygons; those of none are ignored, as USD's renderers do
    points   (V, 3): where they are given, polygons whose fan would leave them are cut otherwise, in
             as many triangles; indices are inside [0, V) then
    """
    counts = np.asarray(counts, np.int64)
    fans = np.maximum(counts - 2, 0)
    if holes is not None:
        fans[holes[(holes >= 0) & (holes < len(counts))]] = 0
    polygon = np.repeat(np.arange(len(counts)), fans)
    in_fan = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    firsts = np.cumsum(counts) - counts
    first = firsts[polygon]
    corners = np.stack([first, first + in_fan + 1, first + in_fan + 2], axis=-1)
    indices = np.asarray(indices, np.int32)
    if points is not None:
        leaving = fans_that_leave(points, indices[corners], polygon)
        quads = leaving[counts[leaving] == len(OTHER_DIAGONAL) + 2]
        for k, triangle in enumerate(OTHER_DIAGONAL):
            corners[np.searchsorted(polygon, quads) + k] = firsts[quads, None] + triangle
        for i in np.setdiff1d(leaving, quads).tolist():
            own = indices[firsts[i] : firsts[i] + counts[i]]
            corners[slice(*np.searchsorted(polygon, (i, i + 1)))] = firsts[i] + ears(points[own])
    if left_handed:
        corners = corners[:, [0, 2, 1]]
    return Triangulation(
        triangles=indices[corners].reshape(-1, 3),
        corners=corners.astype(np.int32),
        polygon=polygon.astype(np.int32),
    )


def joined(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Int, Int]:
    """Points (V, 3) and triangles (F, 3) of many meshes in one soup: its points, its triangles
    int32, and (F,) int32 the mesh that each triangle is of."""
    firsts = np.cumsum([0, *[len(points) for points, _ in parts]])
    shifted = [triangles + first for (_, triangles), first in zip(parts, firsts, strict=False)]
    return (
        np.concatenate([points for points, _ in parts]),
        np.concatenate(shifted, dtype=np.int32),
        np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in shifted]),
    )


def compact(points: Array, triangles: Array) -> tuple[Array, Array, Int]:
    """The numbers of the points (V, 3) that triangles (F, 3) use, in order; these points; and the
    triangles between them, int32."""
    used, corners = np.unique(triangles, return_inverse=True)
    return used, points[used], corners.reshape(-1, 3).astype(np.int32)


def halved(points: Float, part: Long) -> tuple[Long, Long]:
    """The points (V, 3) numbered ``part`` in two halves beside each other along their widest side,
    of an odd number more in the second."""
    along = points[part, int(np.ptp(points[part], axis=0).argmax())]
    order = part[np.argsort(along, kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def welded_ids(points: Float) -> Int:
    """(V,) int32: vertices with bit-equal positions (V, 3) float32 get the same number.

    Numbers run from 0 without gaps, in the order of x, then y, then z. Minus zero equals zero.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    position = np.asarray(points, np.float32) + np.float32(0)  # -0.0 becomes 0.0
    order = np.lexsort((position[:, 2], position[:, 1], position[:, 0]))
    in_order = position[order]
    differs = np.zeros(len(points), np.int32)
    differs[1:] = (in_order[1:] != in_order[:-1]).any(axis=1)
    ids = np.zeros(len(points), np.int32)
    ids[order] = np.cumsum(differs, dtype=np.int32)
    return ids


def welded(mesh: ScanMesh) -> ScanMesh:
    """The same mesh, whose corners at one position share the first vertex there."""
    _, first, number = np.unique(welded_ids(mesh.points), return_index=True, return_inverse=True)
    return replace(mesh, triangles=first[number].astype(np.int32)[mesh.triangles])


def is_closed(triangles: Int) -> bool:
    """Whether triangles (F, 3) without copies of points enclose something: each edge belongs to two
    of them, which run along it in opposite directions."""
    start, end = triangles.reshape(-1).astype(np.int64), np.roll(triangles, -1, axis=1).reshape(-1)
    span = int(triangles.max(initial=0)) + 1
    there, back = np.sort(start * span + end), np.sort(end * span + start)
    return bool(np.array_equal(there, back) and (np.diff(there) > 0).all())


def edges_of_two(triangles: Int, owner: Int | None = None) -> tuple[Long, Long]:
    """Edges that exactly two triangles (F, 3), without copies of points, share, of one ``owner``
    (F,) if these are given: the corner of either, (N,) counted through all triangles, from which
    the edge runs to its triangle's next corner."""
    start, end = triangles.reshape(-1).astype(np.int64), np.roll(triangles, -1, axis=1).reshape(-1)
    span = int(triangles.max(initial=0)) + 1
    edge = np.maximum(start, end) * span + np.minimum(start, end)
    of_corner = np.zeros_like(edge) if owner is None else np.repeat(owner, 3)
    order = np.lexsort((of_corner, edge))
    differs = (np.diff(edge[order]) != 0) | (np.diff(of_corner[order]) != 0)
    first = np.flatnonzero(np.concatenate([[True], differs]))
    pairs = first[np.diff(first, append=len(order)) == 2]
    return order[pairs], order[pairs + 1]


_AT_A_TIME = 1 << 18  # triangles


def doubled_areas(points: Float | Double, triangles: Int) -> Double:
    """(F,) float64, twice the triangles' areas, in the points' unit squared; some triangles at a
    time, which takes little memory."""
    doubled = np.empty(len(triangles))
    for start in range(0, len(triangles), _AT_A_TIME):
        part = slice(start, start + _AT_A_TIME)
        doubled[part] = np.linalg.norm(across_triangles(points, triangles[part]), axis=1)
    return doubled


def across_triangles(points: Float | Double, triangles: Int) -> Double:
    """(F, 3) float64 along the triangles' normals, as long as twice their areas."""
    first, second, third = (points[triangles[:, k]].astype(np.float64) for k in range(3))
    return np.asarray(np.cross(second - first, third - first))


def face_normals_and_angles(points: Float, triangles: Int) -> tuple[Double, Double]:
    """Unit face normals (F, 3) and corner angles (F, 3) in radians; zeros without area."""
    # x, y and z of the first, second and third corners, (3, 3, F): NumPy is several times as fast
    # along the many faces as along the three numbers of each.
    corner = np.ascontiguousarray(points.T, np.float64)[:, triangles.T]
    edge = np.roll(corner, -1, axis=1) - corner  # from each corner to the next
    length = _lengths(edge)
    # Unit edges first: the product of two tiny edges would underflow, that of unit ones cannot.
    x, y, z = edge = np.divide(edge, length, out=np.zeros_like(edge), where=length > 0)
    u, v, w = back = -np.roll(edge, 1, axis=1)
    across = np.stack([y * w - z * v, z * u - x * w, x * v - y * u])
    sine, cosine = _lengths(across), (edge * back).sum(axis=0)
    best = np.take_along_axis(across, sine.argmax(axis=0)[None, None], axis=1)[:, 0]
    size = _lengths(best)
    has_area = size > 1e-12
    normal = np.divide(best, size, out=np.zeros_like(best), where=has_area)
    angles = np.where(has_area, np.arctan2(sine, cosine), 0.0)
    return np.ascontiguousarray(normal.T), np.ascontiguousarray(angles.T)


def _lengths(vectors: Double) -> Double:
    """(...) of (3, ...)."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=0)))
