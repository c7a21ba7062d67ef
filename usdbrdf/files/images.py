"""Images in and out; beside ``published_images`` the only importer of OpenImageIO.

Reading gives every pixel or refuses: a truncated file never becomes zeros, and what is made of a
file is bounded, whatever it stores. Writing clamps to what half floats hold, pins the date so that
equal pixels give equal bytes, and reads the file back.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import OpenImageIO as oiio

from usdbrdf.errors import EnvironmentFailure, ImageRefused, UsdBrdfError
from usdbrdf.files.atomic import (
    cure_of_writing,
    environment_failures,
    publish,
    raise_shortage,
    sha256_of,
    temporary_beside,
)
from usdbrdf.files.camera_colour import space_by_exif
from usdbrdf.files.channels import colours_of, layers_with_colours
from usdbrdf.files.exr_bytes import lists_its_chunks
from usdbrdf.files.icc_profiles import space_of_profile
from usdbrdf.files.jpeg_bytes import END, JPEG_SUFFIXES, jpeg_without_metadata, segments_of_jpeg
from usdbrdf.files.paths import readable_size
from usdbrdf.files.png_bytes import space_by_chunks
from usdbrdf.files.radiance_header import primaries_of_hdr
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.model.arrays import Bool, Byte, Float

T = TypeVar("T")
MAX_SIDE = 65_536  # pixels
MAX_PIXELS = 1 << 28
MAX_CHANNELS = 64
MAX_DECLARED_BYTES = 4 << 30
# Declared bytes per stored byte, asked of images above so many bytes.
MAX_INFLATION, _ANY_INFLATION = 10_000, 1 << 30
# A display window may be larger than what the file holds; beyond this many bytes not by any factor.
MAX_UNKNOWN_BYTES, MAX_UNKNOWN_SHARE = 64 << 20, 63 / 64
HALF_MAX = 65_504.0
# What halves hold well: a little less than the largest, and all their digits.
_HALF_FROM, _HALF_UNTIL = 2.0**-14, 60_000.0
_PINNED_DATE = "2000:01:01 00:00:00"  # the date is all that would make two equal EXRs differ
_FORMATS = ("openexr", "hdr", "tiff", "png", "jpeg")
RAW_SUFFIXES = frozenset((
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".nrw", ".orf",
    ".pef", ".raf", ".raw", ".rw2", ".sr2", ".srf", ".srw", ".x3f",
))  # fmt: skip
_CHANNEL_NAMES = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
_FOR_A_HEADER = 16 << 20  # bytes
# As OpenImageIO and the libraries below it put it.
_WANT_OF_MEMORY = re.compile(r"bad_alloc|out of memory|cannot allocate", re.IGNORECASE)
# Process-wide guards of the decoders themselves, before anything is allocated.
oiio.attribute("limits:channels", MAX_CHANNELS)
oiio.attribute("limits:resolution", MAX_SIDE)
oiio.attribute("limits:imagesize_MB", MAX_DECLARED_BYTES >> 20)


def read_radiance(path: Path, *, max_side: int = MAX_SIDE, alpha: bool = False) -> Float:
    """The R, G and B of an image as stored, (H, W, 3) float32, no colour conversion; with ``alpha``
    that too, (H, W, 4), where the image has it.

    H, W are the display window's; its pixels that the file does not hold are NaN (unknown, not
    black). NaN and infinity in the file are returned as they are. Integer images give [0, 1].
    """
    return _although_unread_once(path, lambda: _radiance(path, max_side, alpha))


def _radiance(path: Path, max_side: int, alpha: bool) -> Float:
    source = open_image(path, max_side)
    with _decoding(path, source, "truncated or damaged", "image.truncated"):
        colours = colours_of(source)
    if not isinstance(colours, dict):
        names = ", ".join(map(repr, colours or source.spec().channelnames))
        said = f"no channels R, G and B among {names}"
        if colours:
            have = "layer has" if len(colours) == 1 else "layers have"
            said = (
                f"{len(colours)} {have} R, G and B ({names}), and not one of them alone is "
                "called beauty or Combined"
            )
        grey = set(source.spec().channelnames) <= {"Y", "A"}
        cure = "It is grey: export it in colour" if grey else "Export the beauty pass as R, G, B"
        raise ImageRefused(f"{path}: {said}. {cure}. [image.channels]")
    channels = [colours[letter] for letter in ("rgba" if alpha else "rgb") if letter in colours]
    # OpenImageIO has them between 0 and 1, of four thousand millions, which is black.
    kinds = {str(source.spec().channelformat(channel)) for channel in channels}
    if source.format_name() == "openexr" and "uint" in kinds:
        raise ImageRefused(
            f"{path}: its R, G and B are whole numbers (UINT), of which nothing says what is "
            "white. Export them as HALF or FLOAT. [image.channels]"
        )
    pixels = pixels_of(path, source)
    if channels != list(range(pixels.shape[2])):
        pixels = pixels[..., channels]
    return _in_display_window(source.spec(), np.ascontiguousarray(pixels))


def read_exr(path: Path) -> Float:
    """All channels of an image in file order, (H, W, C) float32, NaN outside the data window."""

    def read() -> Float:
        source = open_image(path)
        return _in_display_window(source.spec(), pixels_of(path, source))

    return _although_unread_once(path, read)


def white_of_mask(path: Path) -> Bool:
    """(H, W): where a mask's picture is not black, whatever its alpha."""
    pixels = read_exr(path)
    colours = pixels[..., : 3 if pixels.shape[2] > 2 else 1]
    return np.asarray(colours.max(axis=-1) > 0.5, np.bool_)


