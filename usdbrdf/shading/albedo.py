"""Albedo from radiance and irradiance: known where light was measured, filled in elsewhere."""

from __future__ import annotations

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.inpaint import inpaint

NEUTRAL = calibration.number("albedo.unseen")
_DARK = calibration.number("albedo.dark")
_TINY = float(np.finfo(np.float32).tiny)


def albedo_from_irradiance(
    diffuse_radiance: Float, irradiance: Float, floor: float
) -> tuple[Float, Bool]:
    """Lambertian albedo of each texel, rho = pi L_d / S (paper, section 3.3).

    diffuse_radiance (T, 3) float32, L_d, scene-linear; irradiance (T, 3) float32, S, W/m^2;
    floor: S below it is unknown, not dark. Returns rho (T, 3) float32, not clipped and 0 where
    unknown, and known (T,) bool.
    """
    known: Bool = np.all(irradiance > floor, axis=1)
    rho = np.where(known[:, None], np.pi * diffuse_radiance / np.maximum(irradiance, floor), 0)
    return rho.astype(np.float32), known


def albedo_map(
    texels: Texels, radiance: Float, irradiance: Float, known: Bool, emissive: Bool
) -> tuple[Float, float]:
    """(albedo (T, 3) in [0, 1], share of the known, non-emissive texels over 1).

    radiance, irradiance (T, 3); known (T,): the texel's radiance is not filled in, and its albedo
    need not be; emissive (T,): it shines by itself, and its albedo is 0. Objects of which nothing
    is known are NEUTRAL.
    """
    floor = _DARK * float(np.median(irradiance.mean(axis=1)))
    albedo, lit_enough = albedo_from_irradiance(radiance, irradiance, max(floor, _TINY))
    reflects = known & ~emissive
    over = (albedo > 1).any(axis=1) & reflects & lit_enough
    albedo = inpaint(texels, np.clip(albedo, 0, 1), reflects & lit_enough)
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        if not known[own].any():
            albedo[own] = NEUTRAL
    albedo[emissive] = 0
    return albedo, float(over.sum() / max(reflects.sum(), 1))
