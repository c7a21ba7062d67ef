"""The asset, its light and the models put in -> one scene: the captured emitters, or others in
their place; models placed by numbers, a matrix, or by letting them fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.asset.readers.render_scene import RenderScene, render_scene_from_file, sky_of_picture
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.light import DistantLight, Light, RelitScene, ShapeLight, SkyLight
from usdbrdf.model.material import (
    Material,
    Surface,
    constant_map,
    corner_base_colours,
    normal_reflectance,
    preview_material,
    turned_up,
    with_corner_colours,
)
from usdbrdf.options import Insert, RelightOptions
from usdbrdf.transport.environment import in_working_space, unknown_primaries
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.mesh_files import model_from_file
from usdbrdf.untrusted.pictures import picture_from_file
from usdbrdf.untrusted.usd_files import refuse_broken_meshes, render_scene_of_usd

USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})
SKY_SUFFIXES = frozenset({".exr", ".hdr"})
# Two bounding boxes are of one object if their corners differ by less than this share of their
# diagonal, or by a millimetre.
_SAME_SHARE, _SAME_M = 0.02, 1e-3
_CREASE_ANGLE_DEG = 40.0
_UP = {"Y": np.array([0.0, 1, 0]), "Z": np.array([0.0, 0, 1])}


def relit_scene(asset: RenderScene, options: RelightOptions, eye_height: float) -> RelitScene:
    """All surfaces and lights, in metres, in the asset's world; models fall from ``eye_height``."""
    if not asset.surfaces:
        raise InputRefused(
            "no mesh of the asset is visible. Look at what edits.usda hides. [relight.empty]"
        )
    scene = RelitScene(surfaces=asset.surfaces, lights=asset.lights)
    if options.lights is not None:
        surfaces, lights = _light_of_file(options.lights, asset.up_axis, options.allow_outside)
        scene = lit_by_others(scene, surfaces, lights, keep_emitters=options.keep_emitters)
    for insert in options.inserts:
        model = _model(insert, asset, options.allow_outside)
        dressed = [with_material(surface, insert) for surface in model]
        inserted = placed(dressed, insert, asset, scene.surfaces, eye_height)
        scene = replace(scene, surfaces=(*scene.surfaces, *inserted))
    if not _emits_light(scene):
        warn("nothing in the scene emits light; the picture will be black.")
    return scene


def _emits_light(scene: RelitScene | RenderScene) -> bool:
    return bool(scene.lights) or any(surface.material.emits for surface in scene.surfaces)


def lit_by_others(
    captured: RelitScene,
    surfaces: Sequence[Surface],
    lights: Sequence[Light],
    *,
    keep_emitters: bool,
) -> RelitScene:
    """The captured surfaces in other light; their own, and the lights of their stage, are
    switched off unless kept.

    surfaces  of the file that brings the light: those that glow are lights. One that stands where
              a captured object is takes its place.
    """
    glowing = [surface for surface in surfaces if surface.material.emits]
    own = captured.surfaces
    if not keep_emitters:
        own = tuple(replace(s, material=s.material.unlit) if s.material.emits else s for s in own)

    def same_place(a: Surface, b: Surface) -> bool:
        diagonal = float(np.linalg.norm(b.bounds[1] - b.bounds[0]))
        return bool(np.abs(a.bounds - b.bounds).max() <= max(_SAME_SHARE * diagonal, _SAME_M))

    own = tuple(s for s in own if not any(same_place(s, light) for light in glowing))
    kept = captured.lights if keep_emitters else ()
    return RelitScene(surfaces=(*own, *glowing), lights=(*kept, *lights))


def _light_of_file(
    file: Path, up_axis: str, allow: Sequence[Path]
) -> tuple[Sequence[Surface], Sequence[Light]]:
    if file.suffix.lower() in SKY_SUFFIXES:
        radiance = in_working_space(picture_from_file(file), file)
        if unknown := unknown_primaries(file):
            warn(unknown)
        return (), (sky_of_picture(radiance, up_axis),)
    found = _scene_of_others(file, allow)
    if not _emits_light(found):
        raise InputRefused(
            f"{file}: no light in it, and no mesh that glows. Add UsdLux lights or an "
            "emissiveColor. [relight.lights]"
        )
    turn = turned_up(found.up_axis, up_axis)
    surfaces = [surface.moved(turn) for surface in found.surfaces]
    return surfaces, [light.moved(turn) for light in found.lights]


