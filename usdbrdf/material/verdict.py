"""From a cost over roughness and specular to their values and how sure they are; and what to
publish of these: measured values, or what remains likely where the frames determine none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Double
from usdbrdf.transport.brdf import F0_OF_PSI

_PSI_GRID = np.linspace(0, 1, 201)
# What an estimate says of the posterior beside its least cost.
POSTERIOR = ("phi_median", "psi_median", "psi_upper")
MODEL_DISCREPANCY = calibration.number("fit.model_discrepancy")
_BADLY_KNOWN = calibration.number("fit.footprint_uncertainty")
# Standard deviation of a number in [0, 1] of which nothing is known.
NOTHING_KNOWN = 1 / np.sqrt(12)


class LobeEstimate(NamedTuple):
    """phi, psi in [0, 1], where the cost is least; their standard deviations as far as the samples
    tell, which near NOTHING_KNOWN say just that; unresolved, how much of phi may be due to the
    samples' footprint; cost per degree of freedom; evidence = 1 - cost / cost without any specular
    light; of_rays, what the rays' noise alone does to phi and psi, beside the stated errors until
    ``mean_of_repeats`` adds it to them. phi_median, psi_median, psi_upper: medians of either, and
    what psi exceeds with a probability of 5 %, if all in [0, 1] was equally likely before: where no
    highlight shows, the frames still say that psi is small or phi large. For psi_median no lobe at
    all was as likely before as one: it is 0 where the simpler model explains as much.
    contradiction: see ``ViewModel``, or what shows through for sure, see ``Through``; of a surface
    it is small, whatever its lobe."""

    phi: float
    psi: float
    phi_error: float
    psi_error: float
    unresolved: float
    cost: float
    evidence: float
    of_rays: tuple[float, float] = (0.0, 0.0)
    phi_median: float = 0.5
    psi_median: float = 0.5
    psi_upper: float = 1.0
    contradiction: float = 0.0


def lobe_from_costs(
    phis: Double,
    terms: Double,
    without: float,
    noisy: float,
    freedom: int,
    blur: float,
    scatter: tuple[float, float] = (1.0, 1.0),
    of_rays: tuple[float, float] = (0.0, 0.0),
) -> LobeEstimate:
    """The best lobe and its errors.

    phis     (K,) ascending, from 0 to 1
    terms    (K, 3): cost(phi, psi) = c0 - 2 psi c1 + psi^2 c2
    without  cost without specular light
    noisy    the least cost with the rays' noise in it
    freedom  degrees of freedom, for the unit of the cost
    blur     standard deviation, in radians, of the surface normal over the footprint of a sample: a
             lobe narrower than that is not seen as such
    scatter  how much larger the variances of phi and psi are than the costs tell, 1 or more
    of_rays  what the rays' noise does to phi and psi
    """
    psi, profile, square = least_costs(terms, abs(without))
    phi = _vertex(phis, profile)
    least = float(profile.min())
    surface = terms[:, :1] - 2 * _PSI_GRID * terms[:, 1:2] + _PSI_GRID**2 * square[:, None]
    # Where rays are noisy, what they show is badly known as well, as the place of a mirrored lamp.
    noise_ratio = max(1.0, noisy / max(least, 1e-12))
    of_phi, of_psi = (one * noise_ratio for one in scatter)
    lowest = min(float(surface.min()), without)

    def likely(temper: float) -> tuple[Double, float]:
        """Of each lobe, and that there is none at all, which was as likely before as one."""
        density = np.exp(-0.5 * (surface - lowest) / temper)
        density *= np.gradient(phis)[:, None]
        none = math.exp(-0.5 * (without - lowest) / temper)
        none /= none + float(density.sum()) / len(_PSI_GRID)
        return density / density.sum(), none

    by_phi, by_psi = likely(of_phi)[0].sum(axis=1), likely(of_psi)[0].sum(axis=0)
    phi_error = _deviation(by_phi, phis, phi)
    best_psi = float(np.interp(phi, phis, psi))
    psi_error = _deviation(by_psi, _PSI_GRID, best_psi)
    footprint = math.hypot(phi, _BADLY_KNOWN * blur) - phi
    (phi_median,) = _quantiles(by_phi, phis, (0.5,))
    # The errors leave out what the rays do to psi, which is added to them. Whether there is a lobe
    # is told by psi, whose variance temper / c2 grows by that.
    density, none = likely(of_psi + of_rays[1] ** 2 * float(square[profile.argmin()]))
    middle = (0.5 - none) / (1 - none) if none < 0.5 else 0.0
    psi_median, psi_upper = _quantiles(density.sum(axis=0), _PSI_GRID, (middle, 0.95))
    psi_median = psi_median if middle > 0 else 0.0
    return LobeEstimate(
        phi=phi,
        psi=best_psi,
        phi_error=min(phi_error, NOTHING_KNOWN),
        psi_error=min(psi_error, NOTHING_KNOWN),
        unresolved=footprint,
        cost=least / max(freedom, 1),
        # The rays' noise may make the least cost negative.
        evidence=min(max(0.0, 1 - least / without), 1.0) if without > 0 else 0.0,
        phi_median=phi_median,
        psi_median=psi_median,
        psi_upper=psi_upper,
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
    weight = np.exp(-0.5 * (costs - least) / max(1.0, MODEL_DISCREPANCY * least))
    weight *= np.array(likely)
    weight /= weight.sum()

    def of(name: str) -> Double:
        return np.array([getattr(estimate, name) for estimate in estimates])

    means = {name: float(weight @ of(name)) for name in ("phi", "psi", "unresolved", *POSTERIOR)}
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


def _quantiles(density: Double, values: Double, shares: Sequence[float]) -> tuple[float, ...]:
    """Below which so large ``shares`` of the probability of ascending ``values`` lie."""
    below = np.cumsum(density) - density / 2
    return tuple(float(np.interp(share, below, values)) for share in shares)


def _deviation(density: Double, values: Double, about: float) -> float:
    """Root mean square distance from ``about``."""
    return float(np.sqrt((density * (values - about) ** 2).sum()))


# The medians of what could not be asked, no lobe being as likely as one; and the deviation of psi
# about its median then.
NEUTRAL, UNASKED = (0.5, 0.0), 1 / math.sqrt(6)
_OF_WORD = calibration.pairs("prior.classes")


def usual_lobe(class_name: str, label: str) -> tuple[float, float] | None:
    """(phi, psi) as usual for an object's class, else for its name; None where neither is known."""
    for text in (class_name, label):
        words = text.lower().replace("-", "_").replace(" ", "_").split("_")
        for word in reversed(words):
            if word in _OF_WORD:
                return _OF_WORD[word]
    return None


