"""The lobe that explains many views best: two levels of roughness, specular in closed form; and
what the noise of the rays does to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.material.verdict import (
    NOTHING_KNOWN,
    POSTERIOR,
    SOME_EVIDENCE,
    LobeEstimate,
    averaged,
    least_costs,
    lobe_from_costs,
)
from usdbrdf.material.view_model import UPDATES, ViewModel, ViewSamples
from usdbrdf.model.arrays import Double, Float, Long

Pair = tuple[Float, Float]
OfPhis = Callable[[Sequence[float]], Pair]
# Where what the rays do is more than this share of the samples' errors, the fit is the mean of so
# many with rays of their own.
_NOISY = calibration.number("fit.noisy_rays")
_REPEATS = 4


class Linear(NamedTuple):
    """The lobe of P samples about what was found, from two bases with independent noise.

    by_first, by_second  (P, 3, 2): its derivatives by phi and psi, freed of the texels' means: what
                         a texel sends to all views is diffuse light to the fit, and moves neither
    between              (P, 3): the difference of the two
    solved               (P, 3, 6): C^-1 of the derivatives and of what either leaves of the samples
    precision            (2, 2): H = J1' C^-1 J2, with that of the prior at least
    """

    by_first: Double
    by_second: Double
    between: Double
    solved: Double
    precision: Double

    @classmethod
    def about(
        cls,
        model: ViewModel,
        radiance: Float,
        bases: tuple[Pair, Pair],
        phis: Sequence[float],
        psi: float,
    ) -> Linear:
        """radiance (P, 3) of the samples; bases: twice (base, slope), (P, 3, 3) each, at three
        ``phis``: the one that was found and its neighbours."""
        lobes = [base + np.float32(psi) * slope for base, slope in bases]
        step = phis[2] - phis[0]
        first, second = (
            model.reduced(
                np.stack([(lobe[..., 2] - lobe[..., 0]) / step, slope[..., 1]], axis=-1)
            ).values
            for lobe, (_, slope) in zip(lobes, bases, strict=True)
        )
        left = [(radiance - lobe[..., 1])[..., None] for lobe in lobes]
        solved = model.solved(np.concatenate([first, second, *left], axis=-1))
        crossed = np.einsum("pci,pcj->ij", solved[..., :2], second)
        # Noise may leave less than the prior's precision of it.
        values, vectors = np.linalg.eigh((crossed + crossed.T) / 2)
        precision = (vectors * (np.maximum(values, 0) + NOTHING_KNOWN**-2)) @ vectors.T
        return cls(first, second, (lobes[0] - lobes[1])[..., 1], solved, precision)

    def error_of_rays(self, sums_of_texels: Callable[[Double], Double]) -> tuple[float, float]:
        """Standard deviations of phi and psi that the rays' noise alone brings about.

        (phi, psi) solve J1' C^-1 (I - M2) + J2' C^-1 (I - M1) = 0, M being the predicted lobe and J
        its derivatives. Noise in them moves the solution by H^-1 / 2 times the sum over both of
        J' C^-1 n and, the other way, d' C^-1 e; e is what is left of the samples. A sum of two
        independent noises has the variance of their difference, which is known. Rays of different
        texels are independent, those of one texel's views hang together.
        """
        along = (self.solved[..., :2] + self.solved[..., 2:4]) / 2
        each = np.einsum("pci,pc->pi", along, self.between)
        left = self.solved[..., 4:].mean(axis=-1)
        each -= np.einsum("pci,pc->pi", self.by_first - self.by_second, left)
        pull = sums_of_texels(each) / 2
        by_phi, by_psi = np.sqrt(((pull @ np.linalg.inv(self.precision)) ** 2).sum(axis=0))
        return float(by_phi), float(by_psi)

    def scatter(self, groups: Sequence[Long]) -> tuple[float, float]:
        """By how much the variances of phi and psi exceed what C tells, 1 or more, as the samples
        of a frame, or of a place, pull them together the same way; ``groups``: of each kind the
        group of each sample, (P,). Of all kinds the largest, by H^-1 J H^-1, J being the sum over
        groups of their pulls' squares (K.-Y. Liang and S. L. Zeger, Longitudinal data analysis
        using generalized linear models, 1986)."""
        each = np.einsum("pci,pc->pi", self.by_first, self.solved[..., 5])
        each += np.einsum("pci,pc->pi", self.by_second, self.solved[..., 4])
        told, largest = np.linalg.inv(self.precision), np.ones(2)
        for group in groups:
            number = int(group.max()) + 1
            if number <= each.shape[1]:  # as many numbers as phi and psi scatter by nothing
                continue
            pull = np.stack([np.bincount(group, one, number) for one in each.T], axis=1) / 2
            moved = (pull - pull.mean(axis=0)) @ told
            square = (moved**2).sum(axis=0) * number / (number - each.shape[1])
            largest = np.maximum(largest, square / np.diagonal(told))
        return float(largest[0]), float(largest[1])


def first_seed(seed: int) -> int:
    """Of the fit that tells whether others are needed; no other ``seed`` brings it about."""
    return (_REPEATS + 1) * seed


def repeated_where_noisy(
    first: LobeEstimate, fit: Callable[[int, int], LobeEstimate], seed: int
) -> LobeEstimate:
    """The first fit, whose rays followed from ``first_seed(seed)``, or, where their noise matters
    to what it tells, the mean of several ``fit(seed, repeats)`` with rays of their own."""
    noisy = np.any(np.array(first.of_rays) > _NOISY * np.array([first.phi_error, first.psi_error]))
    if not noisy or first.evidence < SOME_EVIDENCE:
        return mean_of_repeats([first])
    seeds = range(first_seed(seed) + 1, first_seed(seed + 1))
    return mean_of_repeats([fit(own_seed, _REPEATS) for own_seed in seeds])


def mean_of_repeats(found: Sequence[LobeEstimate]) -> LobeEstimate:
    """The mean of fits that differ in their rays alone, its stated errors with the rays' share:
    from their scatter, or as each of them says, whichever is more."""
    values = np.array([[one.phi, one.psi] for one in found])
    stated = np.array([[one.phi_error, one.psi_error] for one in found])
    # Not their mean: with much noise H, and so what one of them says, may be far off.
    of_rays = np.median([one.of_rays for one in found], axis=0)
    if len(found) > 1:
        of_rays = np.maximum(of_rays, values.std(axis=0, ddof=1))
    of_rays /= np.sqrt(len(found))
    errors = np.minimum(np.hypot(stated.mean(axis=0), of_rays), NOTHING_KNOWN)
    names = ("phi", "psi", "unresolved", "cost", "evidence", "contradiction", *POSTERIOR)
    return LobeEstimate(
        **{name: float(np.mean([getattr(one, name) for one in found])) for name in names},
        phi_error=float(errors[0]),
        psi_error=float(errors[1]),
        of_rays=(float(of_rays[0]), float(of_rays[1])),
    )


# Roughnesses that are tried, and how many more between the best one and each neighbour of it.
_LEVEL_1 = (
    0.0, 0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9,
    1.0,
)  # fmt: skip
_LEVEL_2 = 3
# Steps of expectation maximisation, each after a search of level 1, with another candidate or
# another kind of lobe than the first.
_MORE = 2


class Candidate(NamedTuple):
    """What the lobe would look like with one footprint of the samples.

    first, second, third  roughnesses (K,) -> (base, slope) of I_nd = base + psi slope, (P, 3, K)
                          each, with independent noise
    blur                  standard deviation of the normal over a footprint, in radians
    likely                how likely the footprint is, before the samples are asked

    Noise squared would draw psi towards 0; the product of two independent noises does not. But
    weights that follow from these two would choose samples in which they cancel, and draw psi up:
    weights are the third's.
    """

    first: OfPhis
    second: OfPhis
    third: OfPhis
    blur: float
    likely: float = 1.0


class _Fit:
    """One candidate and the samples, at the model's present variances."""

    def __init__(self, candidate: Candidate, model: ViewModel, radiance: Float) -> None:
        self._candidate, self._model, self._radiance = candidate, model, radiance[..., None]
        # Two bases of level 1 for costs, one at single roughnesses for weights.
        self._first, self._second = candidate.first(_LEVEL_1), candidate.second(_LEVEL_1)
        self._of_weights = cache(lambda phi: candidate.third([phi]))

    def coarse(self) -> Double:
        """The costs' terms at level 1."""
        return self._terms(self._first, self._second)

    def improve(self) -> None:
        """The variances, from what the best lobe leaves."""
        _, best, psi = _least(self.coarse())
        base, slope = self._of_weights(_LEVEL_1[best])
        self._model.update((base + psi * slope)[..., 0])

    def estimate(self, coarse: Double, without: float, repeats: int) -> LobeEstimate:
        """The lobe, searched more closely than at level 1. without: the cost without specular
        light."""
        _, best, _ = _least(coarse)
        ends = _LEVEL_1[max(best - 1, 0) : best + 2]
        steps = [np.linspace(low, high, _LEVEL_2 + 2)[1:-1] for low, high in pairwise(ends)]
        between = [float(phi) for part in steps for phi in part]
        closer = self._candidate.first(between), self._candidate.second(between)
        order = np.argsort([*_LEVEL_1, *between])
        phis = np.array([*_LEVEL_1, *between])[order]
        terms = np.concatenate([coarse, self._terms(*closer)])[order]
        least, best, psi = _least(terms)
        near = [max(best - 1, 0), best, min(best + 1, len(phis) - 1)]
        bases = (
            _chosen(self._first, closer[0], order[near]),
            _chosen(self._second, closer[1], order[near]),
        )
        # The cost with the bases' own noise in it: the mean of either basis' squares.
        lobes = [(base + np.float32(psi) * slope)[..., 1:2] for base, slope in bases]
        rest = self._model.reduced(self._radiance - np.concatenate(lobes, axis=2))
        noisy = least + (float(self._model.product(rest, rest).mean()) - least) / repeats
        freedom = self._model.degrees_of_freedom
        neighbours = phis[near].tolist()
        linear = Linear.about(self._model, self._radiance[..., 0], bases, neighbours, psi)
        of_rays = linear.error_of_rays(self._model.sums_of_texels)
        scatter = linear.scatter(self._model.groups)
        of_mean = of_rays[0] / math.sqrt(repeats), of_rays[1] / math.sqrt(repeats)
        blur = self._candidate.blur
        found = lobe_from_costs(phis, terms, without, noisy, freedom, blur, scatter, of_mean)
        return found._replace(of_rays=of_rays)

    def _terms(self, first: Pair, second: Pair) -> Double:
        """c0, c1, c2 of cost(psi) = c0 - 2 psi c1 + psi^2 c2 at each roughness, (K, 3), from bases
        (P, 3, K) with independent noise."""
        model = self._model
        sets = self._radiance - first[0], self._radiance - second[0], first[1], second[1]
        rest, other_rest, slope, other_slope = model.reduced(np.concatenate(sets, axis=2)).parts(4)
        crossed = model.product(slope, other_rest) + model.product(other_slope, rest)
        square, constant = model.product(slope, other_slope), model.product(rest, other_rest)
        return np.stack([constant, crossed / 2, square], axis=1)


