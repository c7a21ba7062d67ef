"""The sample's room: geometry, albedo and materials, in NumPy alone.

Units are metres, z is up, the room's corner is the origin. Every object is closed but for the sides
on which it stands or hangs: no camera could ever see those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from study_shapes import Array, Mesh, Triangles, box, disc, joined, rectangle, sphere, turned

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
        thing(
            "rug", "rug", box((1.15, 1.15, 0), (2.65, 2.05, 0.012), 0.06, "d"), weave, 0.95, 0.02
        ),
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
            "bookcase", "cabinet", box((0, 0.9, 0), (0.38, 1.9, 1.1), 0.06, "wd"), cream, 0.2, 0.6
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
    radius = 0.10 + 0.12 * np.sin(np.pi * height**0.8) ** 2 + 0.02 * height**6
    vase = turned((3.48, 1.3), np.stack([radius, 0.95 * height], 1), 36)
    lid = disc((3.48, 1.3), float(radius[-1]), 0.95, 36, 3)
    rod = np.array([(0.025, z) for z in np.linspace(0, 1.45, 25)])
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
            sphere((2.75, 2.97, 0.95), 0.2, 3),
            plain(0.52, 0.34, 0.08),
            0.30,
            0.50,
        ),
        thing("picture", "picture", frame, painting, 0.04, 0.55),
        thing(
            "lamp_rod", "lamp_stand", turned((0.68, 0.62), rod, 10), plain(0.3, 0.3, 0.3), 0.3, 0.5
        ),
    ]


def lamps() -> list[StudyObject]:
    shade = plain(0.10, 0.10, 0.10)
    globe = sphere((0.68, 0.62, 1.6), 0.18, 3)
    panel = box((1.6, 0.5, 2.38), (2.8, 1.2, 2.4), 0.10, "u")
    return [
        thing("globe_lamp", "lamp", globe, shade, 0.5, 0.5, (11.0, 8.6, 6.0)),
        thing("panel_lamp", "lamp", panel, shade, 0.5, 0.5, (7.2, 7.9, 8.8)),
    ]


def study_objects() -> list[StudyObject]:
    """All objects; the index in this list is the ``object_id`` of the mesh."""
    return room_shell() + furniture() + ornaments() + lamps()
