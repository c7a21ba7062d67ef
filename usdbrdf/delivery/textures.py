"""A texture as it goes into a package: the file itself, or its pixels smaller, or as 8 bits."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.asset.readers.materials import is_srgb, read_texture
from usdbrdf.delivery.packaged_files import NewTexture, TextureUse
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import image_size, read_exr, resized, write_exr, write_preview_png
from usdbrdf.model.arrays import Byte, Float

EXR, PNG = "exr", "png"

# What a package may hold as it is; of these, what has 8 bits already.
EIGHT_BIT = frozenset({".png", ".jpg", ".jpeg"})

IMAGES = EIGHT_BIT | {".exr"}

# What becomes EXR or PNG.
CONVERTED = frozenset({".hdr", ".tif", ".tiff"})


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """format: "exr" keeps files as they are, "png" makes 8 bits of floats; max_size: of the longer
    side in pixels, None for any."""

    format: str = EXR
    max_size: int | None = None


def add_texture(
    use: TextureUse, folder: Path, taken: Collection[str], options: PictureOptions
) -> NewTexture:
    """Write the texture of a node below ``folder``; returns where, and how to read it.

    taken  paths that the package has already
    """
    _check_is_image(use.file)
    source = use.file.suffix.lower()
    width, height, _ = image_size(use.file)
    smaller = size_within(width, height, options.max_size)
    fits = smaller == (width, height)
    as_it_is = source in EIGHT_BIT or (options.format == EXR and source not in CONVERTED)
    if as_it_is and (fits or use.reads_alpha):
        path = _free(f"textures/{use.file.stem}{source}", taken)
        _place(folder / path)
        shutil.copyfile(use.file, folder / path)
        return NewTexture(path=path, space="sRGB" if is_srgb(use.file, use.space) else "raw")
    if use.reads_alpha and options.format != EXR:
        raise InputRefused(
            f"{use.file}: its alpha is used, and 8-bit packages keep alpha of PNG files only. Save "
            "it as PNG. [package.alpha]"
        )
    pixels = read_texture(use.file, use.space)
    if use.reads_alpha:
        pixels = _with_alpha(pixels, use.file)
    if not fits:
        pixels = resized(pixels, *smaller)
    path = _free(f"textures/{use.file.stem}.{options.format}", taken)
    _place(folder / path)
    if options.format == EXR:
        write_exr(folder / path, pixels)
        return NewTexture(path=path, space="raw")
    stored, scale, bias = encoded_colour(pixels) if use.colour else encoded_data(pixels)
    write_preview_png(folder / path, stored)
    return NewTexture(path=path, space="sRGB" if use.colour else "raw", scale=scale, bias=bias)


def add_file(file: Path, below: Path, folder: Path, taken: Collection[str]) -> str:
    """Add a picture that is no texture of a material, such as a dome light's; returns its path in
    the package, which is the one that it has below ``below`` if that is free."""
    _check_is_image(file)
    convert = file.suffix.lower() in CONVERTED
    place = file.relative_to(below)
    path = _free((place.with_suffix(f".{EXR}") if convert else place).as_posix(), taken)
    _place(folder / path)
    if convert:
        write_exr(folder / path, read_texture(file, "auto"))
    else:
        shutil.copyfile(file, folder / path)
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


def _with_alpha(colour: Float, file: Path) -> Float:
    """(H, W, 4), or the colour alone where the file has no alpha: readers take it for 1."""
    names = [name.upper() for name in image_size(file)[2]]
    if "A" not in names:
        return colour
    alpha = np.nan_to_num(read_exr(file)[..., names.index("A"), None])
    return np.concatenate([colour, alpha], axis=2)


def _check_is_image(file: Path) -> None:
    if file.suffix.lower() not in IMAGES | CONVERTED:
        known = ", ".join(sorted(IMAGES | CONVERTED))
        raise InputRefused(
            f"{file}: packages are made of {known} only. Convert it, or take it out of edits.usda. "
            "[package.format]"
        )
    image_size(file)  # refuses what only has the name of a picture


def _free(path: str, taken: Collection[str]) -> str:
    """The path, numbered where it is taken; names that differ in case only count as equal."""
    used = {name.lower() for name in taken}
    stem, dot, suffix = path.rpartition(".")
    number, free = 2, path
    while free.lower() in used:
        free = f"{stem}_{number}{dot}{suffix}"
        number += 1
    return free


def _place(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
