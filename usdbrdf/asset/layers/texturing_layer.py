"""What the texturing stage adds: texture coordinates, maps of radiance, and looks for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, Vt

from usdbrdf.asset.header import Provenance, Scopes, StageHeader, new_layer
from usdbrdf.asset.layers.author import apply_schema, attribute, export, over
from usdbrdf.asset.layers.input_bindings import recorded_bindings
from usdbrdf.asset.layers.looks import LIT, author_look_materials, author_looks
from usdbrdf.asset.layout import Asset, path_in_layer
from usdbrdf.asset.properties import Aov, FittedObject, ShadedObject, TexturedObject
from usdbrdf.asset.schema import verify
from usdbrdf.model.arrays import Float

Types = Sdf.ValueTypeNames

# Arrays of pairs, and the precision of their numbers; halves are too coarse for large textures.
_PAIRS = {Vt.Vec2fArray: np.float32, Vt.Vec2dArray: np.float64}

THUMBNAIL = "previews/lit.png"  # in the asset folder


def write_texturing_layer(
    path: Path,
    uv_path: Path,
    asset: Asset,
    header: StageHeader,
    provenance: Provenance,
    objects: Sequence[TexturedObject],
    scan: Usd.Stage,
) -> None:
    """Write texturing.usda to ``path``, and its sublayer of texture coordinates to ``uv_path``.

    scan  the composed stage of the weaker layers
    """
    verify()
    scopes = Scopes.of(asset)
    folder = asset.layer("texturing").parent
    coordinates = new_layer(header, provenance)
    layer = new_layer(header, provenance)
    layer.subLayerPaths = [f"./{asset.uv_layer.name}"]
    with Sdf.ChangeBlock():
        over(coordinates, scopes.root)
        over(layer, scopes.root)
        for item in objects:
            declared = scan.GetAttributeAtPath(f"{item.prim_path}.primvars:st")
            author_texture_coordinates(
                over(coordinates, item.prim_path),
                item.corner_uv,
                declared.GetTypeName() if declared else Types.TexCoord2fArray,
            )
            _author_facts(over(layer, item.prim_path), item)
    _author_thumbnail(layer.GetPrimAtPath(scopes.root))
    looks = aov_looks(layer, scopes, objects)
    author_looks(layer, scopes, looks, selected=LIT, competing=recorded_bindings(asset))
    export(coordinates, uv_path, folder=folder)
    export(layer, path, folder=folder)


def author_texture_coordinates(
    prim: Sdf.PrimSpec, corner_uv: Float, declared: Sdf.ValueTypeName = Types.TexCoord2fArray
) -> None:
    """primvars:st, one value per triangle corner; equal values are stored once and indexed.

    declared  the type that an input file gives its own, which ours must share: float2[] is usual
    """
    corners = np.ascontiguousarray(corner_uv, np.float32).reshape(-1, 2)
    # Two floats as one integer: equal bits, much faster than rows.
    _, first, index = np.unique(corners.view(np.uint64), return_index=True, return_inverse=True)
    kind = declared if type(declared.defaultValue) in _PAIRS else Types.TexCoord2fArray
    array = type(kind.defaultValue)
    values = array.FromNumpy(corners[first].astype(_PAIRS[array]))
    indices = Vt.IntArray.FromNumpy(index.reshape(-1).astype(np.int32))
    attribute(prim, "primvars:st", kind, values, interpolation="faceVarying")
    attribute(prim, "primvars:st:indices", Types.IntArray, indices)


def author_aovs(prim: Sdf.PrimSpec, aovs: Sequence[Aov]) -> None:
    """The maps of an object, one instance of UsdBrdfAovAPI each."""
    for aov in aovs:
        apply_schema(prim, f"UsdBrdfAovAPI:{aov.name}")
        prefix = f"usdBrdf:aov:{aov.name}"
        attribute(prim, f"{prefix}:file", Types.Asset, Sdf.AssetPath(path_in_layer(aov.file)))
        attribute(prim, f"{prefix}:scale", Types.Float, aov.scale)
        attribute(prim, f"{prefix}:unit", Types.String, aov.unit, uniform=True)


def aov_looks(
    layer: Sdf.Layer,
    scopes: Scopes,
    objects: Sequence[TexturedObject] | Sequence[ShadedObject] | Sequence[FittedObject],
    *,
    hidden: frozenset[str] = frozenset(),
) -> dict[str, dict[str, str]]:
    """One look per map that any object has, with a binding for every object."""
    names = {aov.name: None for item in objects for aov in item.aovs if aov.name not in hidden}
    looks = {}
    for name in names:
        maps = [
            (item.prim_path, item.identifier, {a.name: a for a in item.aovs}.get(name))
            for item in objects
        ]
        looks[name] = author_look_materials(layer, scopes, name, maps)
    return looks


def _author_thumbnail(root: Sdf.PrimSpec) -> None:
    """What browsers of assets show: the picture that the texturing step writes beside the layer."""
    apply_schema(root, "AssetPreviewsAPI")
    picture = Sdf.AssetPath(path_in_layer(THUMBNAIL))
    thumbnails = {"default": {"defaultImage": picture}}
    root.SetInfo("assetInfo", {"previews": {"thumbnails": thumbnails}})


def _author_facts(prim: Sdf.PrimSpec, item: TexturedObject) -> None:
    apply_schema(prim, "UsdBrdfTexturingAPI")
    prefix = "usdBrdf:texturing"
    attribute(prim, f"{prefix}:texelSize", Types.Float, item.texel_size, uniform=True)
    attribute(
        prim, f"{prefix}:resolution", Types.Int2, Gf.Vec2i(*map(int, item.resolution)), uniform=True
    )
    attribute(prim, f"{prefix}:seenFraction", Types.Float, item.seen_fraction, uniform=True)
    attribute(prim, f"{prefix}:clippedFraction", Types.Float, item.clipped_fraction, uniform=True)
    attribute(prim, f"{prefix}:quantile", Types.Float, item.quantile, uniform=True)
    attribute(prim, f"{prefix}:seen", Types.Bool, bool(item.seen), uniform=True)
    author_aovs(prim, item.aovs)
