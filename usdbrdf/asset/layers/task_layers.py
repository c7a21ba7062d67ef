"""What the tasks texture, shade and fit add to the scan, each in a layer of its own.

Where it is asked for, the materials once more as OpenPBR networks of MaterialX, for renderers that
take those rather than UsdPreviewSurface; they get the same numbers. materialx.usda is a sublayer of
material.usda, weaker than it and listed there: so the root layer need not be written again, and a
session that does not want it mutes one file. What glows keeps its UsdPreviewSurface alone, whose
emission the variants of the lights switch off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, Vt

from usdbrdf.asset.header import Draft, Scopes
from usdbrdf.asset.layers.author import (
    apply_schema,
    attribute,
    author_inputs,
    author_record,
    connect,
    define,
    export,
    over,
    relationship,
)
from usdbrdf.asset.layers.interface import needs_too
from usdbrdf.asset.layers.looks import (
    ALBEDO_TEXTURE,
    EMISSION_TEXTURE,
    LIT,
    SHADED,
    SURFACE,
    aov_looks,
    author_look_materials,
    author_looks,
    colour_from_texture,
    lobe,
    node,
    scale_texture,
    surface,
)
from usdbrdf.asset.layout import LIGHTING, Asset, path_in_layer
from usdbrdf.asset.preview_lobe import (
    CLEAR_GLASS,
    NO_LOBE,
    PreviewLobe,
    preview_surface_from_fit,
    shown_metal,
)
from usdbrdf.asset.properties import (
    EMITTER,
    Colour,
    FittedObject,
    LightFromOutside,
    MeasuredObject,
    ShadedObject,
    TexturedObject,
    UnwrappedObject,
)
from usdbrdf.errors import UsdBrdfError

Types = Sdf.ValueTypeNames
# Arrays of pairs, and the precision of their numbers; halves are too coarse for large textures.
_PAIRS = {Vt.Vec2fArray: np.float32, Vt.Vec2dArray: np.float64}
ALBEDO, EMISSION = "albedo", "emission"


def write_uv_layer(
    path: Path, draft: Draft, objects: Sequence[UnwrappedObject], scanned: Usd.Stage
) -> None:
    """Write the texture coordinates to ``path``; where several lightings have them in common also
    what else is known of the objects' textures before any frame was looked at.

    scanned  the composed stage of the weaker layers
    """
    coordinates = draft.new_layer()
    with Sdf.ChangeBlock():
        for item in objects:
            # One value per triangle corner; equal values are stored once and indexed. Their type is
            # the one that an input file gives its own, which ours must share: float2[] is usual.
            declared = scanned.GetAttributeAtPath(f"{item.prim_path}.primvars:st")
            kind = declared.GetTypeName() if declared else Types.TexCoord2fArray
            if type(kind.defaultValue) not in _PAIRS:
                kind = Types.TexCoord2fArray
            corners = np.ascontiguousarray(item.corner_uv, np.float32).reshape(-1, 2)
            # Two floats as one integer: equal bits, much faster than rows.
            bits = corners.view(np.uint64)
            _, first, index = np.unique(bits, return_index=True, return_inverse=True)
            values = corners[first].astype(_PAIRS[type(kind.defaultValue)])
            prim = over(coordinates, item.prim_path)
            attribute(prim, "primvars:st", kind, values, interpolation="faceVarying")
            attribute(
                prim, "primvars:st:indices", Types.IntArray, index.reshape(-1).astype(np.int32)
            )
            if draft.asset.lightings:
                author_record(prim, item)
    export(coordinates, path, folder=draft.asset.uv_layer.parent)


def write_texturing_layer(path: Path, draft: Draft, objects: Sequence[TexturedObject]) -> None:
    """Write texturing.usda to ``path``; its sublayer is ``write_uv_layer``'s, or, of one of several
    lightings, that of the layer which chooses among them."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    if not asset.lighting:
        layer.subLayerPaths = [f"./{asset.uv_layer.name}"]
    with Sdf.ChangeBlock():
        for item in objects:
            author_record(over(layer, item.prim_path), item)
    # What browsers of assets show: the picture that the task writes beside the layer.
    root = layer.GetPrimAtPath(scopes.root)
    apply_schema(root, "AssetPreviewsAPI")
    picture = {"defaultImage": Sdf.AssetPath(path_in_layer(asset.preview("lit")))}
    root.SetInfo("assetInfo", {"previews": {"thumbnails": {"default": picture}}})
    author_looks(layer, draft, aov_looks(layer, scopes, objects), selected=LIT)
    export(layer, path, folder=asset.layer("texturing").parent)


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
    path: Path, draft: Draft, objects: Sequence[ShadedObject], outside: LightFromOutside | None
) -> None:
    """Write shading.usda to ``path``; its sublayer is ``write_lights_layer``'s."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    layer.subLayerPaths = [f"./{asset.lights_layer.name}"]
    if outside:
        author_record(over(layer, scopes.root), outside)
    for item in objects:
        author_record(over(layer, item.prim_path), item)
        shines = item.radiance if item.emitter else item.mean_albedo
        _author_display_colour(layer, scopes, item.prim_path, shines)
        # Diffuse only: the lobe is what the task fit adds, in a stronger layer.
        material = scopes.material(item.identifier)
        define(layer, str(Sdf.Path(material).GetParentPath()), "Scope")
        surface(layer, material)
        files = {aov.name: aov.file for aov in item.aovs}
        wanted = EMISSION if item.emitter else ALBEDO
        if wanted not in files:
            raise UsdBrdfError(
                f"<{item.prim_path}>: the task shade delivered no {wanted} map. This is a defect "
                "of usdbrdf; please report it. [stage.aov]"
            )
        # An emitter reflects nothing that could be measured; other objects may glow in places.
        inputs = [("emissiveColor", EMISSION_TEXTURE, EMISSION, item.radiance)]
        if not item.emitter:
            inputs.append(("diffuseColor", ALBEDO_TEXTURE, ALBEDO, item.mean_albedo))
        for name, texture, aov, mean in inputs:
            if aov in files:
                colour_from_texture(layer, material, name, texture, files[aov], fallback=mean)
    # Emission is not a look: it is nothing on most objects, and the shaded look shows it.
    looks = aov_looks(layer, scopes, objects, hidden=frozenset([EMISSION]))
    looks[SHADED] = {item.prim_path: scopes.material(item.identifier) for item in objects}
    author_looks(layer, draft, looks, selected=SHADED)
    _author_render_outputs(layer, scopes)
    export(layer, path, folder=asset.layer("shading").parent)


def _author_display_colour(layer: Sdf.Layer, scopes: Scopes, prim_path: str, mean: Colour) -> None:
    """One colour for applications that draw no materials, at most 1. An input's mesh keeps what its
    file says."""
    if prim_path.startswith(scopes.path("geometry", "")):
        brightest = max(1.0, *mean)
        shown = Vt.Vec3fArray([Gf.Vec3f(*(value / brightest for value in mean))])
        prim = over(layer, prim_path)
        attribute(
            prim, "primvars:displayColor", Types.Color3fArray, shown, interpolation="constant"
        )


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


def write_refined_layer(
    path: Path, draft: Draft, objects: Sequence[MeasuredObject], fitted: Sequence[FittedObject]
) -> None:
    """Write what the task fit knows of one of several lightings to ``path``: the maps of the
    ``objects``, looks that show them, and the colour of lamps that are dark in it."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    for item in objects:
        author_record(over(layer, item.prim_path), item)
    own = _shading_layer(asset)
    others = [_shading_layer(one) for one in replace(asset, lighting="").in_each_lighting]
    for lamp in fitted:
        if _emits(lamp, *others) and not _emits(lamp, own):
            shown = (
                preview_surface_from_fit(*lamp.shown, lamp.mapping) if lamp.is_known else NO_LOBE
            )
            material = scopes.material(lamp.identifier)
            _author_diffuse(layer, material, lamp, shown.diffuse, own)
    author_looks(layer, draft, aov_looks(layer, scopes, objects), selected=SHADED)
    export(layer, path, folder=asset.layer("material").parent)


