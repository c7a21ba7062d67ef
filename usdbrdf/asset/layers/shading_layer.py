"""What the shading stage adds: materials with albedo or emission, maps, and render outputs.

Measured maps are looks; the UsdRender vars are what a renderer makes of the asset.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Gf, Sdf

from usdbrdf.asset.header import Provenance, Scopes, StageHeader, new_layer
from usdbrdf.asset.layers.author import apply_schema, attribute, define, export, over, relationship
from usdbrdf.asset.layers.input_bindings import recorded_bindings
from usdbrdf.asset.layers.lights_layer import EMISSION_TEXTURE
from usdbrdf.asset.layers.looks import SHADED, author_looks
from usdbrdf.asset.layers.preview_surface import colour_from_texture, surface
from usdbrdf.asset.layers.texturing_layer import aov_looks, author_aovs
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import ShadedObject
from usdbrdf.asset.schema import verify
from usdbrdf.errors import UsdBrdfError

Types = Sdf.ValueTypeNames

ALBEDO, EMISSION = "albedo", "emission"

ALBEDO_TEXTURE = "AlbedoTexture"

# What a renderer is asked for: name, type, source. Light path expressions say which paths count;
# "raw" names a renderer's own output.
_RENDER_VARS = (
    ("beauty", "color3f", "C.*", "lpe"),
    ("diffuse", "color3f", "C<RD>.*", "lpe"),
    ("specular", "color3f", "C<RG>.*", "lpe"),
    ("emission", "color3f", "C[<L.>O]", "lpe"),
    ("albedo", "color3f", "albedo", "raw"),
    ("normal", "normal3f", "N", "raw"),
    ("depth", "float", "depth", "raw"),
)


def write_shading_layer(
    path: Path,
    asset: Asset,
    header: StageHeader,
    provenance: Provenance,
    objects: Sequence[ShadedObject],
) -> None:
    """Write shading.usda to ``path``; its sublayer is ``write_lights_layer``'s."""
    verify()
    scopes = Scopes.of(asset)
    layer = new_layer(header, provenance)
    layer.subLayerPaths = [f"./{asset.lights_layer.name}"]
    over(layer, scopes.root)
    define(layer, scopes.path("materials"), "Scope")
    for item in objects:
        _author_facts(over(layer, item.prim_path), item)
        _author_material(layer, scopes, item)
    # Emission is not a look: it is nothing on most objects, and the shaded look shows it.
    looks = aov_looks(layer, scopes, objects, hidden=frozenset([EMISSION]))
    looks[SHADED] = {item.prim_path: scopes.path("materials", item.identifier) for item in objects}
    competing = recorded_bindings(asset)
    author_looks(layer, scopes, looks, selected=SHADED, competing=competing)
    _author_render_outputs(layer, scopes)
    export(layer, path, folder=asset.layer("shading").parent)


def _author_material(layer: Sdf.Layer, scopes: Scopes, item: ShadedObject) -> None:
    """Diffuse only: the lobe is the fitting stage's, in a stronger layer."""
    material = scopes.path("materials", item.identifier)
    surface(layer, material)
    files = {aov.name: aov.file for aov in item.aovs}
    wanted = EMISSION if item.emitter else ALBEDO
    if wanted not in files:
        raise UsdBrdfError(
            f"<{item.prim_path}>: the shading stage delivered no {wanted} map. This is a defect of "
            "usdbrdf; please report it. [stage.aov]"
        )
    # An emitter reflects nothing that could be measured; other objects may glow in places.
    inputs = [("emissiveColor", EMISSION_TEXTURE, EMISSION, item.radiance)]
    if not item.emitter:
        inputs.append(("diffuseColor", ALBEDO_TEXTURE, ALBEDO, item.mean_albedo))
    for name, texture, aov, mean in inputs:
        if aov in files:
            colour_from_texture(layer, material, name, texture, files[aov], fallback=mean)


def _author_facts(prim: Sdf.PrimSpec, item: ShadedObject) -> None:
    apply_schema(prim, "UsdBrdfShadingAPI")
    numbers = {
        "raysPerTexel": item.rays_per_texel,
        "standardError": item.standard_error,
        "escapedFraction": item.escaped_fraction,
    }
    for name, value in numbers.items():
        attribute(prim, f"usdBrdf:shading:{name}", Types.Float, float(value), uniform=True)
    attribute(
        prim, "usdBrdf:shading:meanAlbedo", Types.Color3f, _colour(item.mean_albedo), uniform=True
    )
    if item.emitter:
        apply_schema(prim, "UsdBrdfEmitterAPI")
        prefix = "usdBrdf:emitter"
        lower_bound, area = bool(item.radiance_is_lower_bound), float(item.area_fraction)
        attribute(prim, f"{prefix}:radiance", Types.Color3f, _colour(item.radiance), uniform=True)
        attribute(prim, f"{prefix}:lowerBound", Types.Bool, lower_bound, uniform=True)
        status = item.radiance_status
        attribute(prim, f"{prefix}:radianceStatus", Types.Token, status, uniform=True)
        if status == "estimated":
            error = float(item.radiance_error)
            attribute(prim, f"{prefix}:radianceError", Types.Float, error, uniform=True)
        attribute(prim, f"{prefix}:areaFraction", Types.Float, area, uniform=True)
    author_aovs(prim, item.aovs)


def _author_render_outputs(layer: Sdf.Layer, scopes: Scopes) -> None:
    """The product and its variables for the render settings that the scan layer defines."""
    product, variables = scopes.path("render", "aovs"), scopes.path("render", "vars")
    relationship(over(layer, scopes.path("render", "capture")), "products", product)
    prim = define(layer, product, "RenderProduct")
    attribute(prim, "productName", Types.Token, "aovs.####.exr")
    relationship(prim, "camera", scopes.path("cameras", "capture"))
    relationship(prim, "orderedVars", *(f"{variables}/{name}" for name, *_ in _RENDER_VARS))
    define(layer, variables, "Scope")
    for name, data_type, source, source_type in _RENDER_VARS:
        prim = define(layer, f"{variables}/{name}", "RenderVar")
        attribute(prim, "dataType", Types.Token, data_type, uniform=True)
        attribute(prim, "sourceName", Types.String, source, uniform=True)
        attribute(prim, "sourceType", Types.Token, source_type, uniform=True)


def _colour(values: Sequence[float]) -> Gf.Vec3f:
    return Gf.Vec3f(*(float(value) for value in values))
