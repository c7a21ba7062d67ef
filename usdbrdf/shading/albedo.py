"""Albedo from radiance and irradiance."""

from __future__ import annotations

import numpy as np

from usdbrdf.model.arrays import Bool, Float


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
