"""From a cost over roughness and specular to their values and how sure they are; and what to
publish of these: measured values, or the class prior with what the frames say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Double

_PSI_GRID = np.linspace(0, 1, 201)
_MODEL_DISCREPANCY = calibration.number("fit.model_discrepancy")
_BADLY_KNOWN = calibration.number("fit.footprint_uncertainty")
# Standard deviation of a number in [0, 1] of which nothing is known.
NOTHING_KNOWN = 1 / np.sqrt(12)


class LobeEstimate(NamedTuple):
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

    def of(name: str) -> Double:
        return np.array([getattr(estimate, name) for estimate in estimates])

    means = {name: float(weight @ of(name)) for name in ("phi", "psi", "unresolved")}
    for name in ("phi", "psi"):
        scatter = of(f"{name}_error") ** 2 + (of(name) - means[name]) ** 2
        means[f"{name}_error"] = min(math.sqrt(float(weight @ scatter)), float(NOTHING_KNOWN))
    of_rays = (weight @ of("of_rays")).tolist()
    best = estimates[int(costs.argmin())]
    return best._replace(**means, of_rays=(of_rays[0], of_rays[1]))


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


PRIOR_ERROR = calibration.number("prior.error")
NEUTRAL = calibration.pair("prior.neutral")
_OF_WORD = calibration.pairs("prior.classes")


def class_prior(class_name: str, label: str) -> tuple[float, float]:
    """(phi, psi) for an object's class, else for its name, else a neutral dielectric."""
    for text in (class_name, label):
        words = text.lower().replace("-", "_").replace(" ", "_").split("_")
        for word in reversed(words):
            if word in _OF_WORD:
                return _OF_WORD[word]
    return NEUTRAL


def with_prior(
    value: float, error: float, prior: float, nothing_known: float
) -> tuple[float, float]:
    """(value, error) of a number in [0, 1] estimated as ``value`` with a standard deviation of
    ``error``, together with its prior. An error of ``nothing_known`` leaves the prior alone."""
    precision = max(1 / max(error, 1e-3) ** 2 - 1 / nothing_known**2, 0.0)
    of_prior = 1 / PRIOR_ERROR**2
    mean = (precision * value + of_prior * prior) / (precision + of_prior)
    return mean, (precision + of_prior) ** -0.5


MIN_EVIDENCE = calibration.number("verdict.min_evidence")
SOME_EVIDENCE = calibration.number("verdict.some_evidence")
MAX_PHI_ERROR = calibration.number("verdict.max_phi_error")
MAX_PSI_ERROR = calibration.number("verdict.max_psi_error")
_PSI_SHARE = calibration.number("verdict.footprint_in_psi")
_MAX_FLAT_PHI = calibration.number("verdict.of_frame.max_flat_phi") / math.sqrt(12)
_MIN_EVIDENCE_OF_FRAME = calibration.number("verdict.of_frame.min_evidence")


@dataclass(frozen=True)
class Verdict:
    """phi, psi and their standard deviations (NaN: not known); status "measured", "prior",
    "unseen" or "failed"; confidence in either, "high", "low" or "none"."""

    phi: float
    psi: float
    phi_error: float
    psi_error: float
    status: str
    phi_confidence: str = "none"
    psi_confidence: str = "none"


def verdict_on_views(
    phi: tuple[float, float],
    psi: tuple[float, float],
    unresolved: float,
    evidence: float,
    prior: tuple[float, float],
    seen: bool,
) -> Verdict:
    """On a fit of many views. phi, psi: (value, standard deviation), NaN without a fit; unresolved,
    evidence: see LobeEstimate; prior: (phi, psi) of the class.

    Each is published as the mean of what the frames say and of the prior, weighted by their
    precisions: where the frames determine it, that is what they say. Of a highlight that is hardly
    larger than the samples' footprint they say something, but the stated error includes what the
    footprint may have done. Without evidence the prior stands alone.
    """

    def published(
        number: tuple[float, float], of_class: float, limit: float, blurred: float
    ) -> tuple[float, float, str]:
        if evidence >= SOME_EVIDENCE:  # never where it is NaN, without a fit
            value, error = with_prior(*number, of_class, NOTHING_KNOWN)
            error = min(math.hypot(error, blurred), NOTHING_KNOWN)
            sure = evidence >= MIN_EVIDENCE and error <= limit
            return value, error, "high" if sure else "low"
        return of_class, PRIOR_ERROR, "none"

    phi_mean, phi_error, of_phi = published(phi, prior[0], MAX_PHI_ERROR, unresolved)
    blurred = _PSI_SHARE * psi[0] * min(unresolved / max(phi[0], 0.01), 1.0)
    psi_mean, psi_error, of_psi = published(psi, prior[1], MAX_PSI_ERROR, blurred)
    status = "measured" if of_phi == of_psi == "high" else "prior" if seen else "unseen"
    return Verdict(phi_mean, psi_mean, phi_error, psi_error, status, of_phi, of_psi)


def verdict_on_frame(
    phi: tuple[float, float],
    psi: float,
    evidence: float,
    prior: tuple[float, float],
    seen: bool,
    keep: bool,
) -> Verdict:
    """On a fit of one frame. phi: (value, standard deviation of the flat stretch), NaN without a
    fit; keep: publish the minimum even where it is no measurement."""
    fitted = math.isfinite(phi[0])
    measured = fitted and evidence >= _MIN_EVIDENCE_OF_FRAME and phi[1] <= _MAX_FLAT_PHI
    if measured or (fitted and keep):
        status = "measured" if measured else "failed"
        return Verdict(phi[0], psi, phi[1], math.nan, status, "low", "low")
    return Verdict(*prior, PRIOR_ERROR, PRIOR_ERROR, "prior" if seen else "unseen")