def _chosen(one: Pair, other: Pair, which: Long) -> Pair:
    """Of bases at some roughnesses and at others, those at ``which`` (K,) of all."""
    base, slope = (np.concatenate(both, axis=2) for both in zip(one, other, strict=True))
    return base.take(which, axis=2), slope.take(which, axis=2)


def _least(terms: Double) -> tuple[float, int, float]:
    """The least cost, with the index of its roughness and its psi in [0, 1]."""
    psi, cost, _ = least_costs(terms, float(terms[:, 0].max()))
    best = int(cost.argmin())
    return float(cost[best]), best, float(psi[best])


def log_of_ratio(coarse: Iterable[Double], others: Iterable[Double]) -> float:
    """ln of the least cost over footprints and roughnesses of level 1 over that of another kind of
    lobe that shares the model, from the costs' terms at the same variances; 0, as if the two
    explained the same, where the rays' noise makes either cost negative."""
    one, other = (min(_least(terms)[0] for terms in kind) for kind in (coarse, others))
    return math.log(one / other) if min(one, other) > 0 else 0.0


class FittedKind(NamedTuple):
    """A kind of lobe fitted to samples; another may go on from it.

    lobe       what was found
    log_ratio  ln of its cost over the cost of the kind that was fitted before it, 0 if none was:
               the mean of what the models of errors say that were found with either kind, since
               each takes the side of its own
    model      of the samples' errors, as it is now; fits: of each footprint
    """

    lobe: LobeEstimate
    log_ratio: float
    model: ViewModel
    fits: Sequence[_Fit]