SOME_EVIDENCE = calibration.number("verdict.some_evidence")
MOST_CONTRADICTED = calibration.number("verdict.most_contradicted")
MOST_OF_MEASURED = calibration.number("verdict.most_contradicted_of_measured")
_BOUNDED = calibration.number("verdict.bounded")
MAX_PHI_ERROR = calibration.number("verdict.max_phi_error")
MAX_PSI_ERROR = calibration.number("verdict.max_psi_error")
_MAX_F0_ERROR = calibration.number("conductor.max_f0_error")
_LACKING_SHARE, _LACKING = calibration.pair("verdict.lacking_in_phi")
_PSI_SHARE = calibration.number("verdict.footprint_in_psi")
_MAX_FLAT_PHI = calibration.number("verdict.of_frame.max_flat_phi") / math.sqrt(12)
_MIN_EVIDENCE_OF_FRAME = calibration.number("verdict.of_frame.min_evidence")


@dataclass(frozen=True)
class Verdict:
    """phi, psi and their standard deviations (NaN: not known); status "measured", "bounded",
    "undetermined", "unseen" or "failed"; confidence in either, "high", "low" or "none"; psi_upper:
    what psi exceeds with a probability of 5 % (NaN: not known); shown_phi, shown_psi: what is shown
    instead of what was found (NaN: that itself); model "dielectric", "diffuse", "conductor" with
    its f0 and the error of that, or "transparent"; contradiction: what the frames hold against its
    being a surface (NaN: nothing)."""

    phi: float
    psi: float
    phi_error: float
    psi_error: float
    status: str
    phi_confidence: str = "none"
    psi_confidence: str = "none"
    psi_upper: float = math.nan
    shown_phi: float = math.nan
    shown_psi: float = math.nan
    model: str = "dielectric"
    f0: tuple[float, float, float] = (0.0, 0.0, 0.0)
    f0_error: float = math.nan
    contradiction: float = math.nan


