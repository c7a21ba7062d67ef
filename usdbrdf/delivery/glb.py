"""Surfaces -> binary glTF 2.0: trimesh writes meshes and pictures, we the materials.

trimesh knows no extensions, keeps colours as bytes and takes materials with equal pictures for one;
so each material is written again, by its name, into the document that it is about to save:
KHR_materials_ior holds the reflectance at normal incidence, KHR_materials_emissive_strength the
radiance, 1 in the scene's unit being 1 here, and KHR_materials_transmission says what is clear.
The units and the diffuse term, which both models reduce by the Fresnel factor, are those of
UsdPreviewSurface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial

from usdbrdf.delivery.packaged_files import encoded_colour, encoded_data, size_within
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import publish, temporary_beside
from usdbrdf.files.images import resized
from usdbrdf.geometry.normal_maps import corner_tangents
from usdbrdf.model.arrays import Byte, Float
from usdbrdf.model.material import Material, Surface, constant_map

PRIM = "usdPrim"  # of a node: the path of the prim that it was
# trimesh writes other attributes of vertices under names that begin with a line.
_TANGENT = "_TANGENT"
IOR, STRENGTH = "KHR_materials_ior", "KHR_materials_emissive_strength"
TRANSMISSION = "KHR_materials_transmission"
# Of what is clear: viewers that know no transmission show a faint pane. Others weaken its
# reflections by it, but 0 would be no surface at all, and 1 a white wall where it is not known.
_PANE = 0.25
_WRAP = {"clamp": 33071, "repeat": 10497, "mirror": 33648}
_LINEAR, _LINEAR_MIPMAP = 9729, 9987


@dataclass(frozen=True, kw_only=True)
class GltfMaterial:
    """What glTF says of a material.

    numbers   its JSON without textures
    pictures  by trimesh's names of the textures, (H, W, 3) uint8
    wrap      "clamp", "repeat" or "mirror"
    """

    numbers: dict[str, Any]
    pictures: dict[str, Byte]
    wrap: str


def need_pillow() -> Any:
    """``PIL.Image``; EnvironmentFailure where there is none."""
    try:
        from PIL import Image
    except ImportError as error:
        raise EnvironmentFailure(
            ".glb needs Pillow, which is not installed. Run: pip install 'usdbrdf[package]'. "
            "[package.pillow]"
        ) from error
    return Image


def write_glb(
    output: Path, surfaces: Sequence[Surface], max_size: int | None, warn: Callable[[str], None]
) -> dict[str, Any]:
    """Write surfaces, in metres with y up, whole or not at all.

    max_size  pixels of a texture's longer side; None for any
    """
    image = need_pillow()
    if not surfaces:
        raise InputRefused(
            "no mesh of the asset is visible. Look at what edits.usda hides. [package.empty]"
        )
    scene = trimesh.Scene()
    materials: dict[str, GltfMaterial] = {}
    paths: dict[str, str] = {}
    for surface in surfaces:
        stem = name = surface.name.rsplit("/", 1)[-1]
        number = 2
        while name in materials:
            name, number = f"{stem}_{number}", number + 1
        materials[name] = gltf_material(surface, max_size, warn)
        paths[name] = surface.name
        pictures = {key: image.fromarray(p) for key, p in materials[name].pictures.items()}
        dressed = _NamedMaterial(name=name, **pictures)
        scene.add_geometry(_mesh(surface, dressed), geom_name=name, node_name=name)
    content = export_glb(
        scene,
        include_normals=True,
        tree_postprocessor=partial(_finish, materials=materials, paths=paths),
    )
    with temporary_beside(output) as staged:
        staged.write_bytes(content)
        publish(staged, output)
    return {"meshes": len(surfaces), "textures": sum(len(m.pictures) for m in materials.values())}


def gltf_material(
    surface: Surface, max_size: int | None, warn: Callable[[str], None]
) -> GltfMaterial:
    """The material of a surface; ``warn`` is told what glTF cannot say."""
    material, said = surface.material, f"<{surface.name}>: in .glb"
    base = material.diffuse if material.base is None else material.base
    if material.clear:  # glTF would tint by it what passes
        base = constant_map(1.0)
    colour = np.ones(3)
    if surface.corner_colour is not None and not material.clear:
        colour = surface.corner_colour.mean(axis=(0, 1))
        warn(f"{said} its display colours become their mean.")
    pictures: dict[str, Byte] = {}
    if base.shape[:2] == (1, 1):
        colour = colour * base[0, 0]
    else:
        # glTF's factors end at 1, and so does what a surface can reflect.
        small = np.minimum(_small(base, max_size), np.float32(1))
        pictures["baseColorTexture"], _, _ = encoded_colour(small)
    ior = 1.5  # of metals; of others F0 = ((ior - 1) / (ior + 1))^2
    if material.metallic is None:
        if np.ptp(material.f0) > 1e-4:
            warn(f"{said} its specular colour becomes one index of refraction.")
        root = math.sqrt(min(float(material.f0.mean()), 0.99))
        ior = round((1 + root) / (1 - root), 6)
    factors, packed = _roughness(material, max_size)
    if packed is not None:
        pictures["metallicRoughnessTexture"] = packed
    if material.normal is not None:
        stored = (_small(material.normal, max_size) + np.float32(1)) / np.float32(2)
        pictures["normalTexture"], _, _ = encoded_data(np.clip(stored, 0, 1))
    numbers: dict[str, Any] = {
        "pbrMetallicRoughness": {
            **factors,
            "baseColorFactor": [
                *map(float, np.clip(colour, 0, 1)),
                _PANE if material.clear else 1.0,
            ],
        },
        **({"alphaMode": "BLEND"} if material.clear else {}),
        "doubleSided": surface.two_sided,
        "extensions": {IOR: {"ior": ior}},
    }
    if material.clear:
        numbers["extensions"][TRANSMISSION] = {"transmissionFactor": 1.0}
    if material.emits:
        # A colour of at most 1 and its strength: radiance = strength * factor * texture.
        emission = _small(material.emission, max_size)
        strength = float(emission.max())
        factor = np.ones(3)
        if emission.shape[:2] == (1, 1):
            factor = emission[0, 0] / strength
        else:
            pictures["emissiveTexture"], _, _ = encoded_colour(emission / np.float32(strength))
        numbers["emissiveFactor"] = [float(value) for value in factor]
        numbers["extensions"][STRENGTH] = {"emissiveStrength": strength}
    return GltfMaterial(numbers=numbers, pictures=pictures, wrap=material.wrap)


def _roughness(material: Material, max_size: int | None) -> tuple[dict[str, float], Byte | None]:
    """glTF's factors, and its texture if one is needed: roughness in green, metalness in blue."""
    metallic = np.zeros((1, 1, 1), np.float32) if material.metallic is None else material.metallic
    if material.roughness.size == 1 and metallic.size == 1:
        factors = {"metallicFactor": metallic, "roughnessFactor": material.roughness}
        return {key: float(np.clip(x.flat[0], 0, 1)) for key, x in factors.items()}, None
    height, width = np.maximum(material.roughness.shape[:2], metallic.shape[:2])
    size = size_within(int(width), int(height), max_size)
    channels = [np.ones((size[1], size[0], 1), np.float32)]
    channels += [resized(channel, *size)[..., :1] for channel in (material.roughness, metallic)]
    packed = np.clip(np.concatenate(channels, axis=2), 0, 1)
    return {"metallicFactor": 1.0, "roughnessFactor": 1.0}, encoded_data(packed)[0]