def fit_lobe(
    samples: ViewSamples,
    candidates: Sequence[Candidate],
    repeats: int = 1,
    before: FittedKind | None = None,
) -> FittedKind:
    """The lobe that explains the samples best, averaged over the footprints that may be theirs.
    Its errors are those of the mean of so many ``repeats`` with rays of their own.

    The variances of the samples' errors are found with the first candidate, or improved from those
    of the kind of lobe that was fitted ``before``, and again with the candidate that is best with
    these. With them fixed all candidates are fitted and compared.
    """
    model = before.model if before else ViewModel(samples)
    fits = [_Fit(candidate, model, samples.radiance) for candidate in candidates]

    def log_ratio(coarse: Iterable[Double]) -> float:
        return log_of_ratio(coarse, (fit.coarse() for fit in before.fits)) if before else 0.0

    with_old = log_ratio(fit.coarse() for fit in fits)
    for _ in range(_MORE if before else UPDATES):
        fits[0].improve()
    coarse = [fit.coarse() for fit in fits]
    with_new = log_ratio(coarse)
    best = int(np.argmin([_least(terms)[0] for terms in coarse]))
    if best > 0:
        for _ in range(_MORE):
            fits[best].improve()
        coarse = [fit.coarse() for fit in fits]
    whole = model.reduced(samples.radiance[..., None])
    without = float(model.product(whole, whole)[0])
    estimates = [
        fit.estimate(terms, without, repeats) for fit, terms in zip(fits, coarse, strict=True)
    ]
    likely = [candidate.likely for candidate in candidates]
    lobe = averaged(estimates, model.degrees_of_freedom, likely)
    lobe = lobe._replace(contradiction=model.contradiction)
    return FittedKind(lobe, (with_old + with_new) / 2, model, fits)