def verdict_on_views(lobe: LobeEstimate | None, seen: bool) -> Verdict:
    """On a fit of many views; None: there were too few samples for one.

    What the frames determine is published as found. Of a highlight that is hardly larger than the
    samples' footprint they say something, but the stated error includes what the footprint may have
    done. Where they do not determine both numbers, the medians of what remains likely are
    published, and psi is bounded where it lies in the lower half: no highlight is knowledge too.
    What is seen through a thing, or in it, changes with the view as no lobe does: then the numbers
    are none of a surface's and not measured; they stay, for what shows resembles the views more
    than what has no lobe. Names and classes of objects tell nothing here.
    """
    if lobe is None:
        return _not_asked(seen)
    of_psi = _PSI_SHARE * lobe.psi * min(lobe.unresolved / max(lobe.phi, 0.01), 1.0)
    lacking = math.hypot(_LACKING_SHARE * lobe.phi, _LACKING)
    phi_error = min(math.hypot(lobe.phi_error, lobe.unresolved, lacking), NOTHING_KNOWN)
    psi_error = min(math.hypot(lobe.psi_error, of_psi), NOTHING_KNOWN)

    # Where something changes with the view, but reflects next to nothing, it is no surface's lobe.
    shows = lobe.evidence >= SOME_EVIDENCE and lobe.psi > 2 * psi_error

    def confidence(error: float, limit: float) -> str:
        if shows and error <= limit:
            return "high"
        return "low" if lobe.evidence >= SOME_EVIDENCE else "none"

    sure = confidence(phi_error, MAX_PHI_ERROR), confidence(psi_error, MAX_PSI_ERROR)
    if lobe.psi >= _PSI_GRID[-2] and sure[1] == "high":
        # At the end of its range it is only known to be no less.
        sure = sure[0], "low"
    phi = lobe.phi if sure[0] == "high" else lobe.phi_median
    psi = lobe.psi if sure[1] == "high" else lobe.psi_median
    contradiction = math.nan
    clear = sure == ("high", "high")
    if lobe.contradiction > (MOST_OF_MEASURED if clear else MOST_CONTRADICTED):
        contradiction, sure = lobe.contradiction, ("none", "none")
    psi_upper = max(lobe.psi_upper, psi)
    status = "undetermined" if seen else "unseen"
    if sure == ("high", "high"):
        status = "measured"
    elif seen and psi_upper < _BOUNDED and math.isnan(contradiction):
        status = "bounded"
    return Verdict(
        phi, psi, float(phi_error), float(psi_error), status, *sure,
        psi_upper=psi_upper, contradiction=contradiction, model=_model_of(psi),
    )  # fmt: skip


def _model_of(psi: float) -> str:
    """Of what is no metal, nor clear."""
    return "dielectric" if psi > 0 else "diffuse"


def verdict_on_metal(
    phi: float,
    f0: tuple[float, float, float],
    phi_error: float,
    f0_error: float,
    *,
    likelier: bool = True,
) -> Verdict:
    """On a metal; ``likelier``: it explains many views better than any dielectric, without which
    nothing of it is measured, whoever says that it is one. f0_error: NaN of one frame."""
    # One frame fits a roughness to whatever it was told to believe.
    phi_sure = "high" if phi_error <= MAX_PHI_ERROR and math.isfinite(f0_error) else "low"
    f0_sure = "high" if f0_error <= _MAX_F0_ERROR else "low"
    measured = (phi_sure, f0_sure) == ("high", "high") and likelier
    # psi is at the bound of all dielectrics.
    psi_error = float(np.minimum(f0_error / F0_OF_PSI, NOTHING_KNOWN))  # NaN if F0's is
    status = "measured" if measured else "undetermined"
    return Verdict(
        phi, 1.0, phi_error, psi_error, status, phi_sure, f0_sure,
        psi_upper=1.0, model="conductor", f0=f0, f0_error=f0_error,
    )  # fmt: skip


def verdict_on_frame(
    phi: tuple[float, float], psi: float, evidence: float, seen: bool, keep: bool
) -> Verdict:
    """On a fit of one frame. phi: (value, standard deviation of the flat stretch), NaN without a
    fit; keep: publish the minimum even where it is no measurement."""
    fitted = math.isfinite(phi[0])
    measured = fitted and evidence >= _MIN_EVIDENCE_OF_FRAME and phi[1] <= _MAX_FLAT_PHI
    if measured or (fitted and keep):
        status = "measured" if measured else "failed"
        model = _model_of(psi)
        return Verdict(phi[0], psi, phi[1], math.nan, status, "low", "low", model=model)
    return _not_asked(seen)


def _not_asked(seen: bool) -> Verdict:
    errors = float(NOTHING_KNOWN), UNASKED
    return Verdict(*NEUTRAL, *errors, "undetermined" if seen else "unseen", psi_upper=1.0)
