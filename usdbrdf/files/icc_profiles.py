"""The colour space of an ICC profile by its numbers; what it calls itself may be in any language,
and programs read the numbers alone."""

from __future__ import annotations

import struct
from functools import cache

import numpy as np

from usdbrdf.files.colour import chromaticities_of, linear_spaces
from usdbrdf.model.arrays import Double

# The primaries' and the curve's names of the spaces that photographs have, and those of light.
_SPACES = {
    "srgb_rec709_scene": ("lin_rec709_scene", "srgb"),
    "srgb_p3d65_scene": ("lin_p3d65_scene", "srgb"),
    "g22_adobergb_scene": ("lin_adobergb_scene", "adobe"),
    **{space: (space, "linear") for space in linear_spaces()},
}
# XYZ of the white of all profiles, D50, and Bradford's matrix, by which others come to it (ICC.1).
_D50 = (0.9642, 1.0, 0.8249)
_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))
# By how much profiles of one space differ in XYZ, and in linear values of their curves, which some
# hold as short tables; a plain 2.2 is nearly three times as far from sRGB's.
_SAME_PLACE, _SAME_VALUE = 3e-3, 3e-3
_MOST_TAGS = 100
_CODES = np.linspace(0.0, 1.0, 33)


def space_of_profile(profile: bytes) -> str:
    """The OpenColorIO name of a profile of three primaries and their curves; "" of any other."""
    if profile[16:24] != b"RGB XYZ ":
        return ""
    try:
        tags = _tags(profile)
        places = np.array([struct.unpack_from(">3i", tags[b"%cXYZ" % c], 8) for c in b"rgb"])
        with np.errstate(all="ignore"):
            curves = np.array([_curve(tags[b"%cTRC" % c]) for c in b"rgb"])
    except (KeyError, ValueError, struct.error):
        return ""
    for space, (primaries, curve) in _SPACES.items():
        far = np.abs(places / 65536 - _columns(primaries)).max()
        if far < _SAME_PLACE and np.abs(curves - _known_curve(curve)).max() < _SAME_VALUE:
            return space
    return ""


def _tags(profile: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", profile, 128)
    entries = [
        struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(count)[:_MOST_TAGS]
    ]
    return {name: profile[start : start + length] for name, start, length in entries}


def _curve(tag: bytes) -> Double:
    """Linear values of ``_CODES``; ValueError of a curve of no kind that photographs have."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        table = np.frombuffer(tag, ">u2", offset=12, count=count) if count else np.zeros(0)
        if count < 2:
            return np.asarray(_CODES ** (table[0] / 256 if count else 1.0))
        return np.interp(_CODES, np.linspace(0, 1, count), table / 65535)
    kind, gamma = struct.unpack_from(">Hxxi", tag, 8)
    if tag[:4] == b"para" and kind == 0:
        return np.asarray(_CODES ** (gamma / 65536))
    if tag[:4] == b"para" and kind == 3:
        a, b, c, d = (number / 65536 for number in struct.unpack_from(">4i", tag, 16))
        power = np.maximum(a * _CODES + b, 0) ** (gamma / 65536)
        return np.asarray(np.where(d <= _CODES, power, c * _CODES))
    raise ValueError(tag[:4])


def _known_curve(name: str) -> Double:
    if name == "linear":
        return _CODES
    if name == "adobe":
        return np.asarray(_CODES ** (563 / 256))
    return np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4)


@cache
def _columns(primaries: str) -> Double:
    """(3, 3) XYZ of red, green and blue in a profile, a row each."""
    x, y = np.reshape(chromaticities_of(primaries), (4, 2)).T
    colours = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    of_rgb = colours[:, :3] * np.linalg.solve(colours[:, :3], colours[:, 3])
    cones = np.array(_BRADFORD)
    scale = (cones @ _D50) / (cones @ colours[:, 3])
    return np.asarray((np.linalg.inv(cones) @ (scale[:, None] * cones) @ of_rgb).T)
