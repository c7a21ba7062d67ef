"""The light that comes from outside the scan: black, or a latitude-longitude HDR picture."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, to_working_space
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Float
from usdbrdf.untrusted.pictures import picture_from_file

# What these files hold is radiance even where all of it happens to be 0 or 1.
_HDR_SUFFIXES = (".exr", ".hdr")


class Environment(NamedTuple):
    """Radiance of the far surroundings.

    image   (H, W, 3) float32; OpenEXR's and UsdLux's latitude-longitude layout: the top row is the
            pole of the up axis, the middle column looks along +z of a y-up world
    z_up    True if the world's up axis is z; the picture is then turned by 90 degrees about x
    """

    image: Float
    z_up: bool


def black_environment() -> Environment:
    return Environment(image=np.zeros((1, 1, 3), np.float32), z_up=False)


@kernel
def environment_at(environment: Environment, x: float, y: float, z: float, channel: int) -> float:
    """Radiance from the unit direction (x, y, z); nearest pixel; for use inside kernels."""
    image, z_up = environment.image, environment.z_up
    height, width, _ = image.shape
    up = z if z_up else y
    ahead = -y if z_up else z
    row = int((0.5 - np.arcsin(min(1.0, max(-1.0, up))) / np.pi) * height)
    column = int((0.5 - np.arctan2(x, ahead) / (2 * np.pi)) * width)
    value: float = image[min(row, height - 1), min(max(column, 0), width - 1), channel]
    return value


def environment_from_file(picture: Path | None, up_axis: str) -> Environment:
    """A latitude-longitude HDR picture in the working space, or black for None."""
    if picture is None:
        return black_environment()
    image = picture_from_file(picture)
    for wrong, what in (
        (~np.isfinite(image), "infinite, NaN or missing, so the light from there is unknown"),
        (image < 0, "negative, which no light is"),
    ):
        if number := int(np.count_nonzero(wrong.any(axis=2))):
            raise InputRefused(
                f"{picture}: {number} pixels are {what}; repair the picture given as "
                "--environment. [shading.environment]"
            )
    if picture.suffix.lower() not in _HDR_SUFFIXES and _holds_integers(image):
        raise InputRefused(
            f"{picture}: an 8- or 16-bit picture ends at white and holds no radiance; give an "
            "OpenEXR or Radiance HDR file as --environment. [shading.environment]"
        )
    return Environment(image=to_working_space(image, WORKING_SPACE), z_up=up_axis == "Z")


def _holds_integers(image: Float) -> bool:
    """True if all values are k / 65535, which k / 255 is too: what integer files are read as."""
    levels = image * np.float64(65535)
    return bool(image.max() <= 1 and (np.abs(levels - np.round(levels)) < 0.01).all())
