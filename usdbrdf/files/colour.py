"""Colour spaces by their OpenColorIO names; the only importer of PyOpenColorIO."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import PyOpenColorIO as ocio

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.model.arrays import Float

WORKING_SPACE = "lin_rec709_scene"
DISPLAY_SPACE = "srgb_rec709_scene"
ACESCG = "lin_ap1_scene"
DATA = "data"  # numbers that are no colours
_CONFIG = "studio-config-v5.0.0_aces-v2.1_ocio-v2.6"  # pinned: another config is another picture
_KIND_OF_CONFIG = "studio-config-v"
# How OpenColorIO calls what a space's values are.
_KINDS: dict[str, Literal["linear", "log", "display"]] = {
    "scene-linear": "linear",
    "log": "log",
    "sdr-video": "display",
}
# Our names, and what configs older than the pinned one call the same space.
_NAMES = {
    "lin_ap0_scene": ("lin_ap0_scene", "lin_ap0"),
    "lin_ap1_scene": ("lin_ap1_scene", "lin_ap1"),
    "lin_p3d65_scene": ("lin_p3d65_scene", "lin_p3d65"),
    "lin_rec2020_scene": ("lin_rec2020_scene", "lin_rec2020"),
    "lin_rec709_scene": ("lin_rec709_scene", "lin_rec709_srgb", "lin_rec709"),
    "srgb_rec709_scene": ("srgb_rec709_scene", "srgb_tx"),
}
# x, y of red, green, blue and white (Adobe RGB (1998), SMPTE ST 2065-1, Academy S-2014-004, ITU-R
# BT.709 and BT.2020, SMPTE EG 432-1), and by how much numbers in files are off.
_CHROMATICITIES = {
    "lin_adobergb_scene": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767),
    "lin_p3d65_scene": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
    "lin_rec2020_scene": (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),
    "lin_rec709_scene": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329),
}
_SAME_PLACE = 2e-3
# What ICC profiles of photographs call themselves, in lower case; the short ones are those that
# services put into pictures to save bytes.
_PROFILES = {
    "adobe rgb (1998)": "g22_adobergb_scene",
    "adobergb1998": "g22_adobergb_scene",
    "compatible with adobe rgb (1998)": "g22_adobergb_scene",
    "c2": "srgb_rec709_scene",
    "c2ci": "srgb_rec709_scene",
    "display p3": "srgb_p3d65_scene",
    "sp3": "srgb_p3d65_scene",
    "sp3c": "srgb_p3d65_scene",
}
_LINEAR_OF = {"srgb_p3d65_scene": "lin_p3d65_scene", "g22_adobergb_scene": "lin_adobergb_scene"}
# Those of Android, GIMP, Ghostscript and others; not of linear values with the same primaries, nor
# of other primaries whose values have sRGB's curve.
_CALLED_SRGB = re.compile(
    r"(?!.*(linear|(?<![a-z])lin(?![a-z])|\bg10\b|gamma 1\.0))"
    r"(?!.*(p3|2020|adobe|prophoto|wide|\bap[01]\b|aces))"
    r".*\bsrgb(?![ _-]*(trc|curve|gamma|tone|transfer))"
)
_GENERIC_LINEAR = re.compile(r"(?i)(scene[ _-]?)?lin(ear)?|raw|data|unknown|none")
_UNKNOWN_SHOWN_AS = (255, 0, 255)
# Pictures are exposed so that this percentile comes out as this linear value.
_SHOWN_PERCENTILE, _SHOWN_AS = 90, 0.8


def known_encodings() -> tuple[str, ...]:
    """The names for spaces of images that are asked for most; ``kind_of_encoding`` knows more."""
    return tuple(sorted(_NAMES))


@cache
def kind_of_encoding(encoding: str) -> Literal["linear", "log", "display"] | None:
    """What the values of a colour space are, by its OpenColorIO name: proportional to radiance, a
    camera's or ACES' logarithm of it, or made for a display as photographs are. None where
    OpenColorIO's studio configuration has no such space of scenes."""
    if encoding in _NAMES:
        return "display" if encoding == DISPLAY_SPACE else "linear"
    space = _config().getColorSpace(encoding)
    if space is None or space.getReferenceSpaceType() != ocio.REFERENCE_SPACE_SCENE:
        return None
    return _KINDS.get(space.getEncoding())


def encoding_of_tag(name: str, chromaticities: tuple[float, ...]) -> str | None:
    """The colour space that an image says it has, see ``files.images.colour_tag``; None where it
    says nothing that is known."""
    profile = name.lower().strip()
    if kind_of_encoding(_PROFILES.get(profile, "")):
        return _PROFILES[profile]
    if name and kind_of_encoding(name):
        return name
    if _CALLED_SRGB.match(profile):
        return DISPLAY_SPACE
    return space_of_primaries(chromaticities) if chromaticities else None


def space_of_primaries(chromaticities: tuple[float, ...]) -> str | None:
    """The scene-linear space of x, y of red, green, blue and white; None of others."""
    for encoding, places in _CHROMATICITIES.items():
        close = np.abs(np.subtract(places, chromaticities)).max() < _SAME_PLACE
        if close and kind_of_encoding(encoding):
            return encoding
    return None


def says_light(name: str) -> bool:
    """Whether a name says no more than that values are light, or nothing."""
    return _GENERIC_LINEAR.fullmatch(name.strip()) is not None