def _shading_layer(asset: Asset) -> Sdf.Layer:
    return Sdf.Layer.OpenAsAnonymous(str(asset.layer("shading")))


def _emits(item: MeasuredObject, *shading: Sdf.Layer) -> bool:
    """Whether an object shines as a whole in one of the lightings of these shading layers."""
    radiance = f"{item.prim_path}.{EMITTER.attribute(EMITTER.key)}"
    return any(layer.GetAttributeAtPath(radiance) is not None for layer in shading)


def write_material_layer(
    path: Path, draft: Draft, objects: Sequence[FittedObject], *, materialx: Path | None = None
) -> None:
    """Write material.usda to ``path``; with ``materialx``, that sublayer to there. Of several
    lightings it takes ``write_refined_layer``'s of the one that is selected, and has no colour of
    objects that shine in any: their emission is all that leaves them then."""
    asset, scopes, layer = draft.asset, draft.scopes, draft.new_layer()
    for one in (one for one in asset.in_each_lighting if one.lighting):
        variant = Sdf.Path(scopes.root).AppendVariantSelection(LIGHTING, one.lighting)
        refined = Sdf.Reference(f"./{one.layer('material').name}")
        over(layer, str(variant)).referenceList.prependedItems = [refined]
    shading = [_shading_layer(one) for one in asset.in_each_lighting]
    networks = {}
    for item in objects:
        material = scopes.material(item.identifier)
        author_record(over(layer, item.prim_path), item)
        if any(mean := item.f0 if item.is_metal else item.mean_color):
            _author_display_colour(layer, scopes, item.prim_path, mean)
        shown = NO_LOBE
        if item.is_known:
            shown = preview_surface_from_fit(*item.shown, item.mapping)
            shown = CLEAR_GLASS if item.is_glass else shown
            lobe(layer, material, shown.roughness, shown.ior)
            shader = over(layer, f"{material}/{SURFACE}")
            author_inputs(shader, Types.Float, metallic=float(item.is_metal))
            author_inputs(shader, Types.Int, useSpecularWorkflow=0)
            if item.is_glass:
                author_inputs(shader, Types.Float, opacity=0.0)
        apart = len(shading) > 1 and _emits(item, *shading)
        texture = "" if apart else _author_diffuse(layer, material, item, shown.diffuse, shading[0])
        glows = f"{material}/{EMISSION_TEXTURE}"
        if item.is_known and not any(own.GetPrimAtPath(glows) for own in shading):
            networks[material] = (item, shown, texture)
    looks = aov_looks(layer, scopes, objects)
    for parameter, look in enumerate(("roughness", "specular")):
        greys = [(i.shown[parameter],) * 3 if i.is_known else None for i in objects]
        looks[look] = author_look_materials(layer, scopes, look, objects, greys)
    author_looks(layer, draft, looks, selected=SHADED)
    if materialx:
        layer.subLayerPaths = [f"./{asset.materialx_layer.name}"]
        beneath = draft.new_layer()
        for material, (item, shown, texture) in networks.items():
            _author_network(beneath, material, item, shown, texture)
        export(beneath, materialx, folder=asset.materialx_layer.parent)
    own = [one.layer("material") for one in asset.in_each_lighting if one.lighting]
    if needed := own + [asset.materialx_layer] * bool(materialx):
        needs_too(layer.GetPrimAtPath(scopes.root), asset, needed)
    export(layer, path, folder=asset.layer("material").parent)


