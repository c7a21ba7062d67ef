"""The files that a flattened stage names: which they are and what for; as what they go into a
package, the file itself, its pixels smaller, or as 8 bits; and the stage that names them there."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdShade

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.surfaces import is_srgb, read_texture
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, to_display_srgb8
from usdbrdf.files.images import image_size, read_exr, resized, write_exr, write_preview_png
from usdbrdf.files.published_images import copy_without_metadata, refuse_misnamed, write_texture
from usdbrdf.model.arrays import Byte, Float

Types = Sdf.ValueTypeNames
EXR = "exr"
# What a package may hold as it is; of these, what has 8 bits already.
EIGHT_BIT = frozenset({".png", ".jpg", ".jpeg"})
IMAGES = EIGHT_BIT | {".exr"}
# What becomes EXR or PNG.
CONVERTED = frozenset({".hdr", ".tif", ".tiff"})
# The start of what no path of a file is, such as https://.
ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
COLOURS = frozenset({"diffuseColor", "emissiveColor", "specularColor"})


@dataclass(frozen=True, kw_only=True)
class TextureUse:
    """A UsdUVTexture node.

    prim_path     of the node
    file          absolute, inside the asset's folder, links followed
    space         "raw", "sRGB" or "auto"
    colour        False for data: roughness, normals, what feeds no colour of a surface
    reads_alpha   something is connected to its alpha
    feeds         the inputs of nodes that it is connected to
    """

    prim_path: str
    file: Path
    space: str
    colour: bool
    reads_alpha: bool
    feeds: frozenset[str] = frozenset()


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


def texture_uses(flat: Usd.Stage, asset: Asset, made: Path | None = None) -> list[TextureUse]:
    """All texture nodes that name a file; InputRefused where it is missing or lies outside of the
    asset and of the folder ``made``, which holds what the package has of its own."""
    uses = []
    for prim in flat.TraverseAll():
        shader = UsdShade.Shader(prim)
        if not shader or shader.GetShaderId() != "UsdUVTexture":
            continue
        value = produced(shader, "file")
        if isinstance(value, Sdf.AssetPath) and value.path:
            fed = fed_inputs(prim)
            uses.append(
                TextureUse(
                    prim_path=str(prim.GetPath()),
                    file=file_in_asset(value.path, asset, made),
                    space=str(produced(shader, "sourceColorSpace") or "auto"),
                    colour=any(name in COLOURS for name, _ in fed),
                    reads_alpha=any(output == "a" for _, output in fed),
                    feeds=frozenset(name for name, _ in fed),
                )
            )
    return uses


def add_texture(
    use: TextureUse,
    folder: Path,
    taken: Collection[str],
    format: str,
    max_size: int | None,
    convert: Callable[[Float], Float] | None = None,
    encoding: str = WORKING_SPACE,
) -> NewTexture:
    """Write the texture of a node below ``folder``; returns where, and how to read it.

    taken     paths that the package has already
    format    "exr" keeps pixels as they are, tiled and with smaller copies; "png" makes 8 bits of
              floats
    max_size  of the longer side in pixels, None for any
    convert   what to do to the pixels of an EXR, which ``encoding`` is the colour space of then
    """
    width, height, channels = checked_size(use.file)
    source = use.file.suffix.lower()
    smaller = size_within(width, height, max_size)
    fits = smaller == (width, height)
    as_it_is = source in EIGHT_BIT or (format == EXR and source not in CONVERTED)
    if as_it_is and (fits or use.reads_alpha):
        path = _free(f"textures/{use.file.stem}{source}", taken, folder)
        if source in EIGHT_BIT:
            copy_without_metadata(use.file, folder / path)
        else:
            converted = convert(read_exr(use.file)) if convert else None
            write_texture(folder / path, use.file, converted=converted, encoding=encoding)
        return NewTexture(path=path, space="sRGB" if is_srgb(use.file, use.space) else "raw")
    if use.reads_alpha and format != EXR:
        raise InputRefused(
            f"{use.file}: its alpha is used, and 8-bit packages keep alpha of PNG files only. Save "
            "it as PNG. [package.alpha]"
        )
    pixels = read_texture(use.file, use.space)
    names = [name.upper() for name in channels]
    if use.reads_alpha and "A" in names:  # readers take it for 1 where the file has none
        alpha = np.nan_to_num(read_exr(use.file)[..., names.index("A"), None])
        pixels = np.concatenate([pixels, alpha], axis=2)
    if not fits:
        pixels = resized(pixels, *smaller)
    path = _free(f"textures/{use.file.stem}.{format}", taken, folder)
    if format == EXR:
        write_exr(folder / path, convert(pixels) if convert else pixels, encoding=encoding)
        write_texture(folder / path, folder / path)
        return NewTexture(path=path, space="raw")
    stored, scale, bias = encoded_colour(pixels) if use.colour else encoded_data(pixels)
    write_preview_png(folder / path, stored)
    return NewTexture(path=path, space="sRGB" if use.colour else "raw", scale=scale, bias=bias)


def add_file(
    file: Path,
    below: Path,
    folder: Path,
    taken: Collection[str],
    colours: Callable[[Float], Float] | None = None,
    encoding: str = WORKING_SPACE,
) -> str:
    """Add a picture that is no texture of a material, such as a dome light's; returns its path in
    the package, which is the one that it has below ``below`` if that is free.

    colours, encoding  what brings its colours to another space, and that one
    """
    checked_size(file)
    convert = file.suffix.lower() in CONVERTED or colours is not None
    place = file.relative_to(below)
    path = _free((place.with_suffix(f".{EXR}") if convert else place).as_posix(), taken, folder)
    if convert:
        pixels = read_texture(file, "auto")
        write_exr(folder / path, colours(pixels) if colours else pixels, encoding=encoding)
    else:
        copy_without_metadata(file, folder / path)
    return path


def encoded_colour(linear: Float) -> tuple[Byte, float, float]:
    """sRGB bytes, (H, W, 3) uint8, with linear = decoded * scale + bias; bias is 0, and scale above
    1 where the colour is, as of emission."""
    scale = max(1.0, float(linear.max()))
    return to_display_srgb8(linear, exposure_scale=1 / scale), scale, 0.0


def encoded_data(values: Float) -> tuple[Byte, float, float]:
    """Bytes as they are, with values = stored / 255 * scale + bias; bias and scale are 0 and 1 for
    values in [0, 1]."""
    low, high = min(0.0, float(values.min())), max(1.0, float(values.max()))
    unit = (values - np.float32(low)) / np.float32(high - low)
    return (unit * 255 + 0.5).astype(np.uint8), high - low, low


def size_within(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """The size at which the longer side has at most ``max_size`` pixels."""
    factor = min(1.0, max_size / max(width, height)) if max_size else 1.0
    return max(1, round(width * factor)), max(1, round(height * factor))


def checked_size(file: Path) -> tuple[int, int, tuple[str, ...]]:
    if file.suffix.lower() not in IMAGES | CONVERTED:
        known = ", ".join(sorted(IMAGES | CONVERTED))
        raise InputRefused(
            f"{file}: packages are made of {known} only. Convert it, or take it out of edits.usda. "
            "[package.format]"
        )
    refuse_misnamed(file)
    return image_size(file)  # refuses what only has the name of a picture


def _free(path: str, taken: Collection[str], folder: Path) -> str:
    """The path, numbered where it is taken, with the folders above it made below ``folder``; names
    that differ in case only count as equal."""
    used = {name.lower() for name in taken}
    stem, dot, suffix = path.rpartition(".")
    number, free = 2, path
    while free.lower() in used:
        free, number = f"{stem}_{number}{dot}{suffix}", number + 1
    (folder / free).parent.mkdir(parents=True, exist_ok=True)
    return free


def use_texture(flat: Usd.Stage, use: TextureUse, new: NewTexture) -> None:
    """Make a node read the new file and give the same values."""
    shader = UsdShade.Shader(flat.GetPrimAtPath(use.prim_path))
    old_scale = Gf.Vec4f(produced(shader, "scale") or Gf.Vec4f(1))
    old_bias = Gf.Vec4f(produced(shader, "bias") or Gf.Vec4f(0))
    set_input(shader, "file", Types.Asset, Sdf.AssetPath(f"./{new.path}"))
    set_input(shader, "sourceColorSpace", Types.Token, new.space)
    if new.scale != 1 or new.bias != 0:
        scale = [old_scale[i] * new.scale for i in range(3)]
        bias = [old_bias[i] + old_scale[i] * new.bias for i in range(3)]
        set_input(shader, "scale", Types.Float4, Gf.Vec4f(*scale, old_scale[3]))
        if any(bias) or any(old_bias):
            set_input(shader, "bias", Types.Float4, Gf.Vec4f(*bias, old_bias[3]))
        fallback = produced(shader, "fallback")
        if fallback is not None:
            stored = [(fallback[i] - new.bias) / new.scale for i in range(3)]
            set_input(shader, "fallback", Types.Float4, Gf.Vec4f(*stored, fallback[3]))


def file_in_asset(path: str, asset: Asset, made: Path | None = None) -> Path:
    """The file at an absolute path, links followed; InputRefused unless it is in the asset, or in
    the folder ``made``."""
    if ADDRESS.match(path):
        raise InputRefused(
            f"{path}: files from the network are not packaged. Save it in the asset's folder and "
            "name that copy in edits.usda. [package.outside]"
        )
    place = Path(os.path.realpath(asset.folder / path))
    if "<UDIM>" in place.name:
        raise InputRefused(f"{path}: tiled (UDIM) textures are not packaged. [package.udim]")
    homes = [os.path.realpath(folder) for folder in (asset.folder, made) if folder]
    if not any(place.is_relative_to(home) for home in homes):
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


def produced(shader: UsdShade.Shader, name: str) -> Any:
    """The value of an input, wherever a chain of connections takes it from."""
    wanted = shader.GetInput(name)
    producers = wanted.GetValueProducingAttributes() if wanted else []
    return producers[0].Get() if producers else None


def set_input(
    shader: UsdShade.Shader, name: str, type_name: Sdf.ValueTypeName, value: object
) -> None:
    """Give an input a plain value of its own."""
    own = shader.CreateInput(name, type_name)
    own.ClearSources()  # a material's interface may serve nodes that read other files
    own.Set(value)


def fed_inputs(texture: Usd.Prim) -> list[tuple[str, str]]:
    """Inputs in the same material that the texture feeds, each with which of its outputs."""
    material = texture.GetParent()
    while material.GetParent() and not material.IsA(UsdShade.Material):
        material = material.GetParent()
    shaders = [UsdShade.Shader(prim) for prim in Usd.PrimRange(material)]
    inputs = [each for shader in shaders if shader for each in shader.GetInputs()]
    return [
        (wanted.GetBaseName(), source.GetName().split(":")[-1])
        for wanted in inputs
        for source in wanted.GetValueProducingAttributes()
        if source.GetPrim() == texture
    ]
