"""What the task fit adds: the specular lobe of every material, and how sure we are of it.

Where it is asked for, the materials once more as OpenPBR networks of MaterialX, for renderers that
take those rather than UsdPreviewSurface; they get the same numbers. materialx.usda is a sublayer of
material.usda, weaker than it and listed there: so the root layer need not be written again, and a
session that does not want it mutes one file. What glows keeps its UsdPreviewSurface alone, whose
emission the variants of the lights switch off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pxr import Sdf

from usdbrdf.asset.header import Draft
from usdbrdf.asset.layers.author import author_inputs, author_record, connect, export, over
from usdbrdf.asset.layers.lights_layer import EMISSION_TEXTURE
from usdbrdf.asset.layers.looks import (
    SHADED,
    Shown,
    aov_looks,
    author_look_materials,
    author_looks,
)
from usdbrdf.asset.layers.preview_surface import (
    SURFACE,
    colour_from_texture,
    lobe,
    node,
    scale_texture,
)
from usdbrdf.asset.layers.shading_layer import ALBEDO_TEXTURE
from usdbrdf.asset.layout import path_in_layer
from usdbrdf.asset.preview_lobe import NO_LOBE, PreviewLobe, preview_surface_from_fit
from usdbrdf.asset.properties import FittedObject

Types = Sdf.ValueTypeNames

BASE_COLOR = "base_color"


def write_material_layer(
    path: Path, draft: Draft, objects: Sequence[FittedObject], *, materialx: Path | None = None
) -> None:
    """Write material.usda to ``path``; with ``materialx``, that sublayer to there."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    shading = Sdf.Layer.OpenAsAnonymous(str(asset.layer("shading")))
    networks = {}
    for item in objects:
        material = scopes.path("materials", item.identifier)
        author_record(over(layer, item.prim_path), item)
        shown = NO_LOBE
        if item.is_known:
            shown = preview_surface_from_fit(item.phi, item.psi, item.mapping)
            _author_lobe(layer, material, shown)
        texture = _author_colour(layer, material, item, shown.diffuse, shading)
        if item.is_known and not shading.GetPrimAtPath(f"{material}/{EMISSION_TEXTURE}"):
            networks[material] = (shown, texture)
    looks = {
        **aov_looks(layer, scopes, objects),
        "roughness": author_look_materials(
            layer, scopes, "roughness", objects, lambda item: _grey(item, item.phi)
        ),
        "specular": author_look_materials(
            layer, scopes, "specular", objects, lambda item: _grey(item, item.psi)
        ),
    }
    author_looks(layer, draft, looks, selected=SHADED)
    if materialx:
        layer.subLayerPaths = [f"./{asset.materialx_layer.name}"]
        _write_materialx(materialx, draft, networks)
    export(layer, path, folder=asset.layer("material").parent)


def _author_lobe(layer: Sdf.Layer, material: str, shown: PreviewLobe) -> None:
    lobe(layer, material, shown.roughness, shown.ior)
    shader = over(layer, f"{material}/{SURFACE}")
    author_inputs(shader, Types.Float, metallic=0.0)
    author_inputs(shader, Types.Int, useSpecularWorkflow=0)


def _author_colour(
    layer: Sdf.Layer, material: str, item: FittedObject, scale: float, shading: Sdf.Layer
) -> str:
    """The refined colour instead of the albedo, on what reflects; without one a factor on the
    albedo. Returns the texture's path in layers; "" where there is none, as of an emitter."""
    for aov in item.aovs:
        if aov.name == BASE_COLOR and any(item.mean_color):
            colour_from_texture(
                layer, material, "diffuseColor", "BaseColorTexture", aov.file,
                scale=scale, fallback=item.mean_color,
            )  # fmt: skip
            return path_in_layer(aov.file)
    albedo = shading.GetAttributeAtPath(f"{material}/{ALBEDO_TEXTURE}.inputs:file")
    if albedo is None:
        return ""
    if scale != 1:
        scale_texture(layer, material, ALBEDO_TEXTURE, scale)
    return str(albedo.default.path)


def _grey(item: FittedObject, parameter: float) -> Shown:
    return (parameter,) * 3 if item.is_known else None


def _write_materialx(
    path: Path, draft: Draft, materials: Mapping[str, tuple[PreviewLobe, str]]
) -> None:
    """Write materialx.usda to ``path``. materials, by prim path: what UsdPreviewSurface is told,
    and the texture of its diffuse colour as layers spell its path; "" is black."""
    layer = draft.new_layer()
    for material, (shown, texture) in materials.items():
        _author_network(layer, material, shown, texture)
    export(layer, path, folder=draft.asset.materialx_layer.parent)


def _author_network(layer: Sdf.Layer, material: str, shown: PreviewLobe, file: str) -> None:
    surface = f"{material}/OpenPBR"
    connect(over(layer, material), "outputs:mtlx:surface", Types.Token, f"{surface}.outputs:out")
    prim = node(layer, surface, "ND_open_pbr_surface_surfaceshader", "out", Types.Token)
    author_inputs(
        prim, Types.Float,
        base_weight=1.0, base_diffuse_roughness=0.0, base_metalness=0.0, specular_weight=1.0,
        specular_roughness=shown.roughness, specular_ior=shown.ior,
    )  # fmt: skip
    if not file:
        author_inputs(prim, Types.Color3f, base_color=(0.0, 0.0, 0.0))
        return
    st, image, scaled = (f"{material}/Mtlx{name}" for name in ("St", "BaseColor", "Scaled"))
    prim_st = node(layer, st, "ND_geompropvalue_vector2", "out", Types.Float2)
    author_inputs(prim_st, Types.String, geomprop="st")
    texture = node(layer, image, "ND_image_color3", "out", Types.Color3f)
    author_inputs(texture, Types.Asset, file=Sdf.AssetPath(file))
    author_inputs(texture, Types.String, uaddressmode="clamp", vaddressmode="clamp")
    connect(texture, "inputs:texcoord", Types.Float2, f"{st}.outputs:out")
    product = node(layer, scaled, "ND_multiply_color3FA", "out", Types.Color3f)
    author_inputs(product, Types.Float, in2=shown.diffuse)
    connect(product, "inputs:in1", Types.Color3f, f"{image}.outputs:out")
    connect(prim, "inputs:base_color", Types.Color3f, f"{scaled}.outputs:out")
