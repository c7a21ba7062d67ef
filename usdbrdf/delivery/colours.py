"""An asset's colours in another scene-linear space than linear Rec.709: those that layers state,
and the textures that colours are read from. Programs that render in ACEScg take what is called raw
for theirs, and convert nothing.

What was measured (``usdBrdf:*``) stays what it is, and says in which space."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdShade

from usdbrdf.asset.readers.scene import asset_file
from usdbrdf.asset.readers.surfaces import is_srgb
from usdbrdf.delivery.collection import canonical
from usdbrdf.delivery.packaged_files import COLOURS, fed_inputs, produced
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import ACESCG, WORKING_SPACE, from_working_space
from usdbrdf.files.images import read_exr, stored_space
from usdbrdf.model.arrays import Float

_MEASURED = "usdBrdf:"
_SPACE_OF_PRIM, _SPACE_OF_RENDER = "colorSpace:name", "renderingColorSpace"
_DATA = frozenset({"data", "raw"})
_IN_MATERIALX = {ACESCG: "acescg"}  # which has names of its own
_MATERIALX_COLOURS = ("ND_image_color3", "ND_tiledimage_color3")


@dataclass(frozen=True)
class ColourTextures:
    """Which textures of a stage are colours in the working space.

    files      of the textures
    readers    paths of the shaders and lights that read them -> how these call the new space
    fallbacks  paths of the shaders whose fallbacks are colours, which has those of 8 bits too
    """

    files: set[Path] = field(default_factory=set)
    readers: dict[str, str] = field(default_factory=dict)
    fallbacks: set[str] = field(default_factory=set)

    def look_at(self, stage: Usd.Stage, space: str) -> None:
        """Add those of a stage that are to be in ``space``. InputRefused where a node multiplies
        red, green and blue by different numbers: that means another thing in another space."""
        for prim in stage.TraverseAll():
            file = _colour_file(prim)
            if file is not None and _is_convertible(file, prim):
                self.files.add(canonical(file))
                materialx = str(prim.GetAttribute("info:id").Get() or "").startswith("ND_")
                called = _IN_MATERIALX.get(space, space) if materialx else space
                self.readers[str(prim.GetPath())] = called
            shader = UsdShade.Shader(prim)
            if not shader or shader.GetShaderId() != "UsdUVTexture" or not _feeds_colour(prim):
                continue
            self.fallbacks.add(str(prim.GetPath()))
            for name in ("scale", "bias"):
                factors = produced(shader, name)
                if factors is not None and len({*list(factors)[:3]}) > 1:
                    raise InputRefused(
                        f"<{prim.GetPath()}>: its {name} differs between red, green and blue, "
                        "which has no counterpart in another colour space. Put it into the "
                        "texture. [colour.scale]"
                    )


def _colour_file(prim: Usd.Prim) -> Path | None:
    """The file that a shader or a light reads linear colours of the working space from."""
    shader = UsdShade.Shader(prim)
    kind = shader.GetShaderId() if shader else ""
    if prim.GetTypeName() == "DomeLight":
        attribute = prim.GetAttribute("inputs:texture:file")
    elif kind == "UsdUVTexture" and _feeds_colour(prim):
        sources = shader.GetInput("file").GetValueProducingAttributes()
        attribute = sources[0] if sources else None
    elif kind in _MATERIALX_COLOURS:
        attribute = prim.GetAttribute("inputs:file")
    else:
        return None
    file = asset_file(attribute, Usd.TimeCode.EarliestTime()) if attribute else None
    space = str(produced(shader, "sourceColorSpace") or "auto") if shader else "raw"
    # Whoever reads sRGB knows what to do.
    return None if file is None or not file.is_file() or is_srgb(file, space) else file


def _feeds_colour(prim: Usd.Prim) -> bool:
    return any(name in COLOURS for name, _ in fed_inputs(prim))


def _is_convertible(file: Path, prim: Usd.Prim) -> bool:
    """Whether pixels are three channels that do not say they are something else. Grey is grey in
    every space."""
    space, channels = stored_space(file)
    if space in _DATA or channels < 3:
        return False
    if file.suffix.lower() != ".exr":
        raise InputRefused(
            f"{file}: <{prim.GetPath()}> reads it as linear colours, and only EXR files are "
            "converted to another space. Save it as EXR. [colour.format]"
        )
    return True


def converted_texture(file: Path, space: str) -> Float:
    """(H, W, C) float32: an image with its red, green and blue in another space."""
    return in_space(read_exr(file), space)


def in_space(pixels: Float, space: str) -> Float:
    """The same of pixels of linear Rec.709 and what they have beside."""
    rgb = from_working_space(np.ascontiguousarray(pixels[..., :3]), space)
    return np.concatenate([rgb, pixels[..., 3:]], axis=2)


def convert_layer(layer: Sdf.Layer, textures: ColourTextures, space: str) -> bool:
    """Convert every colour that a layer states, and say so, also of the textures that are to be
    converted; returns whether there was any."""
    found: list[Sdf.AttributeSpec] = []

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.AttributeSpec):
            found.append(spec)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    elsewhere = [
        spec.path.GetPrimPath()
        for spec in found
        if spec.name == _SPACE_OF_PRIM and spec.default not in (None, WORKING_SPACE, space)
    ]
    changed = False
    for spec in found:
        if not any(spec.path.HasPrefix(prim) for prim in elsewhere):
            changed = _convert(layer, spec, textures, space) or changed
    return changed


def _convert(
    layer: Sdf.Layer, spec: Sdf.AttributeSpec, textures: ColourTextures, space: str
) -> bool:
    if spec.name in (_SPACE_OF_PRIM, _SPACE_OF_RENDER) and spec.default == WORKING_SPACE:
        spec.default = space
        return True
    prim = str(spec.path.GetPrimPath().StripAllVariantSelections())
    if spec.name in ("inputs:file", "inputs:texture:file") and prim in textures.readers:
        spec.SetInfo("colorSpace", textures.readers[prim])
        return True
    is_fallback = spec.name == "inputs:fallback" and prim in textures.fallbacks
    if spec.roleName != "Color" and not is_fallback:
        return False
    own = spec.GetInfo("colorSpace") if spec.HasInfo("colorSpace") else ""
    if own not in ("", WORKING_SPACE):
        return False
    if spec.name.startswith(_MEASURED):
        spec.SetInfo("colorSpace", WORKING_SPACE)
        return True
    if own:
        spec.SetInfo("colorSpace", space)
    if spec.default is not None:
        spec.default = _in_space(spec.default, space)
    for time in layer.ListTimeSamplesForPath(spec.path):
        value = layer.QueryTimeSample(spec.path, time)
        layer.SetTimeSample(spec.path, time, _in_space(value, space))
    return True


def _in_space(value: Any, space: str) -> Any:
    """A colour, or an array of them, of any of USD's types, with alpha where it has one."""
    if isinstance(value, Sdf.ValueBlock):
        return value
    numbers = np.array(value, np.float64)
    rows = numbers.reshape(1, -1, numbers.shape[-1])
    rows[..., :3] = from_working_space(rows[..., :3].astype(np.float32), space)
    if numbers.ndim == 1:
        return type(value)(*rows.ravel().tolist())
    stored = np.array(value).dtype
    return type(value).FromNumpy(rows[0].astype(stored))
