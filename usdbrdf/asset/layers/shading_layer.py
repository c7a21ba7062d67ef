"""What the task shade adds: materials with albedo or emission, maps, and render outputs.

Measured maps are looks; the UsdRender vars are what a renderer makes of the asset.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf

from usdbrdf.asset.header import Draft, Scopes
from usdbrdf.asset.layers.author import attribute, author_record, define, export, over, relationship
from usdbrdf.asset.layers.lights_layer import EMISSION_TEXTURE
from usdbrdf.asset.layers.looks import SHADED, aov_looks, author_looks
from usdbrdf.asset.layers.preview_surface import colour_from_texture, surface
from usdbrdf.asset.properties import ShadedObject
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


def write_shading_layer(path: Path, draft: Draft, objects: Sequence[ShadedObject]) -> None:
    """Write shading.usda to ``path``; its sublayer is ``write_lights_layer``'s."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    layer.subLayerPaths = [f"./{asset.lights_layer.name}"]
    define(layer, scopes.path("materials"), "Scope")
    for item in objects:
        author_record(over(layer, item.prim_path), item)
        _author_material(layer, scopes, item)
    # Emission is not a look: it is nothing on most objects, and the shaded look shows it.
    looks = aov_looks(layer, scopes, objects, hidden=frozenset([EMISSION]))
    looks[SHADED] = {item.prim_path: scopes.path("materials", item.identifier) for item in objects}
    author_looks(layer, draft, looks, selected=SHADED)
    _author_render_outputs(layer, scopes)
    export(layer, path, folder=asset.layer("shading").parent)


def _author_material(layer: Sdf.Layer, scopes: Scopes, item: ShadedObject) -> None:
    """Diffuse only: the lobe is what the task fit adds, in a stronger layer."""
    material = scopes.path("materials", item.identifier)
    surface(layer, material)
    files = {aov.name: aov.file for aov in item.aovs}
    wanted = EMISSION if item.emitter else ALBEDO
    if wanted not in files:
        raise UsdBrdfError(
            f"<{item.prim_path}>: the task shade delivered no {wanted} map. This is a defect of "
            "usdbrdf; please report it. [stage.aov]"
        )
    # An emitter reflects nothing that could be measured; other objects may glow in places.
    inputs = [("emissiveColor", EMISSION_TEXTURE, EMISSION, item.radiance)]
    if not item.emitter:
        inputs.append(("diffuseColor", ALBEDO_TEXTURE, ALBEDO, item.mean_albedo))
    for name, texture, aov, mean in inputs:
        if aov in files:
            colour_from_texture(layer, material, name, texture, files[aov], fallback=mean)


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
