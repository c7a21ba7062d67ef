"""The sample's room: geometry, albedo and materials, in NumPy alone.

Units are metres, z is up, the room's corner is the origin. Every object is closed but for the sides
on which it stands or hangs, because no camera could ever see those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Triangles = npt.NDArray[np.int32]
Mesh = tuple[Array, Triangles]
Pattern = Callable[[Array], Array]

ROOM = (3.8, 3.2, 2.4)
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StudyObject:
    """One object with its truth.

    points     (V, 3) metres
    triangles  (F, 3) counter-clockwise seen from the lit side
    albedo     (V, 3) in [0, 1], linear between vertices
    phi, psi   roughness and specular of the BRDF
    emission   radiance of the lamps, RGB
    """

    name: str
    class_name: str
    points: Array
    triangles: Triangles
    albedo: Array
    phi: float
    psi: float
    emission: tuple[float, float, float] = BLACK


# ---- shapes ------------------------------------------------------------------------------------


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
    """A horizontal disc seen from above; the middle is a tiny hole closed by a point."""
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


# ---- albedo patterns: (V, 3) points to (V, 3) colours ------------------------------------------


def plain(*rgb: float) -> Pattern:
    return lambda p: np.broadcast_to(np.array(rgb), p.shape).copy()


def blend(share: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Array:
    return np.array(low) + share[:, None] * (np.array(high) - np.array(low))


def parquet(p: Array) -> Array:
    """Square tiles of 0.4 m in two woods, with a slow variation between the boards."""
    tile = np.floor(p[:, 0] / 0.4 + 1e-6) + np.floor(p[:, 1] / 0.4 + 1e-6)
    tone = 0.5 + 0.5 * np.sin(3.1 * p[:, 0] + 1.3) * np.sin(2.3 * p[:, 1])
    return blend(tile % 2, (0.20, 0.11, 0.06), (0.38, 0.24, 0.13)) * (0.8 + 0.4 * tone[:, None])


def wallpaper(p: Array) -> Array:
    """Upright stripes, 0.5 m apart, that swell and fade over the height."""
    stripe = 0.5 + 0.5 * np.cos(2 * np.pi * p[:, 1] / 0.5)
    swell = 0.75 + 0.25 * np.cos(2 * np.pi * p[:, 2] / 1.2)
    return blend(stripe * swell, (0.62, 0.58, 0.48), (0.22, 0.34, 0.30))


def weave(p: Array) -> Array:
    """A rug: a border, and lozenges of 0.36 m."""
    lozenge = np.sin(np.pi * (p[:, 0] + p[:, 1]) / 0.36) * np.sin(
        np.pi * (p[:, 0] - p[:, 1]) / 0.36
    )
    inside = (np.abs(p[:, 0] - 1.9) < 0.63) & (np.abs(p[:, 1] - 1.6) < 0.33)
    colour = blend((lozenge > 0).astype(float), (0.42, 0.10, 0.09), (0.62, 0.53, 0.40))
    return np.where(inside[:, None], colour, np.array([0.10, 0.12, 0.22]))


def walnut(p: Array) -> Array:
    """Broad dark bands along the table."""
    band = 0.5 + 0.5 * np.sin(2 * np.pi * (p[:, 1] / 0.22 + 0.25 * np.sin(2.5 * p[:, 0])))
    return blend(band, (0.07, 0.035, 0.02), (0.17, 0.09, 0.05))


def painting(p: Array) -> Array:
    """Soft patches of three colours, each larger than 0.15 m."""
    x, z = p[:, 0], p[:, 2]
    first = 0.5 + 0.5 * np.sin(9.0 * x + 2.0 * np.sin(5.0 * z))
    second = 0.5 + 0.5 * np.sin(8.0 * z + 2.0 * np.sin(6.0 * x) + 1.0)
    return np.stack(
        [
            0.08 + 0.55 * first,
            0.08 + 0.25 * first * second + 0.2 * second,
            0.10 + 0.45 * (1 - first) * second,
        ],
        1,
    )


# ---- the room ----------------------------------------------------------------------------------


def thing(
    name: str,
    class_name: str,
    mesh: Mesh,
    pattern: Pattern,
    phi: float,
    psi: float,
    emission: tuple[float, float, float] = BLACK,
) -> StudyObject:
    points, triangles = mesh
    # The mesh file holds float32, so that is what is rendered and where albedo is evaluated.
    points = points.astype(np.float32).astype(np.float64)
    return StudyObject(
        name, class_name, points, triangles, pattern(points), phi, psi, emission=emission
    )


def room_shell() -> list[StudyObject]:
    x, y, z = np.diag(ROOM)
    o = np.zeros(3)
    white = plain(0.74, 0.73, 0.70)
    return [
        thing("floor", "floor", rectangle(o, x, y, 1 / 15), parquet, 0.16, 0.70),
        thing("ceiling", "ceiling", rectangle(z, y, x, 0.20), white, 0.80, 0.10),
        thing("wall_south", "wall", rectangle(o, z, x, 0.12), white, 0.70, 0.20),
        thing("wall_east", "wall", rectangle(x, z, y, 0.10), plain(0.20, 0.40, 0.44), 0.30, 0.60),
        thing("wall_north", "wall", rectangle(y, x, z, 0.12), white, 0.60, 0.30),
        thing("wall_west", "wall", rectangle(o, y, z, 0.08), wallpaper, 0.45, 0.40),
    ]


def furniture() -> list[StudyObject]:
    cream, oak = plain(0.66, 0.60, 0.48), plain(0.40, 0.26, 0.14)
    drum = np.array([(0.27, z) for z in np.linspace(0, 0.42, 9)])
    pouf = joined([turned((0.58, 2.62), drum, 36), disc((0.58, 2.62), 0.27, 0.42, 36, 6)])
    return [
        thing("rug", "rug", box((1.15, 1.15, 0), (2.65, 2.05, 0.012), 0.06, "d"), weave, 0.95, 0.02),
        thing(
            "table_top", "table", box((1.45, 1.3, 0.4), (2.35, 1.9, 0.44), 0.05), walnut, 0.08, 0.80
        ),
        thing(
            "table_base",
            "table",
            box((1.6, 1.45, 0.012), (2.2, 1.75, 0.4), 0.06, "du"),
            oak,
            0.4,
            0.4,
        ),
        thing(
            "bookcase", "cabinet", box((0, 0.2, 0), (0.42, 1.05, 1.2), 0.06, "wd"), cream, 0.2, 0.6
        ),
        thing(
            "sideboard",
            "cabinet",
            box((2.3, 2.75, 0), (3.6, 3.2, 0.75), 0.06, "nd"),
            oak,
            0.25,
            0.5,
        ),
        thing("pouf", "seat", pouf, plain(0.16, 0.28, 0.18), 0.90, 0.05),
    ]


def ornaments() -> list[StudyObject]:
    height = np.linspace(0, 1, 21)
    radius = 0.075 + 0.085 * np.sin(np.pi * height**0.8) ** 2 + 0.02 * height**6
    vase = turned((3.42, 1.35), np.stack([radius, 0.72 * height], 1), 36)
    lid = disc((3.42, 1.35), float(radius[-1]), 0.72, 36, 3)
    frame = box((1.0, 3.175, 1.1), (2.0, 3.2, 1.8), 0.04, "n")
    return [
        thing("vase", "ornament", joined([vase, lid]), plain(0.05, 0.12, 0.36), 0.06, 0.90),
        thing(
            "ball_red",
            "ornament",
            sphere((2.95, 0.5, 0.22), 0.22, 3),
            plain(0.50, 0.07, 0.05),
            0.12,
            0.75,
        ),
        thing(
            "ball_ochre",
            "ornament",
            sphere((2.7, 2.98, 0.91), 0.16, 3),
            plain(0.52, 0.34, 0.08),
            0.30,
            0.50,
        ),
        thing("picture", "picture", frame, painting, 0.04, 0.55),
    ]


def lamps() -> list[StudyObject]:
    shade = plain(0.10, 0.10, 0.10)
    globe = sphere((0.24, 0.62, 1.38), 0.18, 3)
    panel = box((1.5, 0.3, 2.38), (2.7, 1.0, 2.4), 0.10, "u")
    return [
        thing("globe_lamp", "lamp", globe, shade, 0.5, 0.5, (11.0, 8.6, 6.0)),
        thing("panel_lamp", "lamp", panel, shade, 0.5, 0.5, (7.2, 7.9, 8.8)),
    ]


def study_objects() -> list[StudyObject]:
    """All objects; the index in this list is the ``object_id`` of the mesh."""
    return room_shell() + furniture() + ornaments() + lamps()