def _mesh(surface: Surface, material: PBRMaterial) -> Any:
    """One vertex per distinct corner."""
    uv = surface.corner_uv
    if uv is None:
        uv = np.zeros((*surface.triangles.shape, 2), np.float32)
    points = surface.points[surface.triangles].astype(np.float32)
    parts = [points, surface.corner_normals, uv]
    if surface.material.normal is not None:
        parts.append(corner_tangents(surface.points, surface.triangles, surface.corner_normals, uv))
    corners = np.concatenate(parts, axis=2).reshape(3 * len(points), -1)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    more = {_TANGENT: vertices[:, 8:]} if surface.material.normal is not None else {}
    return trimesh.Trimesh(
        vertices=vertices[:, :3],
        faces=index.reshape(-1, 3),
        vertex_normals=vertices[:, 3:6],
        visual=trimesh.visual.TextureVisuals(uv=vertices[:, 6:8], material=material),
        vertex_attributes=more,
        process=False,
    )


class _NamedMaterial(PBRMaterial):  # type: ignore[misc]
    """Materials are the same only if their names are."""

    def __hash__(self) -> int:
        return hash(self.name)


def _finish(
    tree: dict[str, Any], *, materials: dict[str, GltfMaterial], paths: dict[str, str]
) -> None:
    """Everything of the materials but the places of their textures, and samplers; of the nodes
    which prims they were; and the tangents under glTF's name."""
    for mesh in tree["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        if _TANGENT in attributes:
            attributes["TANGENT"] = attributes.pop(_TANGENT)
    for node in tree["nodes"]:
        if node.get("name") in paths:
            node["extras"] = {PRIM: paths[node["name"]]}
    used: set[str] = set()
    samplers: list[dict[str, int]] = []
    for stored in tree["materials"]:
        ours = materials[stored["name"]]
        used.update(ours.numbers["extensions"])
        inner = _textures(stored.get("pbrMetallicRoughness", {}))
        finished = {"name": stored["name"], **ours.numbers, **_textures(stored)}
        finished["pbrMetallicRoughness"] = {**ours.numbers["pbrMetallicRoughness"], **inner}
        mode = _WRAP[ours.wrap]
        sampler = {
            "magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": mode, "wrapT": mode,
        }  # fmt: skip
        for reference in (*_textures(stored).values(), *inner.values()):
            if sampler not in samplers:
                samplers.append(sampler)
            tree["textures"][reference["index"]]["sampler"] = samplers.index(sampler)
        stored.clear()
        stored.update(finished)
    if samplers:
        tree["samplers"] = samplers
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), *used})


def _textures(stored: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in stored.items() if key.endswith("Texture")}


def _small(image: Float, max_size: int | None) -> Float:
    height, width = image.shape[:2]
    size = size_within(width, height, max_size)
    return image if size == (width, height) else resized(image, *size)