def orientation_of(path: Path) -> int:
    """How a photograph's EXIF data say that it is to be turned to be upright: 1, not at all, to 8;
    5 to 8 swap its sides. 1 where they do not say."""
    said = open_image(path).spec().getattribute("Orientation")
    return said if isinstance(said, int) and 1 <= said <= 8 else 1


def _although_unread_once(path: Path, read: Callable[[], T]) -> T:
    """What is read of an image. One that is refused is read again: a disk that fails for a moment
    says nothing of the file, and would be remembered as damage of it. EnvironmentFailure where it
    still fails."""
    try:
        return read()
    except ImageRefused as refused:
        refused.path = path
        if not os.path.isfile(path) or not os.access(path, os.R_OK):
            raise
    with environment_failures(str(path)):
        sha256_of(path)
    try:
        return read()
    except ImageRefused as refused:
        refused.path = path
        raise


def image_size(path: Path) -> tuple[int, int, tuple[str, ...]]:
    """Width and height of the display window and the channel names, from the header alone."""
    spec = open_image(path).spec()
    return spec.full_width, spec.full_height, tuple(spec.channelnames)


def kind_of_colours(path: Path) -> int:
    """Which colours an image's header announces: 2, R, G and B; 1, those of a layer; 0, none, so
    that ``read_radiance`` refuses it."""
    source = open_image(path)
    with _decoding(path, source, "not a readable image", "image.unreadable"):
        known = isinstance(colours_of(source), dict)
    return int(known) and 1 + ("" in layers_with_colours(source.spec().channelnames))


def colour_tag(path: Path) -> tuple[str, tuple[float, ...]]:
    """What an image's header says of its colour space: that of the ICC profile in it, else what
    EXIF data say instead of sRGB, else another name, "" without one; and x, y of red, green, blue
    and white, () without these."""
    source = open_image(path)
    spec = source.spec()
    # Of Radiance's files OpenImageIO says Rec.709, whatever primaries they state.
    if source.format_name() == "hdr" and (stated := primaries_of_hdr(path)):
        return "", stated
    # Of JPEG and PNG OpenImageIO says sRGB, whatever profile is in them.
    profile = spec.getattribute("ICCProfile")
    name = spec.getattribute("ICCProfile:profile_description")
    if profile is not None:
        known = space_of_profile(np.asarray(profile, np.uint8).tobytes())
        name = known or name or "an ICC profile without a name"
    if source.format_name() == "png":
        name = name or space_by_chunks(path)
    if source.format_name() in ("jpeg", "tiff"):
        name = name or space_by_exif(path, spec.getattribute("Exif:ColorSpace"))
    name, places = name or spec.getattribute("oiio:ColorSpace"), spec.getattribute("chromaticities")
    sound = isinstance(places, tuple) and len(places) == 8
    return str(name or ""), tuple(float(place) for place in places) if sound else ()


def header_of(path: Path, names: Sequence[str]) -> list[Any]:
    """What an image's header says by these names, None where it says nothing."""
    spec = open_image(path).spec()
    return [spec.getattribute(name) for name in names]


def stored_space(path: Path) -> tuple[str, int]:
    """The colour space that an image's header names, "" for none, and how many channels it has."""
    spec = open_image(path).spec()
    return str(spec.getattribute("oiio:ColorSpace") or ""), int(spec.nchannels)


