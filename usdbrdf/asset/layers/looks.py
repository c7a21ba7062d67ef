"""UsdPreviewSurface networks, and the variant set ``look``: the same objects
lit, as measured maps, or with their materials.

Bindings live inside the variants and nowhere else. A binding beside them would be a local opinion,
and local opinions beat variants: every look would show the same material. So do the materials that
show maps: beside them all would be composed in every look, eight times the prims that it shows,
over which every tool that reads the stage goes. The measured material is the object's own, and is
there in every look: an artist's look may bind it too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pxr import Gf, Sdf

from usdbrdf.asset.header import Draft, Scopes
from usdbrdf.asset.layers.author import (
    apply_schema,
    attribute,
    author_inputs,
    connect,
    define,
    inside,
    over,
    relationship,
)
from usdbrdf.asset.layers.input_usd import BINDING, recorded_bindings
from usdbrdf.asset.layout import path_in_layer
from usdbrdf.asset.preview_lobe import NO_LOBE
from usdbrdf.asset.properties import Aov, MeasuredObject

Types = Sdf.ValueTypeNames
Colour = Sequence[float]
VARIANT_SET = "look"
SHADED, LIT = "shaded", "lit"
# What has no value in a look is shown in a colour that no measurement has: unknown is not black.
NO_DATA = "no_data"
NO_DATA_COLOUR = (0.5, 0.0, 0.5)
# A look: the material's path per object's prim path.
Bindings = Mapping[str, str]
# What a look shows of an object: a map, one linear colour, or nothing because nothing is known.
Shown = Aov | Colour | None
SURFACE = "PreviewSurface"
# Texture nodes of the materials; that of the emission has no scale of its own.
ALBEDO_TEXTURE, EMISSION_TEXTURE = "AlbedoTexture", "EmissionTexture"


def look_variant(scopes: Scopes, look: str) -> Sdf.Path:
    """Where layers say what holds in a look."""
    return Sdf.Path(scopes.root).AppendVariantSelection(VARIANT_SET, look)


def surface(
    layer: Sdf.Layer,
    material: str,
    *,
    roughness: float = NO_LOBE.roughness,
    ior: float = NO_LOBE.ior,
) -> Sdf.PrimSpec:
    """A material with one UsdPreviewSurface, black until a colour is given; returns the shader.
    ``specularColor`` stays away: some applications multiply it onto the reflectance of ``ior``."""
    shader, prim = f"{material}/{SURFACE}", define(layer, material, "Material")
    connect(prim, "outputs:surface", Types.Token, f"{shader}.outputs:surface")
    prim = node(layer, shader, "UsdPreviewSurface", "surface", Types.Token)
    author_inputs(prim, Types.Int, useSpecularWorkflow=0)
    author_inputs(prim, Types.Float, metallic=0.0)
    author_inputs(prim, Types.Color3f, diffuseColor=Gf.Vec3f(0.0), emissiveColor=Gf.Vec3f(0.0))
    lobe(layer, material, roughness, ior)
    return prim


def lobe(layer: Sdf.Layer, material: str, roughness: float, ior: float) -> None:
    """The specular lobe of a material that this layer, or a weaker one, defines."""
    author_inputs(over(layer, f"{material}/{SURFACE}"), Types.Float, roughness=roughness, ior=ior)


def node(
    layer: Sdf.Layer, path: str, identifier: str, output: str, output_type: Sdf.ValueTypeName
) -> Sdf.PrimSpec:
    """A shader of a network, by its ``info:id``, with one output."""
    prim = define(layer, path, "Shader")
    attribute(prim, "info:id", Types.Token, identifier, uniform=True)
    attribute(prim, f"outputs:{output}", output_type)
    return prim


def colour_from_texture(
    layer: Sdf.Layer,
    material: str,
    surface_input: str,
    texture: str,
    file: str,
    *,
    scale: float = 1.0,
    fallback: Colour = (0.0, 0.0, 0.0),
) -> None:
    """Connect an input of the material's surface to a linear texture over ``primvars:st``.

    texture   name of the texture's shader prim
    file      path relative to the asset folder
    fallback  linear colour where the file is missing
    """
    reader = node(layer, f"{material}/StReader", "UsdPrimvarReader_float2", "result", Types.Float2)
    author_inputs(reader, Types.String, varname="st")
    prim = node(layer, f"{material}/{texture}", "UsdUVTexture", "rgb", Types.Float3)
    author_inputs(prim, Types.Asset, file=Sdf.AssetPath(path_in_layer(file)))
    connect(prim, "inputs:st", Types.Float2, f"{material}/StReader.outputs:result")
    # "auto" would decode float images as sRGB in some applications.
    author_inputs(prim, Types.Token, sourceColorSpace="raw", wrapS="clamp", wrapT="clamp")
    author_inputs(prim, Types.Float4, fallback=Gf.Vec4f(*map(float, fallback), 1.0))
    if scale != 1.0:
        scale_texture(layer, material, texture, scale)
    shader, source = over(layer, f"{material}/{SURFACE}"), f"{material}/{texture}.outputs:rgb"
    connect(shader, f"inputs:{surface_input}", Types.Color3f, source).ClearDefaultValue()


def scale_texture(layer: Sdf.Layer, material: str, texture: str, scale: float) -> None:
    """A factor on the colour of a texture that this layer, or a weaker one, defines."""
    prim = over(layer, f"{material}/{texture}")
    author_inputs(prim, Types.Float4, scale=Gf.Vec4f(scale, scale, scale, 1.0))


def author_looks(
    layer: Sdf.Layer, draft: Draft, looks: Mapping[str, Bindings], *, selected: str
) -> None:
    """Add variants to the default prim and select one; weaker layers' variants remain. What an
    input file binds otherwise than by the mesh is bound in every look too."""
    root, competing = Sdf.Path(draft.scopes.root), recorded_bindings(draft.asset)
    for look, bindings in looks.items():
        variant = look_variant(draft.scopes, look)
        over(layer, str(variant))
        for prim_path, material in bindings.items():
            also = competing.get(prim_path, {})
            for binding, collection in {f"{prim_path}.{BINDING}": "", **also}.items():
                path = Sdf.Path(inside(variant, binding))
                prim = over(layer, str(path.GetParentPath()))
                apply_schema(prim, "MaterialBindingAPI")
                targets = [collection, material] if collection else [material]
                relationship(prim, path.name, *targets)
    layer.GetPrimAtPath(root).variantSelections[VARIANT_SET] = selected


def author_look_materials(
    layer: Sdf.Layer,
    scopes: Scopes,
    look: str,
    objects: Sequence[MeasuredObject],
    shown: Sequence[Shown],
) -> dict[str, str]:
    """Materials for one look that glow and reflect nothing, so that any viewer shows what they are
    about: one per object, which has its place in ``shown``; and how they are bound. A map of one
    channel shows as grey: applications repeat it over red, green and blue. An object of which there
    is nothing to show has one material that says so in all looks."""
    bindings, variant = {}, look_variant(scopes, look)
    for item, glow in zip(objects, shown, strict=True):
        name = NO_DATA if glow is None else look
        bindings[item.prim_path] = scopes.look(item.identifier, name)
        material = inside(variant, bindings[item.prim_path])
        define(layer, str(Sdf.Path(material).GetParentPath()), "Scope")
        shader = surface(layer, material)
        if isinstance(glow, Aov):
            texture = ("emissiveColor", "AovTexture", glow.file)
            colour_from_texture(layer, material, *texture, scale=glow.scale)
        else:
            colour = Gf.Vec3f(*map(float, glow or NO_DATA_COLOUR))
            author_inputs(shader, Types.Color3f, emissiveColor=colour)
    return bindings


def aov_looks(
    layer: Sdf.Layer,
    scopes: Scopes,
    objects: Sequence[MeasuredObject],
    hidden: frozenset[str] = frozenset(),
) -> dict[str, dict[str, str]]:
    """One look per map that any object has, with a binding for every object."""
    maps = [{aov.name: aov for aov in item.aovs} for item in objects]
    return {
        name: author_look_materials(layer, scopes, name, objects, [own.get(name) for own in maps])
        for name in dict.fromkeys(name for own in maps for name in own if name not in hidden)
    }
