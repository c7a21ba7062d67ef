"""The fitted materials once more, as OpenPBR networks of MaterialX: materialx.usda.

For renderers that take MaterialX rather than UsdPreviewSurface; they get the same numbers. It is a
sublayer of material.usda, weaker than it and listed there whenever the fit was asked for it: so the
root layer need not be written again, and a session that does not want it mutes one file. What
glows keeps its UsdPreviewSurface alone, whose emission the variants of the lights switch off.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from pxr import Sdf

from usdbrdf.asset.header import Provenance, StageHeader, new_layer
from usdbrdf.asset.layers.author import attribute, connect, define, export, over
from usdbrdf.asset.layers.preview_surface import PreviewLobe

Types = Sdf.ValueTypeNames


class Coloured(NamedTuple):
    """What an object's UsdPreviewSurface is told, and the texture of its diffuse colour as the
    layers spell its path; "" is black."""

    lobe: PreviewLobe
    texture: str


def write_materialx_layer(
    path: Path,
    folder: Path,
    header: StageHeader,
    provenance: Provenance,
    materials: Mapping[str, Coloured],
) -> None:
    """Write materialx.usda to ``path``, as it is to lie in ``folder``; materials by prim path."""
    layer = new_layer(header, provenance)
    over(layer, f"/{header.name}")
    for material, shown in materials.items():
        _author_network(layer, material, shown)
    export(layer, path, folder=folder)


def _author_network(layer: Sdf.Layer, material: str, shown: Coloured) -> None:
    surface = f"{material}/OpenPBR"
    connect(over(layer, material), "outputs:mtlx:surface", Types.Token, f"{surface}.outputs:out")
    prim = _node(layer, surface, "ND_open_pbr_surface_surfaceshader", Types.Token)
    numbers = {
        "base_weight": 1.0,
        "base_diffuse_roughness": 0.0,
        "base_metalness": 0.0,
        "specular_weight": 1.0,
        "specular_roughness": shown.lobe.roughness,
        "specular_ior": shown.lobe.ior,
    }
    for name, value in numbers.items():
        attribute(prim, f"inputs:{name}", Types.Float, value)
    if not shown.texture:
        attribute(prim, "inputs:base_color", Types.Color3f, (0.0, 0.0, 0.0))
        return
    reader = _node(layer, f"{material}/MtlxSt", "ND_geompropvalue_vector2", Types.Float2)
    attribute(reader, "inputs:geomprop", Types.String, "st")
    image = _node(layer, f"{material}/MtlxBaseColor", "ND_image_color3", Types.Color3f)
    attribute(image, "inputs:file", Types.Asset, Sdf.AssetPath(shown.texture))
    connect(image, "inputs:texcoord", Types.Float2, f"{material}/MtlxSt.outputs:out")
    for axis in "uv":
        attribute(image, f"inputs:{axis}addressmode", Types.String, "clamp")
    scaled = _node(layer, f"{material}/MtlxScaled", "ND_multiply_color3FA", Types.Color3f)
    connect(scaled, "inputs:in1", Types.Color3f, f"{material}/MtlxBaseColor.outputs:out")
    attribute(scaled, "inputs:in2", Types.Float, shown.lobe.diffuse)
    connect(prim, "inputs:base_color", Types.Color3f, f"{material}/MtlxScaled.outputs:out")


def _node(layer: Sdf.Layer, path: str, identifier: str, output: Sdf.ValueTypeName) -> Sdf.PrimSpec:
    prim = define(layer, path, "Shader")
    attribute(prim, "info:id", Types.Token, identifier, uniform=True)
    attribute(prim, "outputs:out", output)
    return prim
