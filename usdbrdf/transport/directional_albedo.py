"""What of uniform light, or of light to one side, a lobe reflects: its directional albedo, by
quadrature over half vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf.model.arrays import Double
from usdbrdf.transport.brdf import (
    MIN_ALPHA,
    PAPER,
    distribution,
    masking,
    reflectance,
    share_of_base,
    width_of_masking,
)

# Of the grid: views, slopes and azimuths of half vectors, and cosines of w.h.
_VIEWS, _SLOPES, _AZIMUTHS, _COSINES = 24, 120, 32, 128
WH = (np.arange(_COSINES) + 0.5) / _COSINES


def view_cosines() -> Double:
    """(V,) cosines that weigh alike under uniform light."""
    return np.asarray(np.sqrt((np.arange(_VIEWS) + 0.5) / _VIEWS))


def fitted_albedo(
    phi: float, f0: Double, cosines: Double | None = None, *, kind: int = PAPER
) -> Double:
    """(V, N) directional albedo of a fitted kind of lobe for reflectances F0 (N,)."""
    base, rise, _ = albedo_of_parts(phi, cosines, kind=kind)
    return np.asarray(share_of_base(f0, kind) * base[:, None] + f0 * rise[:, None])


def albedo_of_parts(
    phi: float, cosines: Double | None = None, *, kind: int = PAPER
) -> tuple[Double, Double, Double]:
    """(V,) each: what the parts ``base`` and ``rise`` of F (see ``brdf.reflectance``) reflect, and
    what F = 1 would."""
    lobe = half_vectors(max(MIN_ALPHA, phi), cosines)
    y = width_of_masking(phi, kind)
    g = masking(lobe.cos_out, y) * masking(lobe.cos_in, y)  # holds 1 / (4 cos cos)
    weights = over_cosines(lobe, g)
    base, rise = reflectance(WH, kind)
    return weights @ base, weights @ rise, weights.sum(axis=1)


class HalfVectors(NamedTuple):
    """Half vectors h about the normal for each view: cosines of both directions and of w.h, and
    D cos_in dw, the weight of what is left of an integrand; all (V, S, A) or to be broadcast."""

    cos_out: Double
    cos_in: Double
    cos_half: Double
    cos_wh: Double
    weight: Double


def half_vectors(alpha: float, cosines: Double | None = None) -> HalfVectors:
    """tan(t) = alpha s with log s even; dw = 4 (w.h) dh, dh = sin^2 t cos t dlog(s) dazimuth."""
    cos_out = (view_cosines() if cosines is None else cosines)[:, None, None]
    log_s = np.linspace(np.log(1e-3), np.log(1e3 / alpha), _SLOPES)
    t = np.arctan(alpha * np.exp(log_s))[None, :, None]
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS
    cos_half, sin_half = np.cos(t), np.sin(t)
    cos_wh = np.sqrt(1 - cos_out**2) * sin_half * np.cos(azimuth) + cos_out * cos_half
    cos_in = 2 * cos_wh * cos_half - cos_out
    step = (log_s[1] - log_s[0]) * 2 * np.pi / _AZIMUTHS
    weight = (
        4 * cos_wh * sin_half**2 * cos_half * step * distribution(1 - cos_half**2, alpha) * cos_in
    )
    front = (cos_wh > 0) & (cos_in > 0)
    return HalfVectors(
        cos_out,
        np.where(front, cos_in, 1.0),
        cos_half,
        np.where(front, cos_wh, 1.0),
        np.where(front, weight, 0.0),
    )


def over_cosines(lobe: HalfVectors, rest: Double) -> Double:
    """(V, C) integral of D ``rest`` cos_in over directions, apart for each cosine of w.h."""
    value = np.broadcast_to(lobe.weight * rest, lobe.weight.shape)
    index = np.minimum((lobe.cos_wh * _COSINES).astype(np.intp), _COSINES - 1)
    return np.array(
        [np.bincount(i.ravel(), v.ravel(), _COSINES) for i, v in zip(index, value, strict=True)]
    )