def name_of_format(path: Path) -> str:
    """JPEG, PNG, TIFF, OPENEXR and so on, whatever the file is called, from the header alone; its
    suffix where it cannot be read."""
    try:
        return str(open_image(path).format_name()).upper()
    except ImageRefused:
        return path.suffix[1:].upper()


def is_eight_bit(path: Path) -> bool:
    """Whether the image holds bytes, from the header alone."""
    return str(open_image(path).spec().format) == "uint8"


def holds_whole_numbers(path: Path) -> bool:
    """Whether the image holds bytes or larger whole numbers, from the header alone."""
    return "int" in str(open_image(path).spec().format)


def write_exr(
    path: Path,
    pixels: Float,
    *,
    half: bool = True,
    holes: bool = False,
    encoding: str = "lin_rec709_scene",
) -> int:
    """Write finite pixels, (H, W) or (H, W, 1 | 3 | 4), as ZIP-compressed scene-linear colour.

    With ``holes`` NaN may stand for what is not known. Channels are named Y, RGB or RGBA. Values
    beyond +-65504 are clamped if ``half`` (as half floats they would be infinite); returns how
    many. The file appears whole or not at all.
    """
    image = np.atleast_3d(np.asarray(pixels, dtype=np.float32))
    names = _CHANNEL_NAMES.get(image.shape[2])
    if names is None or np.ndim(pixels) not in (2, 3) or not image.size:
        raise UsdBrdfError(f"{path}: {np.shape(pixels)=} is not (H, W[, 1|3|4]). [image.write]")
    bad = int(np.count_nonzero(np.isinf(image) if holes else ~np.isfinite(image)))
    if bad:
        raise UsdBrdfError(f"{path}: {bad} values to be written are not finite. [image.write]")
    stored: Any = np.clip(image, -HALF_MAX, HALF_MAX).astype(np.float16) if half else image
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], len(names), "half" if half else "float")
    spec.channelnames = names
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", _PINNED_DATE)
    spec.set_colorspace(encoding)
    if len(names) == 4:
        spec.alpha_channel = 3
    with temporary_beside(path) as staged:
        write_image(path, staged, spec, stored)
        refuse_other(path, staged, stored.astype(np.float32), holes=holes)
        publish(staged, path)
    return int(np.count_nonzero(np.abs(image) > HALF_MAX)) if half else 0


def needs_float(values: Float) -> bool:
    """Whether half floats would clamp any of the values, or round most of those that are not 0.

    Halves end at 65504 and lose digits below 2^-14: radiance in other units lies beyond either.
    NaN does not count.
    """
    size = np.abs(values)
    if (size > _HALF_UNTIL).any():
        return True
    some = size > 0
    return bool(np.count_nonzero(some & (size < _HALF_FROM)) * 2 > np.count_nonzero(some))


def resized(pixels: Float, width: int, height: int) -> Float:
    """(H, W, C) float32 pixels at another size, each the mean of what it covers."""
    image = np.ascontiguousarray(pixels, np.float32)
    source = oiio.ImageBuf(image)
    region = oiio.ROI(0, width, 0, height, 0, 1, 0, image.shape[2])
    target = oiio.ImageBufAlgo.resize(source, filtername="box", roi=region)
    if target.has_error:
        raise UsdBrdfError(f"{image.shape=}: resizing failed ({_message(target)}). [image.resize]")
    return np.asarray(target.get_pixels(oiio.FLOAT), np.float32).reshape(height, width, -1)


def write_preview_png(path: Path, rgb8: Byte) -> None:
    """Write an 8-bit sRGB picture, (H, W, 3) uint8, for people to look at; as JPEG where ``path``
    ends so."""
    spec = _spec_of_preview(path, rgb8)
    spec.attribute("DateTime", _PINNED_DATE)
    spec.set_colorspace("srgb_rec709_scene")
    with temporary_beside(path) as staged:
        write_image(path, staged, spec, np.ascontiguousarray(rgb8))
        if path.suffix.lower() in JPEG_SUFFIXES:
            _refuse_other_jpeg(path, staged, spec, rgb8)
        else:
            refuse_other(path, staged, rgb8)
        publish(staged, path)


