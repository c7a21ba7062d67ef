"""Models to be inserted: OBJ, PLY and GLB files with their materials, in their own frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import to_working_space
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.model.arrays import Float
from usdbrdf.model.material import Material, Surface, constant_map, preview_material
from usdbrdf.untrusted.mesh_files import SUFFIXES, mesh_from_file

_CREASE_ANGLE_DEG = 40.0

# UsdPreviewSurface's own, where a file has no material.
_GREY, _ROUGHNESS, _IOR = 0.18, 0.5, 1.5


def surfaces_from_model(path: Path) -> tuple[Surface, ...]:
    """The meshes of an OBJ, PLY or GLB file, in the file's own axes and units.

    Base colour, its texture, vertex colours, metalness, roughness and emission are read; images
    and 8-bit colours are sRGB, as these formats say.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputRefused(
            f"{path}: models are read from USD, {', '.join(SUFFIXES)}. Convert it. [relight.model]"
        )
    # Its checks first: whatever is damaged is refused there, in one sentence.
    mesh_from_file(path)
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # the readers raise whatever a damaged file makes them stumble over
        raise InputRefused(
            f"{path}: its materials cannot be read ({type(error).__name__}). Export it again. "
            "[relight.model]"
        ) from error
    found = []
    for node in sorted(scene.graph.nodes_geometry):
        world_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            found.append(_surface(f"{path.name}:{node}", mesh).moved(np.asarray(world_from_node)))
    return tuple(found)


def _surface(name: str, mesh: Any) -> Surface:
    points = np.asarray(mesh.vertices, np.float64)
    triangles = np.ascontiguousarray(mesh.faces, np.int32)
    uv = getattr(mesh.visual, "uv", None)
    corner_uv = None
    if uv is not None and len(uv) == len(points):
        corner_uv = np.asarray(uv, np.float32)[triangles]
    colours = _vertex_colours(mesh.visual)
    material = _material(mesh.visual, textured=corner_uv is not None)
    if colours is not None:
        material = preview_material(
            diffuse=constant_map(1.0),
            metallic=constant_map(0.0)[..., :1],
            roughness=material.roughness,
            emission=material.emission,
            ior=_IOR,
        )
    return Surface(
        name=name,
        points=points,
        triangles=triangles,
        corner_normals=_normals(mesh, points, triangles),
        corner_uv=corner_uv,
        corner_colour=None if colours is None else colours[triangles],
        material=material,
    )


def _normals(mesh: Any, points: Any, triangles: Any) -> Float:
    stored = mesh._cache.cache.get("vertex_normals")  # only what the file brought
    if stored is not None and len(stored) == len(points):
        normals = np.asarray(stored, np.float32)[triangles]
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        if np.isfinite(normals).all() and (length > 1e-6).all():
            return np.asarray(normals / length, np.float32)
    return corner_normals(np.asarray(points, np.float32), triangles, _CREASE_ANGLE_DEG)


def _vertex_colours(visual: Any) -> Float | None:
    """(V, 3) linear; None where the file has none."""
    if visual.kind != "vertex":
        return None
    colours = np.asarray(visual.vertex_colors, np.float32)[:, :3] / np.float32(255)
    return np.asarray(to_working_space(colours[None], "srgb_rec709_scene")[0])


def _material(visual: Any, *, textured: bool) -> Material:
    stored = getattr(visual, "material", None)
    if visual.kind != "texture" or stored is None:
        return preview_material(
            diffuse=constant_map(_GREY),
            metallic=constant_map(0.0)[..., :1],
            roughness=constant_map(_ROUGHNESS)[..., :1],
            emission=constant_map(0.0),
            ior=_IOR,
        )
    if hasattr(stored, "to_pbr"):  # the OBJ's Phong-like one
        stored = stored.to_pbr()
    base = _factor(stored.baseColorFactor, 3, 1.0)
    metal_rough = _image(stored.metallicRoughnessTexture) if textured else None
    metallic = _factor(stored.metallicFactor, 1, 1.0 if metal_rough is not None else 0.0)
    roughness = _factor(stored.roughnessFactor, 1, 1.0 if metal_rough is not None else _ROUGHNESS)
    emission = _factor(stored.emissiveFactor, 3, 0.0)
    if textured and (picture := _image(stored.baseColorTexture)) is not None:
        base = base * to_working_space(picture, "srgb_rec709_scene")
    if textured and (picture := _image(stored.emissiveTexture)) is not None:
        emission = emission * to_working_space(picture, "srgb_rec709_scene")
    if metal_rough is not None:  # glTF: roughness in green, metalness in blue
        roughness = roughness * metal_rough[..., 1:2]
        metallic = metallic * metal_rough[..., 2:3]
    mixed = preview_material(
        diffuse=base, metallic=metallic, roughness=roughness, emission=emission, ior=_IOR
    )
    # The default of OBJ and of glTF, whose samplers the reader does not keep.
    return replace(mixed, wrap="repeat")


def _factor(value: Any, channels: int, fallback: float) -> Float:
    """(1, 1, channels): trimesh keeps some factors as bytes, of which colours are linear."""
    if value is None:
        return np.full((1, 1, channels), fallback, np.float32)
    numbers = np.atleast_1d(np.asarray(value))
    if numbers.dtype == np.uint8:
        numbers = numbers / 255.0
    return np.asarray(numbers[:channels], np.float32).reshape(1, 1, channels)


def _image(picture: Any) -> Float | None:
    """(H, W, 3) float32 in [0, 1] of a PIL image."""
    if picture is None:
        return None
    return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
