"""What the surface of a dielectric lets through: light that comes out of it after it was scattered
below has to pass it, and at grazing angles most does not.

Of light from direction v the facets that are seen from there reflect the share A(v), the mean of F
over them, and let 1 - A(v) through, either way. Seen from v the diffuse part is therefore brighter
than its mean over the hemisphere, the one that lights other surfaces, by

    t(v) = (1 - A(v)) / (2 integral of (1 - A) cos dcos),

and of light from w so much more comes to be scattered than of light from everywhere: the diffuse
part is t(v) t(w) rho / pi, and what is seen of it rho / pi times the integral of L t cos.

So it is of the renderers' lobe (DIELECTRIC). The paper's diffuse part is the same from everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.transport.brdf import DIELECTRIC, F0_OF_PSI, share_of_base
from usdbrdf.transport.directional_albedo import albedo_of_parts, view_cosines

# Knots of the table; the square root of phi and the cosine are even.
_PHIS, _COSINES = 17, 33
# Views of what is seen from the front.
_VIEWS = 8
_LEAST_COSINE = 1e-3
# Of a refractive index of 1.5.
USUAL_F0 = 0.04


class FacetShares(NamedTuple):
    """A = share_of_base base + F0 rise at knots (phi, cosine), those of the square root of phi and
    of the cosine even from 0 to 1; and the means of both, (phi, 1): over the hemisphere by the
    cosine, and over views within 45 degrees of the normal, from where colours are seen."""

    base: Double
    rise: Double
    base_mean: Double
    rise_mean: Double
    base_seen: Double
    rise_seen: Double


@cache
def facet_shares() -> FacetShares:
    """What facets reflect, by the kind of lobe DIELECTRIC."""
    phis = (np.linspace(0, 1, _PHIS) ** 2).tolist()

    def of_facets(cosines: Double) -> tuple[Double, Double]:
        parts = np.array([albedo_of_parts(phi, cosines, kind=DIELECTRIC) for phi in phis])
        base, rise, white = np.moveaxis(parts, 1, 0)
        return base / white, rise / white

    front = 1 - (1 - math.sqrt(0.5)) * (np.arange(_VIEWS) + 0.5) / _VIEWS
    base, rise = of_facets(np.maximum(np.linspace(0, 1, _COSINES), _LEAST_COSINE))
    means = [
        part.mean(axis=1, keepdims=True)
        for cosines in (view_cosines(), front)
        for part in of_facets(cosines)
    ]
    return FacetShares(base, rise, *means)


def kept_below(phis: Sequence[float], cosine: Float) -> tuple[Float, Float]:
    """(base, slope), (P, K) each, for K roughnesses and P cosines: 1 - t is about base + psi slope,
    exactly so at the usual F0, and not next to psi = 0."""
    table = facet_shares()
    place = np.clip(cosine, 0, 1, dtype=np.float64) * (_COSINES - 1)
    rows = np.sqrt(np.clip(phis, 0, 1)) * (_PHIS - 1)

    def beyond_mean(values: Double, mean: Double) -> Float:
        beyond = values - mean
        of_phi = [[np.interp(row, range(_PHIS), column) for column in beyond.T] for row in rows]
        found = [np.interp(place, range(_COSINES), curve) for curve in of_phi]
        return np.asarray(np.stack(found, axis=1) / let_through, np.float32)

    usual = 1 - (table.base_mean + USUAL_F0 * table.rise_mean)[:, 0]
    let_through = np.interp(rows, range(_PHIS), usual)

    base, rise = (
        beyond_mean(values, mean)
        for values, mean in ((table.base, table.base_mean), (table.rise, table.rise_mean))
    )
    return base, np.float32(F0_OF_PSI) * rise


def table_let_through(phi: Float, psi: Float) -> Float:
    """t (K, C) float32 of lobes phi (K,), psi (K,) or (K, 3) of which the mean counts, at C even
    cosines from 0 to 1."""
    cosine = np.tile(np.maximum(np.linspace(0, 1, _COSINES), _LEAST_COSINE), len(phi))
    of_lobe = np.repeat(np.arange(len(phi)), _COSINES)
    found = share_let_through(phi[of_lobe], psi[of_lobe], cosine)
    return found.reshape(len(phi), _COSINES)


def share_let_through(phi: Float, psi: Float, cosine: Float | Double) -> Float:
    """t (N,) of lobes phi, psi (N,), or psi (N, 3) of which the mean counts, seen at the ``cosine``
    (N,) from the normal; bilinear in a table."""
    row = np.sqrt(np.clip(phi, 0, 1), dtype=np.float64) * (_PHIS - 1)
    column = np.clip(cosine, 0, 1, dtype=np.float64) * (_COSINES - 1)
    i, j = (np.minimum(x.astype(np.intp), n - 2) for x, n in ((row, _PHIS), (column, _COSINES)))
    table, up, across = facet_shares(), row - i, column - j

    def along_phi(values: Double, k: Long | int) -> Double:
        return np.asarray((1 - up) * values[i, k] + up * values[i + 1, k])

    def looked_up(values: Double) -> Double:
        return np.asarray((1 - across) * along_phi(values, j) + across * along_phi(values, j + 1))

    f0 = F0_OF_PSI * np.clip(psi.mean(axis=1) if psi.ndim == 2 else psi, 0, 1, dtype=np.float64)
    share = share_of_base(f0, DIELECTRIC)
    own = share * looked_up(table.base) + f0 * looked_up(table.rise)
    mean = share * along_phi(table.base_mean, 0) + f0 * along_phi(table.rise_mean, 0)
    return np.asarray((1 - own) / (1 - mean), np.float32)


def share_seen(phi: Float | Double, psi: Float | Double) -> Float:
    """t (N,) of the same lobes on the mean over all views within 45 degrees of the normal: so much
    brighter than its mean over the hemisphere is the colour that people see who look at it."""
    row, table = np.sqrt(np.clip(phi, 0, 1), dtype=np.float64) * (_PHIS - 1), facet_shares()
    f0 = F0_OF_PSI * np.clip(psi.mean(axis=1) if psi.ndim == 2 else psi, 0, None, dtype=np.float64)

    def kept(base: Double, rise: Double) -> Double:
        of_phi = (np.interp(row, range(_PHIS), part[:, 0]) for part in (base, rise))
        by_base, by_rise = of_phi
        return np.asarray(1 - share_of_base(f0, DIELECTRIC) * by_base - f0 * by_rise)

    seen, mean = kept(table.base_seen, table.rise_seen), kept(table.base_mean, table.rise_mean)
    return np.asarray(seen / mean, np.float32)
