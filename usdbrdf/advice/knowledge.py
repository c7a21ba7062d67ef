"""What photographs are expected to tell of an object's roughness and specular, before they are
taken: a design of experiments for the fit (K. Chaloner and I. Verdinelli, "Bayesian experimental
design: a review", Statistical Science 1995).

The fit compares lobes by what they leave unexplained of samples whose diffuse part is free per
texel. So what tells two lobes apart is how differently they change between a texel's views,
against the samples' errors. Lobes are sums of ``basis`` functions, of which one table of products
per texel suffices: it adds up over views, whichever lobe is the true one. Of every lobe that the
frames so far leave likely, the posterior that the fit would then have is computed, and judged as
the fit judges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf.material.fit_views import ABOVE_NOISE, MIN_OBSERVATIONS, MIN_VIEWS
from usdbrdf.material.refined_means import OF_NOISE_FLOOR, RELATIVE_ERROR
from usdbrdf.material.verdict import (
    MAX_PHI_ERROR,
    MAX_PSI_ERROR,
    MODEL_DISCREPANCY,
    NOTHING_KNOWN,
    SOME_EVIDENCE,
)
from usdbrdf.model.arrays import Bool, Double, Float, Long

# Lobes that are compared.
PHIS = (0.03, 0.08, 0.14, 0.22, 0.33, 0.48, 0.66, 0.88)
PSIS = (0.1, 0.3, 0.5, 0.7, 0.9)
# Views that the fit keeps of a texel, the share of its texels that are chosen for their highlights,
# and how many are too few to tell anything.
_KEPT_VIEWS, _BEST, _FEWEST = 12, 0.2, 8
# Relative deviation of the error that all samples of a frame have in common.
_SHARED = 0.02
# Beyond the bound that the fit gives for psi, with a probability of 5 %, lobes are this unlikely.
_BEYOND_BOUND = 0.05
# Contrast below that of this evidence tells nothing: the errors of frames alone have as much.
_NO_NEWS = SOME_EVIDENCE / (1 - SOME_EVIDENCE)
# Samples of which a fit is sure to be made.
_ENOUGH = 1.5 * MIN_OBSERVATIONS


@dataclass(frozen=True, kw_only=True)
class Lobes:
    """H lobes: phi, psi (H,); width (H,), the share of [0, 1] that each roughness stands for;
    combination (H, K), of the basis functions (base of each roughness, then slope of each)."""

    phi: Double
    psi: Double
    width: Double
    combination: Double


def lobes() -> Lobes:
    """All that are compared."""
    phis, psis = np.array(PHIS), np.array(PSIS)
    edges = np.concatenate([[0.0], (phis[1:] + phis[:-1]) / 2, [1.0]])
    which, psi = (grid.ravel() for grid in np.meshgrid(np.arange(len(phis)), psis, indexing="ij"))
    one = np.eye(len(phis))[which]
    return Lobes(
        phi=phis[which],
        psi=psi,
        width=np.diff(edges)[which],
        combination=np.concatenate([one, psi[:, None] * one], axis=1),
    )


def likely_lobes(
    known: Lobes, phi: float, psi: float, phi_error: float, psi_error: float, psi_upper: float
) -> Double:
    """(H,): how likely each lobe is after the frames so far, of which the fit tells value, standard
    deviation and bound (NaN: nothing is known); the rest of 1 is that there is no lobe at all,
    which the fit holds for likelier where it says that psi is 0."""
    log = np.log(known.width)
    for values, value, error in ((known.phi, phi, phi_error), (known.psi, psi, psi_error)):
        # A deviation of an even distribution says that nothing is known.
        if np.isfinite(value) and np.isfinite(error) and error < 0.95 * NOTHING_KNOWN:
            log = log - 0.5 * ((values - value) / max(error, 0.02)) ** 2
    if np.isfinite(psi_upper):
        log = log + np.where(known.psi > psi_upper, np.log(_BEYOND_BOUND), 0.0)
    density = np.exp(log - log.max())
    # All that is known then is that the chance of a lobe is less than one half; what could not be
    # asked has that chance itself.
    chance = 1.0 if psi != 0 else 0.25 if psi_upper < 1 else 0.5
    return np.asarray(chance * density / density.sum(), np.float64)


class Exposure(NamedTuple):
    """Of a photograph: its time in seconds, and the radiance from which a channel is clipped and
    below which it is noise."""

    time: float
    saturation: float
    noise_floor: float

    def records(self, level: Double | Float) -> Bool:
        """Whether radiance is neither clipped nor hardly above noise."""
        return np.asarray(
            (level < 0.998 * self.saturation) & (level > ABOVE_NOISE * self.noise_floor), np.bool_
        )


class Products(NamedTuple):
    """Of N texels, over their views v: sums of w, w b and w b b', (N,), (N, K), (N, K, K), b being
    the basis functions there and w the inverse variance of the sample; views (N,), their number.
    """

    weight: Double
    mean: Double
    square: Double
    views: Double

    @classmethod
    def none(cls, texels: int, basis: int) -> Products:
        return cls(
            np.zeros(texels), np.zeros((texels, basis)), np.zeros((texels, basis, basis)),
            np.zeros(texels),
        )  # fmt: skip

    def add(self, which: Long, weight: Double, basis: Double) -> None:
        """One view of the texels ``which`` (M,), each once: weight (M,), basis (M, K)."""
        weighted = weight[:, None] * basis
        self.weight[which] += weight
        self.mean[which] += weighted
        self.square[which] += weighted[:, :, None] * basis[:, None]
        self.views[which] += weight > 0


def view_of(
    level: Double, basis: Double, typical: Double, exposure: Exposure
) -> tuple[Double, Double]:
    """Weights (M,) and basis (M, K) of one photograph's samples, freed of what the error that they
    share may account for. level (M,): diffuse radiance; typical (K,): the lobe that is expected.

    A sample's error is that which the fit's last step counts with; 0 weighs what is not recorded.
    """
    shown = level + np.maximum(basis @ typical, 0)
    variance = (RELATIVE_ERROR * shown) ** 2 + (OF_NOISE_FLOOR * exposure.noise_floor) ** 2
    weight = np.where(exposure.records(shown), 1 / np.maximum(variance, 1e-30), 0.0)
    weighted = weight * level
    precision = float(weighted @ level) + _SHARED**-2
    return weight, basis - level[:, None] * ((weighted @ basis) / precision)


def contrast(products: Products, typical: Double) -> Double:
    """(K, K): what tells lobes apart, per degree of freedom: d' contrast d is the mean squared
    difference of two lobes, d (K,) apart, over the samples' variance, with each texel's diffuse
    part left free. Half of the texels are those that show highlights best, as the fit has it."""
    usable = np.flatnonzero((products.views >= MIN_VIEWS) & (products.weight > 0))
    if len(usable) < _FEWEST:
        return np.zeros(products.square.shape[1:])
    weight, mean, square, views = (values[usable] for values in products)
    free = np.minimum(views, _KEPT_VIEWS) - 1
    along = mean @ typical
    shows = np.einsum("k,nkl,l->n", typical, square, typical) - along**2 / weight
    best = np.argsort(-shows, kind="stable")[: max(_FEWEST, round(_BEST * len(usable)))]
    total = np.zeros(square.shape[1:])
    for chosen in (best, slice(None)):
        part = square[chosen].sum(axis=0)
        part -= (mean[chosen].T / weight[chosen]) @ mean[chosen]
        total += 0.5 * part / free[chosen].sum()
    return total


class Outlook(NamedTuple):
    """What a fit is expected to tell: standard deviations of phi and psi, the probability that it
    measures both, and how much is known in all, from 0 to 1."""

    phi_error: float
    psi_error: float
    measured: float
    worth: float


def share_found(known: Lobes, likely: Double, contrasts: Double, evidence: float) -> float:
    """Of the contrast that is reckoned with, how much the fit found in the frames: its evidence,
    1 - unexplained / all, against the one that was to be expected. Patterns, curvature and poses
    make errors of samples that no reckoning knows; they will be there in further photographs too.
    evidence NaN: there was no fit to compare with."""
    own = np.einsum("hk,kl,hl->h", known.combination, contrasts, known.combination)
    reckoned = float(likely @ np.maximum(own, 0))
    if not np.isfinite(evidence) or reckoned <= 0:
        return 1.0
    found = max(evidence, 0.0) / max(1 - evidence, 1e-3)
    return float(min((found + _NO_NEWS) / (reckoned + _NO_NEWS), 1.0))


def coarser_than_reckoned(
    reckoned: Outlook, phi_error: float, psi_error: float
) -> tuple[float, float]:
    """How many times larger the errors are that the fit states, NaN: none; at least once."""
    pairs = (phi_error, reckoned.phi_error), (psi_error, reckoned.psi_error)
    first, second = (
        max(1.0, stated / max(own, 0.01)) if np.isfinite(stated) else 1.0 for stated, own in pairs
    )
    return first, second


def reckoned_samples(products: Products) -> float:
    """How many samples the views give, of texels that enough of them see."""
    views = products.views[products.views >= MIN_VIEWS]
    return float(np.minimum(views, _KEPT_VIEWS).sum())


def share_of_enough(products: Products, samples_per_reckoned: float) -> float:
    """From 0 to 1: of small things the fit may have too few samples."""
    reckoned = reckoned_samples(products)
    return min(1.0, samples_per_reckoned * reckoned / _ENOUGH) if reckoned else 0.0


def outlook(
    known: Lobes, likely: Double, contrasts: Double, coarser: tuple[float, float] = (1.0, 1.0)
) -> Outlook:
    """The mean over lobes, as ``likely`` (H,) as they are, of what the fit would find were they
    true; contrasts (K, K); coarser: how many times larger the errors of phi and psi are than they
    are reckoned."""
    products = known.combination @ contrasts @ known.combination.T
    own = np.maximum(np.diag(products), 0)
    apart = np.maximum(own[:, None] + own[None] - 2 * products, 0)
    # Such a share of the cost is reckoned as the model's. The fit asks its samples instead, which
    # there are none of yet; by how much its errors are larger is in ``coarser``.
    posterior = known.width * np.exp(-0.5 * apart / MODEL_DISCREPANCY)
    posterior /= posterior.sum(axis=1, keepdims=True)
    errors = [
        np.sqrt((posterior * (values[None] - values[:, None]) ** 2).sum(axis=1))
        for values in (known.phi, known.psi)
    ]
    evidence = own / (1 + own)
    of_phi, of_psi = (
        np.minimum(times * error, NOTHING_KNOWN)
        for times, error in zip(coarser, errors, strict=True)
    )
    measured = (evidence >= SOME_EVIDENCE) & (known.psi > 2 * of_psi)
    measured &= (of_phi <= MAX_PHI_ERROR) & (of_psi <= MAX_PSI_ERROR)
    probability = float(likely @ measured)
    # Where there is no lobe, further photographs do not find one.
    none = (1 - float(likely.sum())) * NOTHING_KNOWN
    of_phi_mean, of_psi_mean = (float(likely @ errors) + none for errors in (of_phi, of_psi))
    knows = 1 - (of_phi_mean + of_psi_mean) / (2 * NOTHING_KNOWN)
    # Knowing a little of two objects is not as good as measuring one.
    on_the_way = (knows + float(likely @ np.minimum(evidence / SOME_EVIDENCE, 1))) / 2
    worth = (2 * probability + on_the_way) / 3
    return Outlook(of_phi_mean, of_psi_mean, probability, worth)
