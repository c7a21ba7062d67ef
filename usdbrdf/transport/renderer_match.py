"""What to write into a UsdPreviewSurface so that renderers show what the fitted lobe reflects.

Renderers read roughness and reflectance as another lobe than the one that was fitted (``brdf``):
they mask by Smith's term of the same alpha, and take what is reflected away from the diffuse term.
With the fitted numbers in it, Cycles reflects 20 to 40 % more and diffuses 4 to 10 % less.

So, over a grid of phi and F0 = 0.08 psi, the reflectance F0' and a factor k on the diffuse colour
are found that bring two renderers, Cycles and Hydra Storm, closest to the fit: F0' by least squares
over the relative errors of the lobe's directional albedo, views weighed as under uniform light, by
the cosine; k so that Cycles, which traces light on, reflects as much of uniform light as the fit in
all, for a diffuse colour of 0.5: an error of 1 % grows to 4 % in a bright room. alpha stays: all
have the same D, and so highlights keep their width.

    Cycles   D G F, G Smith's height-correlated, F of a dielectric, scattering between facets
             (C. Kulla, A. Conty 2017); diffuse (1 - A), A the lobe's directional albedo
    Storm    D G F / (4 n.w n.wo + 0.001), G Schlick's with k = alpha / 2, F Schlick's; diffuse
             (1 - F(w.h)). Its D, too large by 0.001 / alpha^2, is left out: no reflectance mends
             that of a near mirror.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.model.arrays import Double
from usdbrdf.transport.brdf import (
    DIELECTRIC,
    F0_OF_PSI,
    MIN_ALPHA,
    distribution,
    fresnel,
    masking,
    masking_width,
)
from usdbrdf.transport.directional_albedo import (
    WH,
    fitted_albedo,
    half_vectors,
    over_cosines,
    view_cosines,
)
from usdbrdf.transport.let_through import share_seen

# Candidates for F0'.
_CANDIDATES = 400
# The diffuse colour for which the sum of both terms is kept.
_TYPICAL = 0.5
_PHI = np.linspace(0, 1, 25) ** 2
# Beyond psi = 1, for what an artist may choose: F0 up to 0.32, ior up to 3.6.
_F0 = F0_OF_PSI * np.linspace(0, 2, 21) ** 2


class Shown(NamedTuple):
    """Reflectance F0' at normal incidence, and the factor on the diffuse colour; arrays (N,)."""

    f0: Double
    diffuse: Double


def shown_lobe(phi: npt.ArrayLike, psi: npt.ArrayLike) -> Shown:
    """What renderers must be given, with alpha = max(0.001, phi), for phi and psi (N,) or numbers.

    Bilinear in the table; psi may reach 4, beyond which the table's end holds.
    """
    table = _table()
    f0 = F0_OF_PSI * np.asarray(psi, np.float64)
    return Shown(*(_bilinear(values, np.asarray(phi, np.float64), f0) for values in table))


@cache
def _kept_beside_microfacets() -> Double:
    """(phi, F0) of the tables: the factor on the diffuse colour for a lobe that is the renderers'
    own, of which they take what it reflects away from the diffuse term. The colour is what is seen
    from the front (``share_seen``), more than the mean over the hemisphere."""
    rows = []
    for phi in _PHI.tolist():
        fitted = fitted_albedo(phi, _F0, kind=DIELECTRIC).mean(axis=0)
        lobe, kept = (part.mean(axis=0) for part in cycles_albedo(phi, _F0))
        mean = _TYPICAL / share_seen(np.full(len(_F0), phi), _F0 / F0_OF_PSI)
        rows.append((mean + fitted - lobe) / (_TYPICAL * kept))
    return np.array(rows)


def kept_beside_microfacets(phi: float, f0: float) -> float:
    """That factor for one lobe; beyond the table its end holds."""
    table = _kept_beside_microfacets()
    return float(_bilinear(table, np.asarray(phi, np.float64), np.asarray(f0, np.float64)))


def shown_share_of_metal(phi: float) -> float:
    """What of a conductor's F0, with alpha = max(0.001, phi), renderers must be given: that of the
    table's largest F0, beyond which hardly anything but the masking differs."""
    end = _bilinear(_table().f0, np.asarray(phi, np.float64), np.asarray(_F0[-1]))
    return float(end / _F0[-1])


def measured_lobe(phi: float, shown_f0: float) -> tuple[float, float]:
    """(psi, factor on the diffuse colour) of what renderers are given: ``shown_lobe`` inverted.

    An F0' below that of psi = 0 is psi = 0; one beyond the table is its end.
    """
    along = _bilinear(_table().f0, np.full(len(_F0), phi), _F0)
    f0 = float(np.interp(shown_f0, along, _F0))
    return f0 / F0_OF_PSI, float(_bilinear(_table().diffuse, np.asarray(phi), np.asarray(f0)))


@cache
def _table() -> Shown:
    """F0' and k, (phi, F0) each."""
    candidates = np.linspace(1e-3, np.sqrt(_F0[-1]), _CANDIDATES) ** 2
    rows = []
    for phi in _PHI.tolist():
        fitted = fitted_albedo(phi, _F0)
        shown = [renderer(phi, candidates) for renderer in (cycles_albedo, storm_albedo)]
        error = sum(
            ((s.lobe[:, None, :] / fitted[:, :, None] - 1) ** 2).mean(axis=0) for s in shown
        )  # (F0, candidates)
        f0 = _least(np.asarray(error), np.sqrt(candidates)) ** 2
        lobe, kept = (part.mean(axis=0) for part in cycles_albedo(phi, f0))
        rows.append((f0, (_TYPICAL + fitted.mean(axis=0) - lobe) / (_TYPICAL * kept)))
    return Shown(*(np.array(column) for column in zip(*rows, strict=True)))


