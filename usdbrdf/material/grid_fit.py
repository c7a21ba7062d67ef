"""Roughness by a two-level grid, specular by closed-form least squares (paper, section 3.4.2).

The image model is I = I_d + base(phi) + psi slope(phi). What is taken for I_d is said by a linear
projection that removes it, from the images and from the lobe alike:

    nothing       I_d was subtracted already: the paper's residual
    multiple_of   I_d times a free factor per channel: the median texture still holds the specular
                  light that is seen from everywhere, and taken literally leaves none to psi
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Basis = Callable[[float], tuple[Float, Float]]
Projection = Callable[[Double], Double]

GRID = 11
# Costs this close, relatively, are not told apart by some thousand noisy pixels.
_FLAT = 0.01


@dataclass(frozen=True, kw_only=True)
class GridFit:
    """phi, psi in [0, 1]; the roughnesses phi_low..phi_high that fit as well within 1 %; cost at
    phi, psi per residual; evidence = 1 - cost / cost without any specular light."""

    phi: float
    psi: float
    phi_low: float
    phi_high: float
    cost: float
    evidence: float


def fit_grid(observed: Float, weight: Float, basis: Basis, without_diffuse: Projection) -> GridFit:
    """Fit one object to P observations.

    observed         (P, 3) float32, radiance
    weight           (P, 1) float32, of the squared residual
    basis            phi -> (base, slope), (P, 3) each
    without_diffuse  projection of (P, 3) values that are multiplied by the root of the weight

    Two levels of K = 11: [0, 1], then between the neighbours of the first level's minimiser. Where
    the cost is flat around its minimum (with psi at 0 hardly anything depends on phi), the
    minimiser is noise; phi is then the middle of the flat interval.
    """
    root = np.sqrt(weight).astype(np.float64)
    target = without_diffuse(observed * root)
    tried: dict[float, tuple[float, float]] = {}

    def level(low: float, high: float) -> tuple[float, float]:
        grid = [float(phi) for phi in low + np.arange(GRID) * (high - low) / (GRID - 1)]
        for phi in grid:
            if phi not in tried:
                base, slope = basis(phi)
                rest = target - without_diffuse(base * root)
                tried[phi] = _best_psi(rest, without_diffuse(slope * root))
        best = min(range(GRID), key=lambda k: tried[grid[k]][0])
        return grid[max(best - 1, 0)], grid[min(best + 1, GRID - 1)]

    level(*level(0.0, 1.0))
    low, phi, high = _flat_interval(tried)
    cost, psi = tried[phi]
    unexplained = float((target * target).sum())
    evidence = 1.0 - cost / unexplained if unexplained > 0 else 0.0
    return GridFit(
        phi=phi,
        psi=psi,
        phi_low=low,
        phi_high=high,
        cost=cost / max(target.size, 1),
        evidence=max(0.0, evidence),
    )


def nothing(values: Double) -> Double:
    """The projection for residuals from which I_d is subtracted."""
    return values


def multiple_of(diffuse: Double) -> Projection:
    """Takes the best multiple of ``diffuse`` (P, 3), weighted like the values, off each channel."""
    square = np.maximum((diffuse * diffuse).sum(axis=0), 1e-30)

    def project(values: Double) -> Double:
        rest: Double = values - diffuse * ((diffuse * values).sum(axis=0) / square)
        return rest

    return project


def _best_psi(rest: Double, slope: Double) -> tuple[float, float]:
    """(cost, psi) for one roughness; the cost is that of the clamped psi (``base`` stays at 0)."""
    square = float((slope * slope).sum())
    psi = float((slope * rest).sum()) / square if square > 0 else 0.0
    psi = min(1.0, max(0.0, psi))
    left = rest - psi * slope
    return float((left * left).sum()), psi


def _flat_interval(tried: dict[float, tuple[float, float]]) -> tuple[float, float, float]:
    """Lowest, middle and highest roughness tried of the flat stretch around the minimum."""
    phis = sorted(tried)
    costs = [tried[phi][0] for phi in phis]
    best = min(range(len(phis)), key=costs.__getitem__)
    first = last = best
    while first > 0 and costs[first - 1] <= (1 + _FLAT) * costs[best]:
        first -= 1
    while last + 1 < len(phis) and costs[last + 1] <= (1 + _FLAT) * costs[best]:
        last += 1
    middle = (phis[first] + phis[last]) / 2
    nearest = min(phis[first : last + 1], key=lambda phi: (abs(phi - middle), phi))
    return phis[first], nearest, phis[last]
