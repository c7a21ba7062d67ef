"""Albedo for the stage: known where light was seen, filled in elsewhere."""

from __future__ import annotations

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.texels import Texels
from usdbrdf.shading.albedo import albedo_from_irradiance
from usdbrdf.texturing.inpaint import inpaint

NEUTRAL = calibration.number("albedo.unseen")

_DARK = calibration.number("albedo.dark")


def albedo_map(
    texels: Texels, radiance: Float, irradiance: Float, seen: Bool, emissive: Bool
) -> tuple[Float, float]:
    """(albedo (T, 3) in [0, 1], share of the seen, non-emissive texels over 1).

    radiance, irradiance (T, 3); seen (T,): a frame shows the texel; emissive (T,): it shines by
    itself, and its albedo is 0.
    """
    floor = _DARK * float(np.median(irradiance.mean(axis=1)))
    albedo, lit_enough = albedo_from_irradiance(radiance, irradiance, max(floor, 1e-9))
    reflects = seen & ~emissive
    over = (albedo > 1).any(axis=1) & reflects & lit_enough
    albedo = inpaint(texels, np.clip(albedo, 0, 1), reflects & lit_enough)
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        if not seen[own].any():
            albedo[own] = NEUTRAL
    albedo[emissive] = 0
    return albedo, float(over.sum() / max(reflects.sum(), 1))