def _author_diffuse(
    layer: Sdf.Layer, material: str, item: FittedObject, scale: float, shading: Sdf.Layer
) -> str:
    """A metal's reflectance, the diffuse colour, or of glass none; returns its texture as
    ``_author_colour``."""
    if item.is_metal:
        metal = shown_metal(item.phi, item.f0, item.mapping)
        return _author_plain(layer, material, metal, shading)
    if item.is_glass:
        return _author_plain(layer, material, (0.0, 0.0, 0.0), shading)
    return _author_colour(layer, material, item, scale, shading)


def _author_colour(
    layer: Sdf.Layer, material: str, item: FittedObject, scale: float, shading: Sdf.Layer
) -> str:
    """The refined colour instead of the albedo, on what reflects; without one a factor on the
    albedo. Returns the texture's path in layers; "" where there is none, as of an emitter."""
    for aov in item.aovs:
        if aov.name == "base_color" and any(item.mean_color):
            colour_from_texture(
                layer, material, "diffuseColor", "BaseColorTexture", aov.file,
                scale=scale, fallback=item.mean_color,
            )  # fmt: skip
            _leave_out(layer, f"{material}/{ALBEDO_TEXTURE}", shading)
            return path_in_layer(aov.file)
    albedo = shading.GetAttributeAtPath(f"{material}/{ALBEDO_TEXTURE}.inputs:file")
    if albedo is None:
        return ""
    if scale != 1:
        scale_texture(layer, material, ALBEDO_TEXTURE, scale)
    return str(albedo.default.path)


def _leave_out(layer: Sdf.Layer, node: str, shading: Sdf.Layer) -> None:
    """Deactivate a node of a weaker layer that nothing in the network reads any more."""
    if shading.GetPrimAtPath(node):
        over(layer, node).active = False


def _author_plain(layer: Sdf.Layer, material: str, colour: Colour, shading: Sdf.Layer) -> str:
    """One reflectance in the place of a texture; returns that there is none."""
    shader = over(layer, f"{material}/{SURFACE}")
    _leave_out(layer, f"{material}/{ALBEDO_TEXTURE}", shading)
    author_inputs(shader, Types.Color3f, diffuseColor=Gf.Vec3f(*colour))
    # An empty list that is explicit takes off the connection of the layer beneath.
    spec = layer.GetAttributeAtPath(f"{shader.path}.inputs:diffuseColor")
    spec.connectionPathList.ClearEditsAndMakeExplicit()
    return ""


def _author_network(
    layer: Sdf.Layer, material: str, item: FittedObject, shown: PreviewLobe, file: str
) -> None:
    """OpenPBR with what UsdPreviewSurface is told; ``file`` is the texture of its diffuse colour as
    layers spell its path, "" is black, or a metal's own reflectance."""
    surface = f"{material}/OpenPBR"
    connect(over(layer, material), "outputs:mtlx:surface", Types.Token, f"{surface}.outputs:out")
    prim = node(layer, surface, "ND_open_pbr_surface_surfaceshader", "out", Types.Token)
    author_inputs(
        prim, Types.Float,
        base_weight=1.0, base_diffuse_roughness=0.0,
        base_metalness=float(item.is_metal), specular_weight=1.0,
        specular_roughness=shown.roughness, specular_ior=shown.ior,
    )  # fmt: skip
    if item.is_glass:
        author_inputs(prim, Types.Float, transmission_weight=1.0)
        author_inputs(prim, Types.Bool, geometry_thin_walled=True)
    if not file:
        colour = shown_metal(item.phi, item.f0, item.mapping)  # black of what is no metal
        author_inputs(prim, Types.Color3f, base_color=Gf.Vec3f(*colour))
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
