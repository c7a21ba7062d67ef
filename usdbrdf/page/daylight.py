"""The light from outside as the page's room in three dimensions shows it: the sky behind what is
open, a sun with its shadows, and how much light each brings into the room."""

from __future__ import annotations

from typing import Any

import numpy as np

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import light_from_outside
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.model.material import turned_up
from usdbrdf.options import ESTIMATE, Surroundings
from usdbrdf.page.pictures import data_uri
from usdbrdf.shading.asked import looked_around
from usdbrdf.transport.environment import Environment, mean_radiance, pixels_of_directions
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.sunlight import sunlight

# How many points are asked what reaches them from outside, by how many rays each.
_POINTS, _RAYS, _SEED = 4096, 64, 0x0DA1
# Pixels across the picture of the sky.
_ACROSS = 512
# What brings a smaller share of the room's usual light is the dark, as of a night.
_DARK = 1e-3


def daylight(
    atlas: AssetMaps, lit: LitScene, asked: Surroundings, up_axis: str, exposure: float
) -> dict[str, Any] | None:
    """Of the surroundings of ``lit``, which were ``asked`` for; None where they are dark, see
    ``is_dark``.

    estimated  False where a file told them
    sky, sun   None where it is dark; ``direct`` is the irradiance that it brings, without what
               surfaces send on, the mean over all surfaces, in the asset's units, and ``error``
               relative, None where nobody knows it
    picture    of the sky, around the y axis as three.js has it: its middle column looks along +x
    direction  unit, towards the sun, y up; with the irradiance where it shines
    """
    environment = lit.environment
    if is_dark(environment, atlas):
        return None
    found = light_from_outside(atlas.stage) if asked == ESTIMATE else None
    estimated = found is not None and found[0].source == "estimated"
    errors = {"sky": 0.0, "sun": 0.0}
    if found is not None:
        errors = {"sky": found[0].sky_error, "sun": found[0].sun_error}
    error = {name: round(e, 4) if estimated and e > 0 else None for name, e in errors.items()}
    index = _points_evenly(lit)
    turn = turned_up(up_axis, "Y")[:3, :3]
    told: dict[str, Any] = {"estimated": estimated, "sky": None, "sun": None}
    if environment.image.any():
        picture = to_display_srgb8(_around(environment, turn), exposure_scale=exposure)
        direct = _numbers(_from_sky(lit, index))
        told["sky"] = {"picture": data_uri(picture), "direct": direct, "error": error["sky"]}
    if environment.sun.shines:
        told["sun"] = {
            "direction": [round(float(x), 6) for x in turn @ environment.sun.direction],
            "irradiance": _numbers(environment.sun.irradiance),
            "direct": _numbers(sunlight(lit, index, environment.sun, _SEED).mean(axis=0)),
            "error": error["sun"],
        }
    return told


def is_dark(environment: Environment, atlas: AssetMaps) -> bool:
    """Whether next to nothing comes from outside, as by night, though photographs show something
    there."""
    if environment.sun.shines:
        return False
    usual = float(np.median(atlas.irradiance)) if atlas.has("irradiance") else 0.0
    return bool(np.pi * mean_radiance(environment.image) <= _DARK * usual)


def area_of(lit: LitScene) -> float:
    """Square metres of all surfaces that are textured."""
    return float(lit.texels.area[lit.texels.interior].sum())


def _points_evenly(lit: LitScene) -> Long:
    """Texels of equal steps of the summed area."""
    summed = np.cumsum(np.where(lit.texels.interior, lit.texels.area, 0).astype(np.float64))
    steps = summed[-1] * (np.arange(_POINTS) + 0.5) / _POINTS
    index = np.minimum(np.searchsorted(summed, steps), len(summed) - 1)
    return np.asarray(index, np.int64)


def _from_sky(lit: LitScene, index: Long) -> Double:
    """(3,) W/m^2, the mean over texels ``index``."""
    environment = lit.environment
    towards, face = looked_around(lit, index, _SEED, _RAYS)
    out = face < 0
    height, width, _ = environment.image.shape
    pixel = pixels_of_directions(towards[out], height, width, environment.z_up)
    arriving = environment.image.reshape(-1, 3)[pixel].sum(axis=0, dtype=np.float64)
    return np.asarray(np.pi * arriving / len(towards))


def _around(environment: Environment, turn: Double) -> Float:
    """(H, W, 3) radiance as three.js looks it up: azimuth grows with the column, from +x to +z."""
    height, width = _ACROSS // 2, _ACROSS
    elevation = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
    azimuth = ((np.arange(width)[None] + 0.5) / width - 0.5) * 2 * np.pi
    up = np.broadcast_to(np.sin(elevation), (height, width))
    across = np.cos(elevation)
    looks = np.stack([across * np.cos(azimuth), up, across * np.sin(azimuth)], axis=-1) @ turn
    rows, columns, _ = environment.image.shape
    towards = looks.reshape(-1, 3).astype(np.float32)
    pixel = pixels_of_directions(towards, rows, columns, environment.z_up)
    return environment.image.reshape(-1, 3)[pixel].reshape(height, width, 3)


def _numbers(values: Double | Float) -> list[float]:
    return [float(f"{float(value):.6g}") for value in values]
