"""What the fitting stage adds: the specular lobe of every material, and how sure we are of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf

from usdbrdf.asset.header import Provenance, Scopes, StageHeader, new_layer
from usdbrdf.asset.layers.author import apply_schema, attribute, export, over
from usdbrdf.asset.layers.input_bindings import recorded_bindings
from usdbrdf.asset.layers.lights_layer import EMISSION_TEXTURE
from usdbrdf.asset.layers.looks import SHADED, Shown, author_look_materials, author_looks
from usdbrdf.asset.layers.materialx_layer import Coloured, write_materialx_layer
from usdbrdf.asset.layers.preview_surface import (
    NO_LOBE,
    SURFACE,
    PreviewLobe,
    colour_from_texture,
    lobe,
    preview_surface_from_fit,
    scale_texture,
)
from usdbrdf.asset.layers.shading_layer import ALBEDO_TEXTURE
from usdbrdf.asset.layers.texturing_layer import aov_looks, author_aovs
from usdbrdf.asset.layout import Asset, path_in_layer
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.schema import verify

Types = Sdf.ValueTypeNames

BASE_COLOR = "base_color"


def write_material_layer(
    path: Path,
    asset: Asset,
    header: StageHeader,
    provenance: Provenance,
    objects: Sequence[FittedObject],
    *,
    materialx: Path | None = None,
) -> None:
    """Write material.usda to ``path``; with ``materialx``, that sublayer to there."""
    verify()
    scopes = Scopes.of(asset)
    layer = new_layer(header, provenance)
    over(layer, scopes.root)
    shading = Sdf.Layer.OpenAsAnonymous(str(asset.layer("shading")))
    networks = {}
    for item in objects:
        material = scopes.path("materials", item.identifier)
        _author_facts(over(layer, item.prim_path), item)
        shown = NO_LOBE
        if _known(item):
            shown = preview_surface_from_fit(item.phi, item.psi, item.mapping)
            _author_lobe(layer, material, shown)
        texture = _author_colour(layer, material, item, shown.diffuse, shading)
        if _known(item) and not shading.GetPrimAtPath(f"{material}/{EMISSION_TEXTURE}"):
            networks[material] = Coloured(shown, texture)
    looks = {
        **aov_looks(layer, scopes, objects),
        "roughness": author_look_materials(layer, scopes, "roughness", _greys(objects, "phi")),
        "specular": author_look_materials(layer, scopes, "specular", _greys(objects, "psi")),
    }
    competing = recorded_bindings(asset)
    author_looks(layer, scopes, looks, selected=SHADED, competing=competing)
    folder = asset.layer("material").parent
    if materialx:
        layer.subLayerPaths = [f"./{asset.materialx_layer.name}"]
        write_materialx_layer(materialx, folder, header, provenance, networks)
    export(layer, path, folder=folder)


def _author_lobe(layer: Sdf.Layer, material: str, shown: PreviewLobe) -> None:
    lobe(layer, material, shown.roughness, shown.ior)
    shader = over(layer, f"{material}/{SURFACE}")
    attribute(shader, "inputs:metallic", Types.Float, 0.0)
    attribute(shader, "inputs:useSpecularWorkflow", Types.Int, 0)


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


def _author_facts(prim: Sdf.PrimSpec, item: FittedObject) -> None:
    apply_schema(prim, "UsdBrdfMaterialFitAPI")
    prefix = "usdBrdf:fit"
    numbers = {
        "phi": item.phi,
        "psi": item.psi,
        "phiError": item.phi_error,
        "psiError": item.psi_error,
        "cost": item.cost,
        "evidence": item.evidence,
    }
    for name, value in numbers.items():
        if math.isfinite(value):
            attribute(prim, f"{prefix}:{name}", Types.Float, float(value), uniform=True)
    attribute(prim, f"{prefix}:status", Types.Token, item.status, uniform=True)
    for name, confidence in (("phi", item.phi_confidence), ("psi", item.psi_confidence)):
        attribute(prim, f"{prefix}:{name}Confidence", Types.Token, confidence, uniform=True)
    attribute(prim, f"{prefix}:targetFrame", Types.Int, int(item.target_frame), uniform=True)
    attribute(prim, f"{prefix}:numPixels", Types.Int, int(item.num_pixels), uniform=True)
    attribute(prim, f"{prefix}:method", Types.Token, item.method, uniform=True)
    if _known(item):
        attribute(prim, f"{prefix}:mapping", Types.Token, item.mapping, uniform=True)
    author_aovs(prim, item.aovs)


def _known(item: FittedObject) -> bool:
    return math.isfinite(item.phi) and math.isfinite(item.psi)


def _greys(objects: Sequence[FittedObject], parameter: str) -> list[tuple[str, str, Shown]]:
    """Each object's parameter as a grey; None where it is not known."""
    return [
        (item.prim_path, item.identifier, (getattr(item, parameter),) * 3 if _known(item) else None)
        for item in objects
    ]