def _bilinear(values: Double, phi: Double, f0: Double) -> Double:
    weights = []
    for knots, x in ((_PHI, phi), (_F0, f0)):
        place = np.interp(x, knots, np.arange(len(knots)))
        low = np.minimum(place.astype(np.intp), len(knots) - 2)
        weights.append((low, place - low))
    (i, u), (j, v) = weights
    low_phi = (1 - v) * values[i, j] + v * values[i, j + 1]
    high_phi = (1 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
    return np.asarray((1 - u) * low_phi + u * high_phi)


def _least(error: Double, x: Double) -> Double:
    """Where the rows of ``error`` (N, C) over even x (C,) are least, by a parabola."""
    at = np.clip(error.argmin(axis=1), 1, len(x) - 2)
    low, mid, high = (np.take_along_axis(error, at[:, None] + k, 1)[:, 0] for k in (-1, 0, 1))
    shift = 0.5 * (low - high) / np.maximum(low - 2 * mid + high, 1e-300)
    return np.asarray(x[at] + np.clip(shift, -1, 1) * (x[1] - x[0]))


class Albedo(NamedTuple):
    """Over directions to the viewer (V,) and reflectances (N,): directional albedo (V, N) of the
    lobe, and the share (V, N) of the diffuse term that is left."""

    lobe: Double
    diffuse: Double


def cycles_albedo(phi: float, f0: Double, cosines: Double | None = None) -> Albedo:
    """Of the lobe of Blender's Principled BSDF, which scatters between the facets too."""
    alpha = max(MIN_ALPHA, phi)

    def shadowing(x: Double) -> Double:
        return np.asarray(0.5 * (np.sqrt(1 + alpha**2 * (1 / x**2 - 1)) - 1))

    def single(at: Double | None) -> Double:
        lobe = half_vectors(alpha, at)
        g = 1 / (1 + shadowing(lobe.cos_out) + shadowing(lobe.cos_in))
        return over_cosines(lobe, g / (4 * lobe.cos_out * lobe.cos_in))

    weights = single(cosines)
    white, reflected = weights.sum(axis=1)[:, None], weights @ _dielectric(f0, WH)
    white_mean = single(None).sum(axis=1).mean()
    fresnel_mean = _dielectric(f0, view_cosines()).mean(axis=0)
    between = fresnel_mean * white_mean / (1 - fresnel_mean * (1 - white_mean))
    lobe = reflected * (1 + between * (1 - white) / white)
    return Albedo(lobe, 1 - lobe)


def storm_albedo(
    phi: float, f0: Double, cosines: Double | None = None, *, mirror_error: bool = False
) -> Albedo:
    """Of Hydra Storm's UsdPreviewSurface under direct light; ``mirror_error``: with the excess of
    its D."""
    alpha = max(MIN_ALPHA, phi)
    lobe = half_vectors(alpha, cosines)
    k = alpha / 2
    g = 1 / (4 * lobe.cos_out * lobe.cos_in + 0.001)
    for x in (lobe.cos_out, lobe.cos_in):
        g = g * x / (x * (1 - k) + k)
    excess = 1 + 0.001 / alpha**2 if mirror_error else 1.0
    # The diffuse term's light comes from everywhere: cosine-distributed about the normal.
    half = half_vectors(1.0, cosines)
    everywhere = over_cosines(
        half, half.cos_in * 0 + 1 / np.pi / distribution(1 - half.cos_half**2, 1.0)
    )
    f = fresnel(f0, WH[:, None])
    kept = everywhere @ (1 - f) / everywhere.sum(axis=1)[:, None]
    return Albedo(excess * (over_cosines(lobe, g) @ f), kept)


def _dielectric(f0: Double, cosine: Double) -> Double:
    """(C, N) Fresnel's equations for the index of refraction that has F0."""
    ior = (1 + np.sqrt(f0)) / (1 - np.sqrt(f0))
    c = cosine[:, None]
    g = np.sqrt(ior**2 - 1 + c**2)
    return np.asarray(
        0.5 * ((g - c) / (g + c)) ** 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2)
    )


@cache
def matching_factor(phi: float, f0: float) -> float:
    """Factor on a GGX lobe with Smith's masking that gives it the hemispherical albedo of the
    fitted lobe, both with alpha = max(0.001, phi) and the same f0.

    The share of uniform light that D G1(., y) G1(., y) F reflects, by the midpoint rule over half
    vectors: with h drawn from D(h) cos h, what remains of f cos_o is G F 4 (wo.h) cos_o / cos h.
    """
    alpha = max(MIN_ALPHA, phi)
    mid = [(np.arange(n) + 0.5) / n for n in (24, 48, 24)]
    cos_i2, u, azimuth = np.meshgrid(*mid, indexing="ij")  # cos^2 uniform: cosine-weighted
    cos_i = np.sqrt(cos_i2)
    sin_i = np.sqrt(1 - cos_i2)
    cos_h = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
    sin_h = np.sqrt(1 - cos_h**2)
    wi_h = sin_i * sin_h * np.cos(2 * np.pi * azimuth) + cos_i * cos_h
    cos_o = 2 * wi_h * cos_h - cos_i
    front = (wi_h > 0) & (cos_o > 0)
    cos_o = np.where(front, cos_o, 1.0)

    def albedo(y: float) -> float:
        g = masking(cos_i, y) * masking(cos_o, y)  # holds 1 / (4 cos_i cos_o)
        weight = g * fresnel(f0, np.clip(wi_h, 0, 1)) * 4 * wi_h * cos_o / cos_h
        return float(np.where(front, weight, 0.0).mean())

    return albedo(masking_width(phi)) / albedo(alpha)