def _model(insert: Insert, asset: RenderScene, allow: Sequence[Path]) -> tuple[Surface, ...]:
    """In metres, with the asset's up axis."""
    suffix = insert.model.suffix.lower()
    if suffix in USD_SUFFIXES:
        found = _scene_of_others(insert.model, allow)
        if found.lights:
            warn(f"{insert.model}: the lights of an inserted model are left out; see --lights.")
        surfaces, model_up, scale = found.surfaces, found.up_axis, 1.0
    else:
        # glTF says metres and y up; the others say nothing and are taken to be as the asset is.
        surfaces = surfaces_from_model(insert.model)
        model_up = "Y" if suffix == ".glb" else asset.up_axis
        scale = 1.0 if suffix == ".glb" else asset.metres_per_unit
    if not surfaces:
        raise InputRefused(f"{insert.model}: no mesh in it. Export the surface. [relight.model]")
    turn = turned_up(insert.up or model_up, asset.up_axis) @ np.diag([scale, scale, scale, 1.0])
    return tuple(surface.moved(turn) for surface in surfaces)


def surfaces_from_model(path: Path) -> tuple[Surface, ...]:
    """The meshes of an OBJ, PLY or GLB file, in the file's own axes and units.

    Meshes that bring no normals are smooth where their faces meet at less than 40 degrees.
    """
    found = list(model_from_file(path))
    for i, surface in enumerate(found):
        if np.isnan(surface.corner_normals).any():
            points = np.asarray(surface.points, np.float32)
            smooth = corner_normals(points, surface.triangles, _CREASE_ANGLE_DEG)
            found[i] = replace(surface, corner_normals=smooth)
    return tuple(found)


def _scene_of_others(path: Path, allow: Sequence[Path]) -> RenderScene:
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
    """A file of others in this process, which is to be a child, and its warnings."""
    warnings: list[str] = []
    refuse_broken_meshes(path)
    return render_scene_from_file(path, warnings.append), warnings


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
    dielectric = constant_map(float(normal_reflectance(ior)))
    mixed = preview_material(
        diffuse=base,
        metallic=metallic,
        roughness=material.roughness,
        emission=material.emission,
        dielectric=dielectric,
    )
    colours = corner_base_colours(surface)
    clear = material.clear and not metallic.any()
    mixed = replace(mixed, wrap=material.wrap, lobe=material.lobe, clear=clear)
    surface = replace(surface, material=mixed)
    if colours is None:
        return surface
    # Which stand in place of the map, also of a metal's.
    return with_corner_colours(surface, colours, float(metallic[0, 0, 0]), dielectric)


def placed(
    surfaces: Sequence[Surface],
    insert: Insert,
    asset: RenderScene,
    scene: Sequence[Surface],
    eye_height: float,
) -> tuple[Surface, ...]:
    """The model's surfaces (metres, up axis as the asset's) where the insert wants them.

    scene       what a falling model comes to rest on
    eye_height  metres along the up axis, from which it falls unless a height is given
    """
    if insert.matrix is not None:
        world_from_model = np.array(insert.matrix, np.float64)
        world_from_model[:3, 3] *= asset.metres_per_unit
        return tuple(surface.moved(world_from_model) for surface in surfaces)
    # Counter-clockwise about the axis, seen from its tip.
    x, y, z = _UP[asset.up_axis]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])
    angle = np.radians(insert.rotate_deg)
    turn = np.eye(4)
    turn[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    turn = turn @ np.diag([*(insert.scale,) * 3, 1.0])
    model = tuple(surface.moved(turn) for surface in surfaces)
    if insert.drop is None:
        return _shifted(model, np.array(insert.at or (0.0, 0.0, 0.0)) * asset.metres_per_unit)
    wanted = np.array(insert.drop) * asset.metres_per_unit
    vertical = int(np.argmax(_UP[asset.up_axis]))
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


def _shifted(surfaces: Sequence[Surface], offset: Double) -> tuple[Surface, ...]:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return tuple(surface.moved(matrix) for surface in surfaces)


def _soup(surfaces: Sequence[Surface]) -> tuple[Double, Int]:
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    points = np.concatenate([surface.points for surface in surfaces])
    triangles = [s.triangles + starts[i] for i, s in enumerate(surfaces)]
    return points, np.concatenate(triangles).astype(np.int32)


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