def encoded_jpeg(rgb8: Byte, quality: int) -> bytes:
    """An 8-bit sRGB picture, (H, W, 3) uint8, as JPEG without any metadata, EXIF among them.

    quality  1 to 100
    """
    with scratch_folder() as folder:
        path = folder / "picture.jpg"
        spec = _spec_of_preview(path, rgb8)
        spec.attribute("Compression", f"jpeg:{quality}")
        write_image(path, path, spec, np.ascontiguousarray(rgb8))
        return jpeg_without_metadata(path.read_bytes())


def _spec_of_preview(path: Path, rgb8: Byte) -> Any:
    if rgb8.dtype != np.uint8 or rgb8.ndim != 3 or rgb8.shape[2] != 3 or not rgb8.size:
        raise UsdBrdfError(
            f"{path}: {rgb8.dtype} {rgb8.shape=} is not (H, W, 3) uint8. [image.write]"
        )
    return oiio.ImageSpec(rgb8.shape[1], rgb8.shape[0], 3, "uint8")


def open_image(path: Path, max_side: int = MAX_SIDE) -> Any:
    """An OpenImageIO reader on the image of a regular file whose header is within limits: the
    part that has its colours (see ``channels``), or the first if none has."""
    return _although_unread_once(path, lambda: _opened(path, max_side))


def _opened(path: Path, max_side: int) -> Any:
    if path.suffix.lower() in RAW_SUFFIXES:
        raise ImageRefused(
            f"{path}: camera raw files are not read here (only their preview would be). Let "
            "`usdbrdf develop-raw` make a capture of radiance of them. [image.raw]"
        )
    size = readable_size(path)
    if isinstance(size, str):
        raise ImageRefused(f"{path}: {size}. [image.unreadable]")
    if size == 0:
        raise ImageRefused(f"{path}: the file is empty. Copy or export it again. [image.truncated]")
    # Without the hint, PNG's colours would come multiplied by their alpha.
    hint = oiio.ImageSpec()
    hint.attribute("oiio:UnassociatedAlpha", 1)
    with _decoding(path, oiio, "not a readable image", "image.unreadable"):
        source = oiio.ImageInput.open(str(path), hint)
        if source is None:
            raise _Undecoded
        colours_of(source)  # at whose part it then is
    spec = source.spec()
    if source.format_name() not in _FORMATS or spec.deep or spec.full_depth > 1 or spec.depth > 1:
        raise ImageRefused(
            f"{path}: {source.format_name()} {'deep or volume ' if spec.deep else ''}images are "
            f"not read. Export a flat image ({', '.join(_FORMATS)}). [image.format]"
        )
    _check_limits(path, spec, size, max_side)
    return source


class _Undecoded(Exception):
    """The decoder gave nothing, or not what its header says."""


@contextmanager
def _decoding(path: Path, decoder: Any, problem: str, rule: str, making: int = 0) -> Iterator[None]:
    """ImageRefused for whatever the decoder stumbles over, in its own words: a damaged file can
    make it raise anything. But too little memory is no fault of the file.

    making  bytes that are to be made of the file; 0 of its header, which needs few: a decoder that
            wants more has been told a lie
    """
    try:
        yield
    except Exception as error:
        raise_shortage(error)
        said = _message(decoder)
        scarce = isinstance(error, MemoryError) or (making and _WANT_OF_MEMORY.search(said))
        try:
            # Twice: the decoder has buffers of its own.
            np.zeros(max(2 * making, _FOR_A_HEADER), np.uint8)
        except MemoryError:
            scarce = True
        if scarce:
            raise EnvironmentFailure(
                f"{path}: too little memory to read this image. Free some or use a larger "
                "machine, then run the same command again. [environment.memory]"
            ) from error
        raise ImageRefused(f"{path}: {problem} ({said}). Copy or export it again. [{rule}]") from (
            None if isinstance(error, _Undecoded) else error
        )


def _check_limits(path: Path, spec: Any, size: int, max_side: int) -> None:
    for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
        if max(width, height) > max_side or width * height > MAX_PIXELS or min(width, height) < 1:
            raise ImageRefused(
                f"{path}: {width} x {height} pixels, the limits are {max_side} a side and "
                f"{MAX_PIXELS} in all. Scale it down. [image.limits]"
            )
    pixel_bytes = 4 * spec.nchannels  # as the floats we would make of it
    declared = pixel_bytes * spec.width * spec.height
    shown = pixel_bytes * spec.full_width * spec.full_height
    if shown > MAX_UNKNOWN_BYTES and declared < (1 - MAX_UNKNOWN_SHARE) * shown:
        raise ImageRefused(
            f"{path}: {spec.width} x {spec.height} pixels are to stand in a display window of "
            f"{spec.full_width} x {spec.full_height}, which would be unknown but for "
            f"{declared / shown:.2g} of it. Crop it, or export all of it. [image.limits]"
        )
    inflation = declared / size
    if declared > MAX_DECLARED_BYTES or (declared > _ANY_INFLATION and inflation > MAX_INFLATION):
        raise ImageRefused(
            f"{path}: {size} bytes claim to hold {declared} ({inflation:.0f} times as many), the "
            f"limits are {MAX_DECLARED_BYTES} and {MAX_INFLATION} times. Export it again. "
            "[image.limits]"
        )


