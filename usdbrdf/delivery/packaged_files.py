"""The files that a flattened stage names: which they are, what for, and by what to replace them."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd, UsdShade, UsdUtils

from usdbrdf.asset.layout import Asset
from usdbrdf.errors import InputRefused


def named_files(layer: Sdf.Layer) -> set[str]:
    """Asset paths as written: sublayers, references, payloads, clips, attributes, metadata, of all
    variants. The layer is not changed."""
    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    found: set[str] = set()

    def seen(path: str) -> str:
        found.add(path)
        return path

    UsdUtils.ModifyAssetPaths(copy, seen)
    return found - {""}


Types = Sdf.ValueTypeNames

# The start of what no path of a file is, such as https://.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")

_COLOURS = frozenset({"diffuseColor", "emissiveColor", "specularColor"})


@dataclass(frozen=True, kw_only=True)
class TextureUse:
    """A UsdUVTexture node.

    prim_path     of the node
    file          absolute, inside the asset's folder, links followed
    space         "raw", "sRGB" or "auto"
    colour        False for data: roughness, normals, what feeds no colour of a surface
    reads_alpha   something is connected to its alpha
    """

    prim_path: str
    file: Path
    space: str
    colour: bool
    reads_alpha: bool


@dataclass(frozen=True, kw_only=True)
class NewTexture:
    """What takes the place of a file: value = stored * scale + bias, in the node's units.

    path   inside the package
    space  "raw" or "sRGB"
    """

    path: str
    space: str
    scale: float = 1.0
    bias: float = 0.0


def texture_uses(flat: Usd.Stage, asset: Asset) -> list[TextureUse]:
    """All texture nodes that name a file; InputRefused where it is missing or lies outside."""
    uses = []
    for prim in flat.TraverseAll():
        shader = UsdShade.Shader(prim)
        if not shader or shader.GetShaderId() != "UsdUVTexture":
            continue
        value = _produced(shader, "file")
        if isinstance(value, Sdf.AssetPath) and value.path:
            inputs, outputs = _fed(flat, prim)
            uses.append(
                TextureUse(
                    prim_path=str(prim.GetPath()),
                    file=file_in_asset(value.path, asset),
                    space=str(_produced(shader, "sourceColorSpace") or "auto"),
                    colour=bool(inputs & _COLOURS),
                    reads_alpha="a" in outputs,
                )
            )
    return uses


def use_texture(flat: Usd.Stage, use: TextureUse, new: NewTexture) -> None:
    """Make a node read the new file and give the same values."""
    shader = UsdShade.Shader(flat.GetPrimAtPath(use.prim_path))
    old_scale = Gf.Vec4f(_produced(shader, "scale") or Gf.Vec4f(1))
    old_bias = Gf.Vec4f(_produced(shader, "bias") or Gf.Vec4f(0))
    _set(shader, "file", Types.Asset, Sdf.AssetPath(f"./{new.path}"))
    _set(shader, "sourceColorSpace", Types.Token, new.space)
    if new.scale != 1 or new.bias != 0:
        scale = [old_scale[i] * new.scale for i in range(3)]
        bias = [old_bias[i] + old_scale[i] * new.bias for i in range(3)]
        _set(shader, "scale", Types.Float4, Gf.Vec4f(*scale, old_scale[3]))
        if any(bias) or any(old_bias):
            _set(shader, "bias", Types.Float4, Gf.Vec4f(*bias, old_bias[3]))
        fallback = _produced(shader, "fallback")
        if fallback is not None:
            stored = [(fallback[i] - new.bias) / new.scale for i in range(3)]
            _set(shader, "fallback", Types.Float4, Gf.Vec4f(*stored, fallback[3]))


def other_files(flat: Usd.Stage, done: Collection[str]) -> list[str]:
    """All asset paths of the stage, in attributes and metadata, but for those in ``done``."""
    return sorted(named_files(flat.GetRootLayer()) - {f"./{path}" for path in done})


def replace_files(flat: Usd.Stage, new: Mapping[str, str]) -> None:
    """Give asset paths other values: paths inside the package."""
    UsdUtils.ModifyAssetPaths(
        flat.GetRootLayer(), lambda path: f"./{new[path]}" if path in new else path
    )


def file_in_asset(path: str, asset: Asset) -> Path:
    """The file at an absolute path, links followed; InputRefused unless it is in the asset."""
    if _ADDRESS.match(path):
        raise InputRefused(
            f"{path}: files from the network are not packaged. Save it in the asset's folder and "
            "name that copy in edits.usda. [package.outside]"
        )
    place = Path(os.path.realpath(asset.folder / path))
    if "<UDIM>" in path:
        raise InputRefused(f"{path}: tiled (UDIM) textures are not packaged. [package.udim]")
    if not place.is_relative_to(os.path.realpath(asset.folder)):
        raise InputRefused(
            f"{path}: this file lies outside of the asset {asset.folder} and is not packaged. Copy "
            "it into the folder, or take it out of edits.usda. [package.outside]"
        )
    if not place.is_file():
        raise InputRefused(
            f"{path}: the asset names this file and it is not there. Run the steps again, or "
            "correct edits.usda. [package.missing]"
        )
    return place


def _produced(shader: UsdShade.Shader, name: str) -> Any:
    """The value of an input, wherever a chain of connections takes it from."""
    wanted = shader.GetInput(name)
    producers = wanted.GetValueProducingAttributes() if wanted else []
    return producers[0].Get() if producers else None


def _set(shader: UsdShade.Shader, name: str, type_name: Sdf.ValueTypeName, value: object) -> None:
    own = shader.CreateInput(name, type_name)
    own.ClearSources()  # a material's interface may serve nodes that read other files
    own.Set(value)


def _fed(flat: Usd.Stage, texture: Usd.Prim) -> tuple[set[str], set[str]]:
    """Inputs of surfaces in the same material that the texture feeds, and which of its outputs."""
    inputs, outputs = set(), set()
    material = texture.GetParent()
    while material.GetParent() and not material.IsA(UsdShade.Material):
        material = material.GetParent()
    for prim in Usd.PrimRange(material):
        shader = UsdShade.Shader(prim)
        for wanted in shader.GetInputs() if shader else []:
            for source in wanted.GetValueProducingAttributes():
                if source.GetPrim() == texture:
                    inputs.add(wanted.GetBaseName())
                    outputs.add(source.GetName().split(":")[-1])
    return inputs, outputs
