"""The light that comes from outside the scan: a latitude-longitude HDR picture, and the sun.

The sun is apart: some pixels of a picture would be a thousand times as bright as all others, and
rays that do not look for it would hardly ever find it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, encoding_of_tag, kind_of_encoding, to_working_space
from usdbrdf.files.images import colour_tag
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.untrusted.pictures import picture_from_file

# What these files hold is radiance even where all of it happens to be 0 or 1.
_HDR_SUFFIXES = (".exr", ".hdr")
# Of the sun as the Earth sees it, radians.
SUN_HALF_ANGLE = 0.00465


class Sun(NamedTuple):
    """A disc in the sky: direction (3,) float64, unit, towards it; irradiance (3,) float64, W/m^2,
    on a surface that faces it, 0 where there is none; half_angle of the disc, radians."""

    direction: Double
    irradiance: Double
    half_angle: float = SUN_HALF_ANGLE

    @property
    def shines(self) -> bool:
        return bool(self.irradiance.any())


NO_SUN = Sun(np.array([0.0, 0.0, 1.0]), np.zeros(3))


class Environment(NamedTuple):
    """Radiance of the far surroundings.

    image   (H, W, 3) float32; OpenEXR's and UsdLux's latitude-longitude layout: the top row is the
            pole of the up axis, the middle column looks along +z of a y-up world
    z_up    True if the world's up axis is z; the picture is then turned by 90 degrees about x
    sun_direction, sun_irradiance, sun_half_angle  the ``sun``, which the picture does not show;
            kernels take no tuples in tuples
    """

    image: Float
    z_up: bool
    sun_direction: Double = NO_SUN.direction
    sun_irradiance: Double = NO_SUN.irradiance
    sun_half_angle: float = NO_SUN.half_angle

    @property
    def sun(self) -> Sun:
        return Sun(self.sun_direction, self.sun_irradiance, self.sun_half_angle)

    def under(self, sun: Sun) -> Environment:
        """The same with another sun."""
        return Environment(self.image, self.z_up, *sun)


def black_environment() -> Environment:
    return Environment(image=np.zeros((1, 1, 3), np.float32), z_up=False)


def directions_of_pixels(height: int, width: int, z_up: bool) -> Double:
    """(H, W, 3) unit, world: where the pixels of a picture of the surroundings look."""
    elevation = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
    azimuth = (0.5 - (np.arange(width)[None] + 0.5) / width) * 2 * np.pi
    right, ahead = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
    up = np.broadcast_to(np.sin(elevation), right.shape)
    return np.stack([right, -ahead, up] if z_up else [right, up, ahead], axis=-1)


def pixels_of_directions(directions: Float, height: int, width: int, z_up: bool) -> Long:
    """(R,) flat indices of the pixels that unit directions (R, 3) fall into."""
    x, y, z = directions.T.astype(np.float64)
    up, ahead = (z, -y) if z_up else (y, z)
    row = ((0.5 - np.arcsin(np.clip(up, -1, 1)) / np.pi) * height).astype(np.int64)
    column = ((0.5 - np.arctan2(x, ahead) / (2 * np.pi)) * width).astype(np.int64)
    place = np.minimum(row, height - 1) * width + np.clip(column, 0, width - 1)
    return np.asarray(place, np.int64)


def radiance_from(environment: Environment, directions: Float) -> Float:
    """(R, 3) W/(m^2 sr): of the picture, without the sun, in each direction (R, 3)."""
    picture = environment.image
    height, width = picture.shape[:2]
    where = pixels_of_directions(directions, height, width, environment.z_up)
    found: Float = picture.reshape(-1, 3)[where]
    return found


def solid_angles(height: int, width: int) -> Double:
    """(H,) steradians of a pixel in each row."""
    edges = np.sin((0.5 - np.arange(height + 1) / height) * np.pi)
    return np.asarray((edges[:-1] - edges[1:]) * 2 * np.pi / width)


def mean_radiance(image: Float) -> float:
    """Of all directions and channels of a picture (H, W, 3) of them."""
    rows = image.mean(axis=(1, 2))
    return float(np.average(rows, weights=solid_angles(*image.shape[:2])))


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
    return with_sun_apart(in_working_space(image, picture), up_axis == "Z")


def in_working_space(image: Float, picture: Path) -> Float:
    """The pixels of a picture of light by the primaries that its header states; the working space's
    where it states none that are known. Colours that this space lacks lose what is negative."""
    tag = encoding_of_tag(*colour_tag(picture))
    if tag is None or tag == WORKING_SPACE or kind_of_encoding(tag) != "linear":
        return image
    return np.maximum(to_working_space(image, tag), np.float32(0))


def unknown_primaries(picture: Path) -> str:
    """A sentence for the user where a picture of light states primaries that are not known, for
    which ``in_working_space`` takes its own; else ""."""
    name, places = colour_tag(picture)
    if not places or encoding_of_tag(name, places) is not None:
        return ""
    said = ", ".join(f"{place:.4g}" for place in places)
    return (
        f"{picture.name}: the header says that its primaries and white are {said}, which are not "
        f"read here: they pass for {WORKING_SPACE}. Convert the picture. [light.primaries]"
    )


# Radians around the brightest pixel in which a sun lies, and in which the sky beside it is looked
# at; how much brighter than that its pixels are, and the least share of all light that it sends.
_REACH, _BESIDE, _BRIGHTER, _LEAST_SHARE = 0.06, 0.12, 10.0, 0.02


def with_sun_apart(image: Float, z_up: bool) -> Environment:
    """A picture's light, its sun apart: the bright pixels around the brightest one, if they are few
    and send much of all its light."""
    height, width, _ = image.shape
    directions = directions_of_pixels(height, width, z_up)
    weight = np.repeat(solid_angles(height, width)[:, None], width, axis=1)
    level = image.mean(axis=2)
    peak = directions.reshape(-1, 3)[int(level.argmax())]
    cosine = directions @ peak
    near, beside = cosine > np.cos(_REACH), (cosine > np.cos(_BESIDE)) & (cosine < np.cos(_REACH))
    if not beside.any():
        return Environment(image=image, z_up=z_up)
    around = np.median(image[beside], axis=0)
    disc = near & (level > _BRIGHTER * around.mean())
    over = np.maximum(image[disc] - around, 0) * weight[disc][:, None]
    if over.sum() <= _LEAST_SHARE * float((image * weight[..., None]).sum()):
        return Environment(image=image, z_up=z_up)
    towards = over.mean(axis=1) @ directions[disc]
    rest = image.copy()
    rest[disc] = np.minimum(image[disc], around)
    half_angle = float(np.sqrt(weight[disc].sum() / np.pi))
    sun = Sun(towards / np.linalg.norm(towards), over.sum(axis=0).astype(np.float64), half_angle)
    return Environment(rest, z_up).under(sun)


def _holds_integers(image: Float) -> bool:
    """True if all values are k / 65535, which k / 255 is too: what integer files are read as."""
    levels = image * np.float64(65535)
    return bool(image.max() <= 1 and (np.abs(levels - np.round(levels)) < 0.01).all())