def unknown_encoding(encoding: str) -> str:
    """A sentence that tells of the names which are most alike."""
    spaces = list(_config().getColorSpaces())
    known = [name for s in spaces for name in (s.getName(), *s.getAliases())]
    usable = [name for name in known if kind_of_encoding(name)]
    of = {name.lower(): name for name in usable}
    near = [of[name] for name in get_close_matches(encoding.lower(), of, n=3, cutoff=0.5)]
    like = f" Alike are {', '.join(map(repr, near))}." if near else ""
    return f"colour space {encoding!r} is not known.{like}"


def linear_space_of(encoding: str) -> str:
    """The scene-linear space in which values of ``encoding`` are judged, and clip: their own if
    they are linear, and of Display P3 and Adobe RGB, whose colours beyond Rec.709 are negative
    there; else the working space."""
    if kind_of_encoding(encoding) == "linear":
        return encoding
    return _LINEAR_OF.get(encoding, WORKING_SPACE)


def to_linear(pixels: Float, encoding: str) -> Float:
    """A copy of (H, W, 3) float32 pixels in ``linear_space_of`` their encoding."""
    return _converted(pixels, encoding, linear_space_of(encoding))


def to_working_space(pixels: Float, encoding: str) -> Float:
    """A copy of (H, W, 3) float32 pixels as linear Rec.709; negative and large values pass."""
    if kind_of_encoding(encoding) is None:
        raise InputRefused(
            f"{unknown_encoding(encoding)} Use one of {', '.join(known_encodings())}, or another "
            "of OpenColorIO's studio configuration. [colour.encoding]"
        )
    return _converted(pixels, encoding, WORKING_SPACE)


def from_working_space(pixels: Float, encoding: str) -> Float:
    """A copy of (H, W, 3) float32 pixels of linear Rec.709 in another scene-linear space."""
    return _converted(pixels, WORKING_SPACE, encoding)


def linear_spaces() -> tuple[str, ...]:
    """The scene-linear spaces that files are known to have by their primaries."""
    return tuple(_CHROMATICITIES)


def chromaticities_of(encoding: str) -> tuple[float, ...]:
    """x, y of red, green, blue and white of a scene-linear space of ours."""
    return _CHROMATICITIES[encoding]


def to_display_srgb8(pixels: Float, *, exposure_scale: float) -> npt.NDArray[np.uint8]:
    """sRGB bytes, (H, W, 3) uint8, of linear Rec.709 radiance times ``exposure_scale``.

    A pixel with NaN is unknown and comes out magenta, for black would be a claim.
    """
    unknown = np.any(np.isnan(pixels), axis=2, keepdims=True)
    known = np.where(unknown, np.float32(0), pixels)
    encoded = to_display_srgb(known, exposure_scale=exposure_scale)
    bytes_ = (encoded * 255 + 0.5).astype(np.uint8)
    return np.where(unknown, np.array(_UNKNOWN_SHOWN_AS, dtype=np.uint8), bytes_)


def to_display_srgb(pixels: Float, *, exposure_scale: float) -> Float:
    """sRGB values in [0, 1], (H, W, 3) float32, of linear Rec.709 radiance times the scale."""
    scaled = np.clip(pixels * np.float32(exposure_scale), 0, 1).astype(np.float32)
    return np.asarray(np.clip(_converted(scaled, WORKING_SPACE, DISPLAY_SPACE), 0, 1))


def display_exposure(levels: Float) -> float:
    """The factor that shows the 90th percentile of ``levels`` (P,), means of R, G and B of linear
    radiance, as 0.8 of white; 1 where there is no light."""
    bright = float(np.percentile(levels, _SHOWN_PERCENTILE)) if len(levels) else 0.0
    return _SHOWN_AS / bright if bright > 0 else 1.0


def _converted(pixels: Float, source: str, target: str) -> Float:
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise UsdBrdfError(f"{pixels.shape=} but expected (H, W, 3). [colour.shape]")
    image = np.array(pixels, dtype=np.float32, order="C")
    if source != target and image.size:
        _processor(source, target).applyRGB(image)
    return image


@cache
def _processor(source: str, target: str) -> Any:
    config, names = _config(), []
    for encoding in (source, target):
        called = _NAMES.get(encoding, (encoding,))
        known = [name for name in called if config.getColorSpace(name) is not None]
        if not known:
            raise InputRefused(
                f"colour space {encoding!r} is not in this OpenColorIO ({ocio.__version__}). "
                "Install 2.5 or newer. [colour.encoding]"
            )
        names.append(known[0])
    # Lossless, because the default replaces the power function by a fast approximation.
    processor = config.getProcessor(*names)
    return processor.getOptimizedCPUProcessor(ocio.OPTIMIZATION_LOSSLESS)


@cache
def _config() -> Any:
    built_in = ocio.BuiltinConfigRegistry().getBuiltinConfigs()
    return ocio.Config.CreateFromBuiltinConfig(_pick_config([entry[0] for entry in built_in]))


def _pick_config(available: list[str]) -> str:
    """The pinned configuration, or in an older OpenColorIO the newest one of its kind."""
    if _CONFIG in available:
        return _CONFIG
    kind = [name for name in available if name.startswith(_KIND_OF_CONFIG)]
    return max(kind, key=lambda name: [int(number) for number in re.findall(r"\d+", name)])
