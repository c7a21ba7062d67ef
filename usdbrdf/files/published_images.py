"""Pictures as they are handed over: textures tiled and with their smaller copies, photographs
without what cameras and programs wrote beside their pixels. Beside ``images`` the only importer of
OpenImageIO.

Pixels stay what they are, to the bit: each file is read back and compared.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import cure_of_writing, publish, temporary_beside
from usdbrdf.files.colour import chromaticities_of
from usdbrdf.files.images import open_image, pixels_of, refuse_other, write_image
from usdbrdf.files.jpeg_bytes import JPEG_SUFFIXES, jpeg_without_metadata
from usdbrdf.model.arrays import Float

_TILE = 64
_PINNED_DATE = "2000:01:01 00:00:00"
# What a header says of how pixels are stored and what they mean; all else is about who took them,
# where and with what.
_ABOUT_PIXELS = re.compile(
    r"compression|colorInteropID|chromaticities|adoptedNeutral|whiteLuminance|ICCProfile"
    r"|oiio:(ColorSpace|Gamma|BitsPerSample|UnassociatedAlpha|RowsPerChunk|subimages|miplevels"
    r"|AverageColor|ConstantColor|SHA-1)"
    r"|openexr:\w+|PixelAspectRatio|screenWindow\w+|fovcot|textureformat|wrapmodes"
    r"|planarconfig|tiff:(PhotometricInterpretation|PlanarConfiguration|Compression|RowsPerStrip)"
    r"|(X|Y)Resolution|ResolutionUnit"
)
_HDR_LINES = re.compile(rb"FORMAT=|EXPOSURE=|COLORCORR=|PRIMARIES=|PIXASPECT=")
# What programs expect behind which name, as OpenImageIO calls it.
_NAMED = {
    "jpeg": JPEG_SUFFIXES,
    "hdr": frozenset({".hdr", ".pic"}),
    "openexr": frozenset({".exr"}),
    "tiff": frozenset({".tif", ".tiff"}),
    "png": frozenset({".png"}),
}
_SUFFIX = {format: min(suffixes) for format, suffixes in _NAMED.items()}
CLEANED = frozenset[str]().union(*_NAMED.values())


def write_texture(
    target: Path, source: Path, *, converted: Float | None = None, encoding: str = ""
) -> None:
    """A tiled EXR with all its smaller copies (mip maps, each the mean of what it covers), as
    renderers read it in parts, of an EXR.

    converted  (H, W, C) float32 to be stored in the place of the source's own pixels
    encoding   the colour space that those are in
    """
    reader = open_image(source)
    spec = reader.spec()
    pixels = pixels_of(source, reader) if converted is None else converted
    image = oiio.ImageBuf(_plain_spec(spec, "" if converted is None else encoding))
    image.set_pixels(image.roi, np.ascontiguousarray(pixels))
    wanted = oiio.ImageSpec()
    wanted.tile_width = wanted.tile_height = _TILE
    for name, value in (
        ("maketx:filtername", "box"),
        ("wrapmodes", "clamp,clamp"),
        ("compression", "zip"),
        ("DateTime", _PINNED_DATE),
    ):
        wanted.attribute(name, value)
    with temporary_beside(target) as staged:
        with _without_percent(staged.parent) as folder:
            place = str(folder / staged.name)
            made = oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, image, place, wanted)
        if not made:
            raise EnvironmentFailure(
                f"{target}: cannot be written ({oiio.geterror()}). {cure_of_writing(staged)}, then "
                "run the same command again. [image.write]"
            )
        # Smaller copies cannot be made around holes: they are filled.
        stored = pixels.astype(np.float16) if str(spec.format) == "half" else pixels
        refuse_other(target, staged, stored.astype(np.float32))
        publish(staged, target)


@contextmanager
def _without_percent(folder: Path) -> Iterator[Path]:
    """Another path to a folder whose own has a %: OpenImageIO names what it stages beside a texture
    by random digits, which it puts in the place of every % of the whole path."""
    if "%" not in str(folder):
        yield folder
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield Path(f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)


def misnamed(path: Path) -> str:
    """What is wrong with the name of a picture, in words: its bytes are of another format than
    that by which programs choose how to read it; "" where nothing is."""
    format, suffix = open_image(path).format_name(), path.suffix.lower()
    if suffix not in CLEANED or suffix in _NAMED[format]:
        return ""
    return (
        f"it holds {format.removeprefix('open').upper()} and is called {suffix}, by which programs "
        "choose how to read it. Rename it, or export it again."
    )


def refuse_misnamed(path: Path) -> None:
    """InputRefused for a picture that is not what its name says."""
    if wrong := misnamed(path):
        raise InputRefused(f"{path}: {wrong} [image.name]")


def copy_without_metadata(source: Path, target: Path) -> None:
    """A picture without EXIF, GPS, XMP, comments and names of people and devices; a file that has
    none of these is copied as it is. Formats other than EXR, HDR, TIFF, PNG and JPEG are copied
    too."""
    if source.suffix.lower() not in CLEANED:
        with temporary_beside(target) as staged:
            shutil.copyfile(source, staged)
            publish(staged, target)
        return
    reader = open_image(source)
    kind = reader.format_name()  # photographs may be called otherwise, and stay so
    # What is written anew is written as the name of its file says.
    named = target if target.suffix.lower() in _NAMED[kind] else target.with_suffix(_SUFFIX[kind])
    with temporary_beside(named) as staged:
        if kind == "jpeg":
            pixels = pixels_of(source, reader)  # refuses what is cut short
            staged.write_bytes(jpeg_without_metadata(source.read_bytes()))
            refuse_other(target, staged, pixels)
        elif kind == "hdr":
            staged.write_bytes(_hdr_without_metadata(source.read_bytes()))
        elif _tells_more(reader.spec()):
            spec = _plain_spec(reader.spec(), "")
            pixels = pixels_of(source, reader)
            write_image(target, staged, spec, pixels)
            refuse_other(target, staged, pixels)
        else:
            shutil.copyfile(source, staged)
        publish(staged, target)


def _tells_more(spec: Any) -> bool:
    names = {item.name: item.value for item in spec.extra_attribs}
    dated = names.pop("DateTime", _PINNED_DATE) != _PINNED_DATE
    return dated or not all(_ABOUT_PIXELS.fullmatch(name) for name in names)


def _plain_spec(spec: Any, encoding: str) -> Any:
    """Size, windows, channels, numbers and colour space of an image, and nothing else."""
    plain = oiio.ImageSpec()
    plain.copy_dimensions(spec)
    plain.channelnames, plain.channelformats = spec.channelnames, ()
    # What is left out cannot be erased instead: names need not be text.
    for item in spec.extra_attribs:
        if _ABOUT_PIXELS.fullmatch(item.name):
            plain.attribute(item.name, item.type, item.value)
    plain.attribute("DateTime", _PINNED_DATE)
    plain.tile_width = plain.tile_height = plain.tile_depth = 0
    if encoding:
        plain.erase_attribute("colorInteropID")  # which comes before the name
        plain.set_colorspace(encoding)
        plain.attribute("chromaticities", "float[8]", chromaticities_of(encoding))
    if str(spec.getattribute("compression") or "").startswith(("dwa", "b44", "pxr24")):
        plain.attribute("compression", "zip")  # what loses nothing more
    return plain


def _hdr_without_metadata(content: bytes) -> bytes:
    head, blank, rest = content.partition(b"\n\n")
    first, *lines = head.split(b"\n")
    return b"\n".join([first, *(line for line in lines if _HDR_LINES.match(line))]) + blank + rest
