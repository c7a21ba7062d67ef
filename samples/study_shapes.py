"""Triangle meshes of simple shapes, as (V, 3) points and (F, 3) triangles seen from outside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Triangles = npt.NDArray[np.int32]
Mesh = tuple[Array, Triangles]


def joined(parts: list[Mesh]) -> Mesh:
    """Several meshes as one; vertices stay apart, so edges between the parts stay sharp."""
    offsets = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    return (
        np.concatenate([points for points, _ in parts]),
        np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=True)]).astype(np.int32),
    )


def rectangle(corner: Array, side_u: Array, side_v: Array, edge: float) -> Mesh:
    """A flat grid of triangles about ``edge`` long; its normal is ``side_u x side_v``."""
    nu, nv = (max(1, round(float(np.linalg.norm(side)) / edge)) for side in (side_u, side_v))
    u, v = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1))
    points = corner + u.reshape(-1, 1) * side_u + v.reshape(-1, 1) * side_v
    return points, lattice_triangles(nv, nu, nu + 1)


def lattice_triangles(rows: int, columns: int, row_stride: int, wrap: bool = False) -> Triangles:
    """Two triangles per cell of a lattice; ``wrap`` closes the last column onto the first."""
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    right = (c + 1) % columns if wrap else c + 1
    a, b = r * row_stride + c, r * row_stride + right
    d, e = (r + 1) * row_stride + c, (r + 1) * row_stride + right
    return np.concatenate([np.stack([a, b, e], 1), np.stack([a, e, d], 1)]).astype(np.int32)


def box(low: tuple[float, ...], high: tuple[float, ...], edge: float, without: str = "") -> Mesh:
    """An axis-aligned box seen from outside, without the named sides: of ``w e s n d u``."""
    lo, hi = np.array(low), np.array(high)
    x, y, z = np.diag(hi - lo)
    sides = {
        "w": (lo, z, y),
        "e": (lo + x, y, z),
        "s": (lo, x, z),
        "n": (lo + y, z, x),
        "d": (lo, y, x),
        "u": (lo + z, x, y),
    }
    return joined([rectangle(*sides[s], edge) for s in sides if s not in without])


def sphere(centre: tuple[float, ...], radius: float, subdivisions: int) -> Mesh:
    """An icosahedron, each subdivision of which quarters the triangles."""
    g = (1 + 5**0.5) / 2
    signs = [(-1, g), (1, g), (-1, -g), (1, -g)]
    points = [(a, b, 0.0) for a, b in signs] + [(0.0, a, b) for a, b in signs]
    points += [(b, 0.0, a) for a, b in signs]
    faces = "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8"
    faces += " 3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 11 6 2 10 8 6 7 9 8 1"
    unit = np.array(points) / np.hypot(1, g)
    triangles = np.array(faces.split(), dtype=np.int32).reshape(-1, 3)
    for _ in range(subdivisions):
        unit, triangles = quartered(unit, triangles)
    return np.array(centre) + radius * unit, triangles


def quartered(unit: Array, triangles: Triangles) -> Mesh:
    """Each triangle of a unit sphere split in four, new vertices shared and on the sphere."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, where = np.unique(edges, axis=0, return_inverse=True)
    middle = unit[pairs].sum(1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = (len(unit) + where.reshape(-1, 3)).T
    a, b, c = triangles.T
    split = [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
    four = np.concatenate([np.stack(corner, 1) for corner in split]).astype(np.int32)
    return np.concatenate([unit, middle]), four


def turned(centre: tuple[float, float], profile: Array, segments: int) -> Mesh:
    """A surface of revolution about the vertical; ``profile`` (P, 2) is radius, z from below up."""
    angle = np.arange(segments) * 2 * np.pi / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    rings = [
        np.column_stack([np.array(centre) + r * circle, np.full(segments, z)]) for r, z in profile
    ]
    return np.concatenate(rings), lattice_triangles(len(profile) - 1, segments, segments, wrap=True)


def disc(centre: tuple[float, float], radius: float, z: float, segments: int, rings: int) -> Mesh:
    """A horizontal disc seen from above: rings, and a fan about the middle."""
    profile = np.array([(radius * k / rings, z) for k in range(rings, 0, -1)])
    points, triangles = turned(centre, profile, segments)
    first, last = len(points) - segments, np.arange(segments)
    fan = np.stack([first + last, first + (last + 1) % segments, np.full(segments, len(points))], 1)
    tip = np.array([[*centre, z]])
    return np.concatenate([points, tip]), np.concatenate([triangles, fan]).astype(np.int32)


def vertex_normals(points: Array, triangles: Triangles) -> Array:
    """(V, 3) area-weighted normals: exact on flat sides, smooth on balls and turned shapes."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area_normal = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, triangles[:, k], area_normal)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
