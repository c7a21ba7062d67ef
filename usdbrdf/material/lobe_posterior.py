"""From a cost over roughness and specular to their values, and how sure they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Double

_PSI_GRID = np.linspace(0, 1, 201)
_MODEL_DISCREPANCY = calibration.number("fit.model_discrepancy")
_BADLY_KNOWN = calibration.number("fit.footprint_uncertainty")
# Standard deviation of a number in [0, 1] of which nothing is known.
NOTHING_KNOWN = 1 / np.sqrt(12)


@dataclass(frozen=True, kw_only=True)
class LobeEstimate:
    """phi, psi in [0, 1], where the cost is least; their standard deviations as far as the samples
    tell, which near NOTHING_KNOWN say just that; unresolved, how much of phi may be due to the
    samples' footprint; cost per degree of freedom; evidence = 1 - cost / cost without any specular
    light; of_rays, what the rays' noise alone does to phi and psi, beside the stated errors until
    ``mean_of_repeats`` adds it to them."""

    phi: float
    psi: float
    phi_error: float
    psi_error: float
    unresolved: float
    cost: float
    evidence: float
    of_rays: tuple[float, float] = (0.0, 0.0)


def lobe_from_costs(
    phis: Double, terms: Double, without: float, noisy: float, freedom: int, blur: float
) -> LobeEstimate:
    """The best lobe and its errors.

    phis     (K,) ascending, from 0 to 1
    terms    (K, 3): cost(phi, psi) = c0 - 2 psi c1 + psi^2 c2
    without  cost without specular light
    noisy    the least cost with the rays' noise in it
    freedom  degrees of freedom, for the unit of the cost
    blur     standard deviation, in radians, of the surface normal over the footprint of a sample: a
             lobe narrower than that is not seen as such
    """
    psi, profile, square = least_costs(terms, abs(without))
    phi = _vertex(phis, profile)
    least = float(profile.min())
    surface = terms[:, :1] - 2 * _PSI_GRID * terms[:, 1:2] + _PSI_GRID**2 * square[:, None]
    # Where rays are noisy, what they show is badly known as well, as the place of a mirrored lamp.
    noise_ratio = max(1.0, noisy / max(least, 1e-12))
    temper = max(1.0, _MODEL_DISCREPANCY * max(least, 0.0)) * noise_ratio
    density = np.exp(-0.5 * (surface - surface.min()) / temper)
    density *= np.gradient(phis)[:, None]
    density /= density.sum()
    phi_error = _deviation(density.sum(axis=1), phis, phi)
    best_psi = float(np.interp(phi, phis, psi))
    psi_error = _deviation(density.sum(axis=0), _PSI_GRID, best_psi)
    footprint = math.hypot(phi, _BADLY_KNOWN * blur) - phi
    return LobeEstimate(
        phi=phi,
        psi=best_psi,
        phi_error=min(phi_error, NOTHING_KNOWN),
        psi_error=min(psi_error, NOTHING_KNOWN),
        unresolved=footprint,
        cost=least / max(freedom, 1),
        evidence=max(0.0, 1 - least / without) if without > 0 else 0.0,
    )


def least_costs(terms: Double, scale: float) -> tuple[Double, Double, Double]:
    """Of each roughness, (K,): the psi in [0, 1] of the least cost, that cost, and c2, which is at
    least next to nothing on the ``scale`` of the costs. terms: see ``lobe_from_costs``."""
    square = np.maximum(terms[:, 2], 1e-12 * max(scale, 1.0))
    psi = np.clip(terms[:, 1] / square, 0, 1)
    return psi, terms[:, 0] - 2 * psi * terms[:, 1] + psi**2 * square, square


def averaged(
    estimates: Sequence[LobeEstimate], freedom: int, likely: Sequence[float]
) -> LobeEstimate:
    """Estimates of one lobe from different models, weighted by how likely these are: before the
    samples were asked, ``likely``, and with them. Cost and evidence are the best one's."""
    costs = np.array([estimate.cost * max(freedom, 1) for estimate in estimates])
    least = float(costs.min())
    weight = np.exp(-0.5 * (costs - least) / max(1.0, _MODEL_DISCREPANCY * least))
    weight *= np.array(likely)
    weight /= weight.sum()

    def mean(name: str) -> tuple[float, Double]:
        values = np.array([getattr(estimate, name) for estimate in estimates])
        return float(weight @ values), values

    errors = {}
    for name in ("phi", "psi"):
        middle, values = mean(name)
        within = mean(f"{name}_error")[1]
        error = math.sqrt(float(weight @ (within**2 + (values - middle) ** 2)))
        errors[f"{name}_error"] = min(error, float(NOTHING_KNOWN))
    of_rays = (weight @ np.array([estimate.of_rays for estimate in estimates])).tolist()
    return replace(
        estimates[int(costs.argmin())],
        phi=mean("phi")[0],
        psi=mean("psi")[0],
        unresolved=mean("unresolved")[0],
        of_rays=(of_rays[0], of_rays[1]),
        **errors,
    )


def _vertex(phis: Double, profile: Double) -> float:
    """The minimiser of the parabola through the least value and its neighbours."""
    k = int(profile.argmin())
    if k in (0, len(profile) - 1):
        return float(phis[k])
    x = phis[k - 1 : k + 2]
    a, b, _ = np.polyfit(x - x[1], profile[k - 1 : k + 2] - profile[k], 2)
    if a <= 0:
        return float(x[1])
    return float(np.clip(x[1] - b / (2 * a), x[0], x[2]))


def _deviation(density: Double, values: Double, about: float) -> float:
    """Root mean square distance from ``about``."""
    return float(np.sqrt((density * (values - about) ** 2).sum()))
