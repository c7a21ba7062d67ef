"""Models from other files, placed in the scene: by numbers, a matrix, or by letting them fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.asset.readers.render_scene import RenderScene, render_scene_from_file
from usdbrdf.errors import UsageError
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.light import DistantLight, ShapeLight, SkyLight
from usdbrdf.model.material import (
    Material,
    Surface,
    constant_map,
    normal_reflectance,
    preview_material,
)
from usdbrdf.options import Insert
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.mesh_files import model_from_file
from usdbrdf.untrusted.usd_files import render_scene_of_usd

_CREASE_ANGLE_DEG = 40.0


def surfaces_from_model(path: Path) -> tuple[Surface, ...]:
    """The meshes of an OBJ, PLY or GLB file, in the file's own axes and units.

    Meshes that bring no normals are smooth where their faces meet at less than 40 degrees.
    """
    return tuple(
        replace(surface, corner_normals=_smooth(surface))
        if np.isnan(surface.corner_normals).any()
        else surface
        for surface in model_from_file(path)
    )


def _smooth(surface: Surface) -> Float:
    points = np.asarray(surface.points, np.float32)
    return corner_normals(points, surface.triangles, _CREASE_ANGLE_DEG)


def render_scene_of_others(path: Path, allow: Sequence[Path]) -> RenderScene:
    """Surfaces and lights of a USD file that is not ours; what is left out is said.

    allow  folders outside the file's own that its asset paths may lead into
    """
    parts = (RenderScene, Surface, Material, ShapeLight, DistantLight, SkyLight)
    reader = f"{__name__}:read_published_here"
    found, warnings = render_scene_of_usd(path, reader, allow=allow, parts=parts)
    for sentence in warnings:
        warn(sentence)
    assert isinstance(found, RenderScene)
    return found


def read_published_here(path: Path) -> tuple[RenderScene, list[str]]:
    """``render_scene_of_others`` in this process, which is to be a child, and its warnings."""
    warnings: list[str] = []
    return render_scene_from_file(path, warnings.append), warnings


_UP = {"Y": np.array([0.0, 1, 0]), "Z": np.array([0.0, 0, 1])}


def rotation_about(up_axis: str, degrees: float) -> Double:
    """(4, 4) counter-clockwise seen from the tip of the axis."""
    x, y, z = _UP[up_axis]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])
    angle = np.radians(degrees)
    turn = np.eye(4)
    turn[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn


def placed(
    surfaces: Sequence[Surface],
    insert: Insert,
    *,
    up_axis: str,
    metres_per_unit: float,
    scene: Sequence[Surface],
    eye_height: float,
) -> tuple[Surface, ...]:
    """The model's surfaces (metres, up axis as the scene's) where the insert wants them.

    scene       what a falling model comes to rest on
    eye_height  metres along the up axis, from which it falls unless a height is given
    """
    if insert.matrix is not None:
        world_from_model = np.array(insert.matrix, np.float64)
        world_from_model[:3, 3] *= metres_per_unit
        return tuple(surface.moved(world_from_model) for surface in surfaces)
    turn = rotation_about(up_axis, insert.rotate_deg) @ np.diag([*(insert.scale,) * 3, 1.0])
    turned = tuple(surface.moved(turn) for surface in surfaces)
    if insert.drop is None:
        return _shifted(turned, np.array(insert.at or (0.0, 0.0, 0.0)) * metres_per_unit)
    return _dropped(turned, insert, up_axis, metres_per_unit, scene, eye_height)


def with_material(surface: Surface, insert: Insert) -> Surface:
    """The surface with what the insert says about its material; what it does not say, stays."""
    material = surface.material
    if insert.roughness is not None:
        material = replace(material, roughness=constant_map(insert.roughness)[..., :1])
    base = material.diffuse if material.base is None else material.base
    if insert.color is not None:
        surface = replace(surface, corner_colour=None, corner_f0=None)
        base = constant_map(*insert.color)
    if insert.ior is not None or insert.metallic is not None:
        metallic = constant_map(insert.metallic or 0.0)[..., :1]
    elif insert.color is not None and material.metallic is not None:
        metallic = material.metallic  # the same metal in another colour
    else:
        if insert.color is not None:
            material = replace(material, diffuse=base)
        return replace(surface, material=material)
    ior = 1.5 if insert.ior is None else insert.ior
    mixed = preview_material(
        diffuse=base,
        metallic=metallic,
        roughness=material.roughness,
        emission=material.emission,
        ior=ior,
    )
    material = replace(mixed, wrap=material.wrap)
    if surface.corner_colour is None or not metallic.any():
        return replace(surface, material=material, corner_f0=None)
    return _coloured_metal(surface, material, float(metallic[0, 0, 0]), ior)


def _coloured_metal(surface: Surface, material: Material, metallic: float, ior: float) -> Surface:
    """The surface whose metalness takes the colours of its corners."""
    assert surface.corner_colour is not None
    dielectric = normal_reflectance(ior)
    f0 = dielectric + np.float32(metallic) * (surface.corner_colour - dielectric)
    mean = constant_map(*(float(value) for value in f0.reshape(-1, 3).mean(axis=0)))
    return replace(
        surface,
        corner_colour=surface.corner_colour * np.float32(1 - metallic),
        corner_f0=np.asarray(f0, np.float32),
        material=replace(material, diffuse=constant_map(1.0), f0=mean),
    )


def _shifted(surfaces: Sequence[Surface], offset: Double) -> tuple[Surface, ...]:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return tuple(surface.moved(matrix) for surface in surfaces)


def _dropped(
    model: tuple[Surface, ...],
    insert: Insert,
    up_axis: str,
    metres_per_unit: float,
    scene: Sequence[Surface],
    eye_height: float,
) -> tuple[Surface, ...]:
    """The model over the wanted place, at the height at which it first touches the scene."""
    assert insert.drop is not None
    wanted = np.array(insert.drop) * metres_per_unit
    vertical = int(np.argmax(_UP[up_axis]))
    level = [axis for axis in range(3) if axis != vertical]
    bounds = np.array([surface.bounds for surface in model])
    middle = (bounds[:, 0].min(axis=0) + bounds[:, 1].max(axis=0)) / 2
    offset = np.zeros(3)
    # In a y-up world the horizontal coordinates are x and z.
    offset[level] = wanted[:2] - middle[level]
    over = _shifted(model, offset)
    start = wanted[2] if len(wanted) == 3 else eye_height
    rest = _resting_height(_soup(over), _soup(scene), vertical, start)
    if rest is None:
        raise UsageError(
            f"--insert {insert.model}: nothing lies below drop="
            f"{','.join(f'{value:g}' for value in insert.drop)} to come to rest on. Choose another "
            "place, or a height as third number. [relight.drop]"
        )
    return _shifted(over, np.eye(3)[vertical] * rest)


def _resting_height(
    model: tuple[Double, Int], scene: tuple[Double, Int], vertical: int, start: float
) -> float | None:
    """What to add to the model's heights so that it touches the scene from above.

    Both ways: the model's points fall on the scene's triangles, and the scene's points below
    ``start`` rise to the model's. Where an edge alone meets an edge, nothing is noticed.
    """
    points, triangles = model
    points = points[np.unique(triangles)]
    heights = points[:, vertical]
    met, distance = _first_hits(scene, points, vertical, start, -1.0)
    lifts = start - distance[met] - heights[met]

    level = [axis for axis in range(3) if axis != vertical]
    below = scene[0][np.unique(scene[1])]
    inside = (below >= points.min(axis=0)) & (below <= points.max(axis=0))
    below = below[inside[:, level].all(axis=1) & (below[:, vertical] < start)]
    base = heights.min() - 1.0
    met, distance = _first_hits(model, below, vertical, base, 1.0)
    lifts = np.concatenate([lifts, below[met, vertical] - (base + distance[met])])
    return float(lifts.max()) if len(lifts) else None


def _first_hits(
    soup: tuple[Double, Int], points: Double, vertical: int, height: float, way: float
) -> tuple[Bool, Float]:
    """Which of the vertical lines through points (P, 3), from a height on up (way 1) or down (-1),
    meet the triangles, and how far from there."""
    origins = points.astype(np.float32)
    origins[:, vertical] = height
    directions = np.zeros((len(points), 3), np.float32)
    directions[:, vertical] = way
    hits = RayScene(soup[0].astype(np.float32), soup[1]).closest(origins, directions)
    return hits.face >= 0, hits.distance


def _soup(surfaces: Sequence[Surface]) -> tuple[Double, Int]:
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    points = np.concatenate([surface.points for surface in surfaces])
    triangles = [s.triangles + starts[i] for i, s in enumerate(surfaces)]
    return points, np.concatenate(triangles).astype(np.int32)
