"""What the task texture adds: texture coordinates, maps of radiance, and looks for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, Vt

from usdbrdf.asset.header import Draft
from usdbrdf.asset.layers.author import apply_schema, attribute, author_record, export, over
from usdbrdf.asset.layers.looks import LIT, aov_looks, author_looks
from usdbrdf.asset.layout import path_in_layer
from usdbrdf.asset.properties import TexturedObject
from usdbrdf.model.arrays import Float

Types = Sdf.ValueTypeNames
# Arrays of pairs, and the precision of their numbers; halves are too coarse for large textures.
_PAIRS = {Vt.Vec2fArray: np.float32, Vt.Vec2dArray: np.float64}
THUMBNAIL = "previews/lit.png"  # in the asset folder


def write_texturing_layer(
    path: Path, uv_path: Path, draft: Draft, objects: Sequence[TexturedObject], scanned: Usd.Stage
) -> None:
    """Write texturing.usda to ``path``, and its sublayer of texture coordinates to ``uv_path``.

    scanned  the composed stage of the weaker layers
    """
    asset, scopes = draft.asset, draft.scopes
    folder = asset.layer("texturing").parent
    coordinates, layer = draft.new_layer(), draft.new_layer()
    layer.subLayerPaths = [f"./{asset.uv_layer.name}"]
    with Sdf.ChangeBlock():
        for item in objects:
            declared = scanned.GetAttributeAtPath(f"{item.prim_path}.primvars:st")
            author_texture_coordinates(
                over(coordinates, item.prim_path),
                item.corner_uv,
                declared.GetTypeName() if declared else Types.TexCoord2fArray,
            )
            author_record(over(layer, item.prim_path), item)
    _author_thumbnail(layer.GetPrimAtPath(scopes.root))
    author_looks(layer, draft, aov_looks(layer, scopes, objects), selected=LIT)
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
    values = corners[first].astype(_PAIRS[type(kind.defaultValue)])
    attribute(prim, "primvars:st", kind, values, interpolation="faceVarying")
    attribute(prim, "primvars:st:indices", Types.IntArray, index.reshape(-1).astype(np.int32))


def _author_thumbnail(root: Sdf.PrimSpec) -> None:
    """What browsers of assets show: the picture that the task texture writes beside the layer."""
    apply_schema(root, "AssetPreviewsAPI")
    picture = Sdf.AssetPath(path_in_layer(THUMBNAIL))
    thumbnails = {"default": {"defaultImage": picture}}
    root.SetInfo("assetInfo", {"previews": {"thumbnails": thumbnails}})
