"""Polygons that a fan from their first corner would leave, cut into triangles that they hold."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from usdbrdf.model.arrays import Array, Bool, Double, Int, Long

# Of a polygon's area: by how much a triangle of its fan may be wound the other way, as rounding and
# quads that are not quite flat have it.
_ROUNDING = 1e-9
# Polygons of more corners keep their fan: to look for ears takes the square of their number, and of
# each corner that is cut so many are looked at in the mean.
_MOST_CORNERS, _MOST_LOOKS = 2_000, 16
# A quad whose fan leaves it, as where the corner before or behind its first is not convex.
OTHER_DIAGONAL = ((1, 2, 3), (1, 3, 0))


def fans_that_leave(points: Array, corners: Int | Long, polygon: Int | Long) -> Long:
    """The polygons of which some triangle (T, 3) is wound against the polygon itself, as of those
    that are not convex; ``polygon`` (T,) says which polygon each triangle is of, in order."""
    starts = np.flatnonzero(np.diff(polygon, prepend=-1))
    if len(starts) in (0, len(polygon)):  # nothing but triangles
        return np.zeros(0, np.int64)
    first, second, third = (points[corners[:, k]].astype(np.float64) for k in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        across = np.cross(second - first, third - first)
        whole = np.add.reduceat(across, starts)
        sizes = np.diff(starts, append=len(polygon))
        of = np.repeat(whole, sizes, axis=0)
        against = (across * of).sum(axis=1) < -_ROUNDING * (of**2).sum(axis=1)
    against &= np.repeat(sizes, sizes) <= _MOST_CORNERS - 2
    return np.unique(polygon[against]).astype(np.int64)


def ears(points: Array) -> Long:
    """(N - 2, 3) corners of the triangles of one polygon (N, 3) whose fan leaves it, each wound as
    it is: ears that are cut off one by one. What crosses itself has none in the end, and what is
    left of it becomes a fan.

    All triangles have the polygon's own corners; those of no area may be among them.
    """
    if len(points) == len(OTHER_DIAGONAL) + 2:
        return np.array(OTHER_DIAGONAL, np.int64)
    plane = _flattened(np.asarray(points, np.float64))
    left, triangles, at = np.arange(len(plane)), [], 0
    looks = _MOST_LOOKS * len(plane)
    while len(left) > 3:
        found, looked = _ear(plane[left], at % len(left), looks)
        if found is None:
            break
        at, looks = found, looks - looked
        triangles.append([left[at - 1], left[at], left[(at + 1) % len(left)]])
        left = np.delete(left, at)
    triangles += [[left[0], *pair] for pair in pairwise(left[1:])]
    return np.array(triangles, np.int64)


def _flattened(points: Double) -> Double:
    """(N, 2) in the plane that the polygon has most area in, seen so that it runs anticlockwise."""
    points = np.nan_to_num(points - points[0])
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), np.finfo(np.float64).tiny)
    across = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    return np.asarray(points @ np.stack([across, np.cross(normal, across)], axis=1))


def _ear(plane: Double, start: int, most: int) -> tuple[int | None, int]:
    """The first corner from ``start`` on whose triangle holds no other corner of the polygon, of
    the ``most`` next ones, or None; and how many were looked at."""
    before, after = np.roll(plane, 1, axis=0), np.roll(plane, -1, axis=0)
    turn = _turns(before, plane, after)
    # What lies in a triangle of convex corners has one that is not convex in it.
    reflex = plane[turn <= 0]
    convex = np.roll(np.flatnonzero(turn > 0), -int((turn[:start] > 0).sum()))[:most].tolist()
    for i, at in enumerate(convex):
        triangle = before[at], plane[at], after[at]
        if not _inside(reflex, triangle).any():
            return int(at), i + 1
    return None, len(convex)


def _inside(points: Double, triangle: tuple[Double, Double, Double]) -> Bool:
    """(N,): in a triangle or on its border, but not where a corner is, as where a cut joins an
    outline to a hole in it."""
    a, b, c = triangle
    within = (_turns(a, b, points) >= 0) & (_turns(b, c, points) >= 0) & (_turns(c, a, points) >= 0)
    for corner in triangle:
        within &= (points != corner).any(axis=1)
    return np.asarray(within, np.bool_)


def _turns(before: Double, here: Double, after: Double) -> Double:
    """How far to the left each way (..., 2) turns: twice a triangle's area."""
    one, two = here - before, after - here
    return np.asarray(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
