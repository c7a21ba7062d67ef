"""The light from outside the scan, as the user names it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, to_working_space
from usdbrdf.model.arrays import Float
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.untrusted.pictures import picture_from_file

# What these files hold is radiance even where all of it happens to be 0 or 1.
_HDR_SUFFIXES = (".exr", ".hdr")


def environment_from_file(picture: Path | None, up_axis: str) -> Environment:
    """A latitude-longitude HDR picture in the working space, or black for None."""
    if picture is None:
        return black_environment()
    image = picture_from_file(picture)
    _refuse_what_is_not_light(picture, image)
    image = to_working_space(image, WORKING_SPACE)
    return Environment(image=image, z_up=up_axis == "Z")


def _refuse_what_is_not_light(picture: Path, image: Float) -> None:
    unknown = int(np.count_nonzero(~np.isfinite(image).all(axis=2)))
    if unknown:
        raise InputRefused(
            f"{picture}: {unknown} pixels are infinite, NaN or missing, so the light from there is "
            "unknown; repair the picture given as --environment. [shading.environment]"
        )
    negative = int(np.count_nonzero((image < 0).any(axis=2)))
    if negative:
        raise InputRefused(
            f"{picture}: {negative} pixels are negative, which no light is; repair the picture "
            "given as --environment. [shading.environment]"
        )
    if picture.suffix.lower() not in _HDR_SUFFIXES and _holds_integers(image):
        raise InputRefused(
            f"{picture}: an 8- or 16-bit picture ends at white and holds no radiance; give an "
            "OpenEXR or Radiance HDR file as --environment. [shading.environment]"
        )


def _holds_integers(image: Float) -> bool:
    """True if all values are k / 65535, which k / 255 is too: what integer files are read as."""
    levels = image * np.float64(65535)
    return bool(image.max() <= 1 and (np.abs(levels - np.round(levels)) < 0.01).all())
