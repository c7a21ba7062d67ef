"""How much stronger a common GGX lobe is than the fitted one, on average over directions."""

from __future__ import annotations

from functools import cache

import numpy as np

from usdbrdf.model.arrays import Double

_ANGLES, _SLOPES, _AZIMUTHS = 24, 48, 24


@cache
def matching_factor(phi: float, f0: float) -> float:
    """Factor on a GGX lobe with Smith's masking that gives it the hemispherical albedo of the
    fitted lobe (docs/equations.md), both with alpha = max(0.001, phi) and the same f0."""
    return _albedo(phi, f0, fitted=True) / _albedo(phi, f0, fitted=False)


def _albedo(phi: float, f0: float, *, fitted: bool) -> float:
    """Share of uniform light that the lobe reflects, by the midpoint rule over half vectors.

    With h drawn from D(h) cos h, what remains of f cos_o is G V F 4 (wo.h) cos_o / cos h.
    """
    alpha = max(0.001, phi)
    mid = [(np.arange(n) + 0.5) / n for n in (_ANGLES, _SLOPES, _AZIMUTHS)]
    cos_i2, u, azimuth = np.meshgrid(*mid, indexing="ij")  # cos^2 uniform: cosine-weighted
    cos_i = np.sqrt(cos_i2)
    sin_i = np.sqrt(1 - cos_i2)
    cos_h = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
    sin_h = np.sqrt(1 - cos_h**2)
    wi_h = sin_i * sin_h * np.cos(2 * np.pi * azimuth) + cos_i * cos_h
    cos_o = 2 * wi_h * cos_h - cos_i
    front = (wi_h > 0) & (cos_o > 0)
    cos_o = np.where(front, cos_o, 1.0)
    y = (phi / 2 + 0.5) ** 2 if fitted else alpha
    visibility = _g1(cos_i, y) * _g1(cos_o, y)  # holds 1 / (4 cos_i cos_o)
    fresnel = f0 + (1 - f0) * (1 - np.clip(wi_h, 0, 1)) ** 5
    weight = visibility * fresnel * 4 * wi_h * cos_o / cos_h
    return float(np.where(front, weight, 0.0).mean())


def _g1(x: Double, y: float) -> Double:
    return np.asarray(1 / (x + np.sqrt(x**2 + y**2 - x**2 * y**2)))