def pixels_of(path: Path, source: Any) -> Float:
    """The data window, (H, W, C) float32, complete."""
    if source.format_name() == "jpeg":
        # The decoder paints what is missing grey and only warns; look for the end mark. It is
        # searched after the first scan starts: a thumbnail in the header has one of its own.
        content = path.read_bytes()
        position = max((end for _, end in segments_of_jpeg(content)), default=2)
        if content.find(b"\xff\xd9", position) < 0:
            raise ImageRefused(
                f"{path}: truncated (no end-of-image mark). Copy or export it again. "
                "[image.truncated]"
            )
    spec = source.spec()
    shape = (spec.height, spec.width, spec.nchannels)
    with _decoding(
        path, source, "truncated or damaged", "image.truncated", making=4 * math.prod(shape)
    ):
        part = source.current_subimage()
        pixels = source.read_image(part, 0, 0, spec.nchannels, "float")
        if pixels is None or source.has_error or pixels.shape != shape:
            raise _Undecoded
    return np.asarray(pixels, dtype=np.float32)


def _in_display_window(spec: Any, data: Float) -> Float:
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    if (left, top, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return data
    image = np.full((spec.full_height, spec.full_width, data.shape[2]), np.nan, dtype=np.float32)
    right, bottom = left + spec.width, top + spec.height
    part = data[max(0, -top) : spec.full_height - top, max(0, -left) : spec.full_width - left]
    image[max(0, top) : max(0, bottom), max(0, left) : max(0, right)] = part
    return image


def write_image(path: Path, staged: Path, spec: Any, pixels: Any) -> None:
    output = oiio.ImageOutput.create(str(staged))
    done = output is not None and output.open(str(staged), spec) and output.write_image(pixels)
    message = "" if done else _message(output or oiio)
    # close() says True after a failed write, so it can only add a failure, never take one back.
    if not (output is not None and output.close() and done):
        raise EnvironmentFailure(
            f"{path}: cannot be written ({message or 'closing failed'}). "
            f"{cure_of_writing(staged)}, then run the same command again. [image.write]"
        )


def refuse_other(path: Path, staged: Path, pixels: Float | Byte, *, holes: bool = False) -> None:
    """EnvironmentFailure unless these are the pixels of the file that was written, and all of it
    was: closing it says nothing of a full disk.

    holes  NaN is compared too; else it stands for any value
    """
    try:
        stored = pixels_of(staged, open_image(staged))
        if pixels.dtype == np.uint8:
            stored = np.rint(stored * 255)
        if stored.shape == pixels.shape:
            unasked = np.isnan(pixels) & np.isnan(stored) if holes else ~np.isfinite(pixels)
            if ((stored == pixels) | unasked).all() and lists_its_chunks(staged):
                return
        cause = None
    except ImageRefused as error:
        cause = error
    raise _not_as_written(path) from cause


def _refuse_other_jpeg(path: Path, staged: Path, spec: Any, rgb8: Byte) -> None:
    """The same of a JPEG, which reads back as other pixels: it is written once more elsewhere."""
    with scratch_folder(path) as folder:
        write_image(path, again := folder / staged.name, spec, np.ascontiguousarray(rgb8))
        content = staged.read_bytes()
        if content != again.read_bytes() or not content.endswith(END):
            raise _not_as_written(path)


def _not_as_written(path: Path) -> EnvironmentFailure:
    return EnvironmentFailure(
        f"{path}: the file does not read back as it was written. Free disk space or check the "
        "disk, then run the same command again. [image.write]"
    )


def _message(speaker: Any) -> str:
    """OpenImageIO's own words, in one line; damaged files can make them invalid UTF-8."""
    try:
        return " ".join(str(speaker.geterror()).split())[:300] or "no reason given"
    except Exception:
        return "no readable reason given"
