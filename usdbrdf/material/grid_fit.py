"""Roughness by a two-level grid, specular by closed-form least squares (paper, section 3.4.2).

The image model is I = I_d + base(phi) + psi slope(phi). ``paper`` takes I_d as given; ``scaled``
lets each channel scale it by a free factor, which is eliminated before psi is solved for: the
median texture still holds the specular light that is seen from everywhere, and taken literally it
leaves nothing for psi to explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]

Residual = Literal["paper", "scaled"]
Basis = Callable[[float], tuple[Float, Float]]

GRID = 11
# Costs this close, relatively, are not told apart by a frame of some thousand noisy pixels.
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


def fit_grid(
    observed: Float, diffuse: Float, weight: Float, basis: Basis, residual: Residual
) -> GridFit:
    """Fit one object.

    observed, diffuse  (P, 3) float32, radiance of the target frame and of L_d seen from it
    weight             (P, 1) float32, of the squared residual
    basis              phi -> (base, slope), (P, 3) each
    Two levels of K = 11: [0, 1], then between the neighbours of the first level's minimiser. Where
    the cost is flat around its minimum (with psi at 0 hardly anything depends on phi), the minimiser
    is noise; phi is then the middle of the flat interval.
    """
    root = np.sqrt(weight).astype(np.float64)
    target, known = observed * root, diffuse * root
    tried: dict[float, tuple[float, float]] = {}

    def level(low: float, high: float) -> tuple[float, float]:
        grid = low + np.arange(GRID) * (high - low) / (GRID - 1)
        for phi in grid:
            if float(phi) not in tried:
                base, slope = basis(float(phi))
                tried[float(phi)] = _best_psi(target, known, base * root, slope * root, residual)
        best = min(range(GRID), key=lambda k: tried[float(grid[k])][0])
        return float(grid[max(best - 1, 0)]), float(grid[min(best + 1, GRID - 1)])

    level(*level(0.0, 1.0))
    low, phi, high = _flat_interval(tried)
    cost, psi = tried[phi]
    without = _cost(target, known, np.zeros_like(target), residual)
    evidence = 1.0 - cost / without if without > 0 else 0.0
    return GridFit(
        phi=phi,
        psi=psi,
        phi_low=low,
        phi_high=high,
        cost=cost / max(target.size, 1),
        evidence=max(0.0, evidence),
    )


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


def _best_psi(
    target: Double, known: Double, base: Double, slope: Double, residual: Residual
) -> tuple[float, float]:
    """(cost, psi) for one roughness; the cost is that of the clamped psi (``base`` stays at 0)."""
    rest = _explain(target - base, known, residual)
    free = slope if residual == "paper" else _without(slope, known)
    square = float((free * free).sum())
    psi = float((free * rest).sum()) / square if square > 0 else 0.0
    psi = min(1.0, max(0.0, psi))
    return _cost(target, known, base + psi * slope, residual), psi


def _cost(target: Double, known: Double, non_diffuse: Double, residual: Residual) -> float:
    rest = _explain(target - non_diffuse, known, residual)
    return float((rest * rest).sum())


def _explain(light: Double, known: Double, residual: Residual) -> Double:
    """What the diffuse image leaves unexplained of ``light``."""
    return light - known if residual == "paper" else _without(light, known)


def _without(light: Double, known: Double) -> Double:
    """``light`` with its best multiple of ``known`` taken out of each channel."""
    square = np.maximum((known * known).sum(axis=0), 1e-30)
    return light - known * ((known * light).sum(axis=0) / square)
