"""The lobe that explains many views best: two levels of roughness, specular in closed form; and
what the noise of the rays does to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np

from usdbrdf import calibration
from usdbrdf.material.lobe_posterior import (
    NOTHING_KNOWN,
    LobeEstimate,
    averaged,
    least_costs,
    lobe_from_costs,
)
from usdbrdf.material.verdict import SOME_EVIDENCE
from usdbrdf.material.view_model import ViewModel, ViewSamples
from usdbrdf.model.arrays import Double, Float
from usdbrdf.transport.lobe_radiance import Basis

Pair = tuple[Float, Float]
# Where what the rays do is more than this share of the samples' errors, the fit is the mean of so
# many with rays of their own.
_NOISY = calibration.number("fit.noisy_rays")
_REPEATS = 4


def error_of_rays(
    model: ViewModel, radiance: Float, bases: tuple[Pair, Pair], phis: Sequence[float], psi: float
) -> tuple[float, float]:
    """Standard deviations of phi and psi that the rays' noise alone brings about.

    radiance  (P, 3) of the samples
    bases     twice (base, slope), (P, 3, 3) each, with independent noise, at three ``phis``: the
              one that was found and its neighbours

    (phi, psi) solve J1' C^-1 (I - M2) + J2' C^-1 (I - M1) = 0, M being the predicted lobe and J its
    derivatives. Noise in them moves the solution by H^-1 / 2 times the sum over both of J' C^-1 n
    and, the other way, d' C^-1 e; H = J1' C^-1 J2, e what is left of the samples. A sum of two
    independent noises has the variance of their difference, which is known. Rays of different
    texels are independent, those of one texel's views hang together.
    """
    lobes = [base + np.float32(psi) * slope for base, slope in bases]
    step = phis[2] - phis[0]
    first, second = (
        np.stack([(lobe[..., 2] - lobe[..., 0]) / step, slope[..., 1]], axis=-1)
        for lobe, (_, slope) in zip(lobes, bases, strict=True)
    )
    left = radiance - (lobes[0] + lobes[1])[..., 1] / 2
    solved = model.solved(np.concatenate([first, second, left[..., None]], axis=-1))
    along = (solved[..., :2] + solved[..., 2:4]) / 2
    each = np.einsum("pci,pc->pi", along, (lobes[0] - lobes[1])[..., 1])
    each -= np.einsum("pci,pc->pi", first - second, solved[..., 4])
    pull = model.sums_of_texels(each) / 2
    crossed = np.einsum("pci,pcj->ij", solved[..., :2], second)
    moved = pull @ _inverse((crossed + crossed.T) / 2)
    by_phi, by_psi = np.sqrt((moved**2).sum(axis=0))
    return float(by_phi), float(by_psi)


def _inverse(normal: Double) -> Double:
    """Of a symmetric matrix with the prior's precision: noise may leave less than that of it."""
    values, vectors = np.linalg.eigh(normal)
    found: Double = (vectors / (np.maximum(values, 0) + NOTHING_KNOWN**-2)) @ vectors.T
    return found


def repeated_where_noisy(fit: Callable[[int, int], LobeEstimate], seed: int) -> LobeEstimate:
    """``fit(seed, repeats)`` gets its rays from its seed. One fit, or, where their noise matters to
    what it tells, the mean of several; these have seeds that no other ``seed`` brings about."""
    first = (_REPEATS + 1) * seed
    one = fit(first, 1)
    noisy = np.any(np.array(one.of_rays) > _NOISY * np.array([one.phi_error, one.psi_error]))
    if not noisy or one.evidence < SOME_EVIDENCE:
        return mean_of_repeats([one])
    return mean_of_repeats([fit(first + k, _REPEATS) for k in range(1, _REPEATS + 1)])


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
    means = {
        name: float(np.mean([getattr(one, name) for one in found]))
        for name in ("phi", "psi", "unresolved", "cost", "evidence")
    }
    return LobeEstimate(
        **means,
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
# Steps of expectation maximisation, each after a search of level 1; and how many more with another
# candidate than the first.
_UPDATES, _MORE = 4, 2


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What the lobe would look like with one footprint of the samples.

    first, second, third  roughnesses (K,) -> (base, slope) of I_nd = base + psi slope, (P, 3, K)
                          each, with independent noise
    blur                  standard deviation of the normal over a footprint, in radians
    likely                how likely the footprint is, before the samples are asked

    Noise squared would draw psi towards 0; the product of two independent noises does not. But
    weights that follow from these two would choose samples in which they cancel, and draw psi up:
    weights are the third's.
    """

    first: Basis
    second: Basis
    third: Basis
    blur: float
    likely: float = 1.0


@dataclass(frozen=True, kw_only=True)
class _Search:
    """c0, c1, c2 of cost(psi) = c0 - 2 psi c1 + psi^2 c2 at each roughness, (K, 3)."""

    phis: Sequence[float]
    terms: Double

    @property
    def least(self) -> tuple[float, int, float]:
        """The least cost, with the index of its roughness and its psi in [0, 1]."""
        psi, cost, _ = least_costs(self.terms, float(self.terms[:, 0].max()))
        best = int(cost.argmin())
        return float(cost[best]), best, float(psi[best])

    def and_more(self, other: _Search) -> _Search:
        """Both, with ascending roughnesses."""
        phis = [*self.phis, *other.phis]
        order = np.argsort(phis)
        terms = np.concatenate([self.terms, other.terms])[order]
        return _Search(phis=[phis[k] for k in order], terms=terms)


def fit_lobe(
    samples: ViewSamples, candidates: Sequence[Candidate], repeats: int = 1
) -> LobeEstimate:
    """The lobe that explains the samples best, averaged over the footprints that may be theirs.
    Its errors are those of the mean of so many ``repeats`` with rays of their own.

    The errors' variances are found with the first candidate, and improved with the one that is best
    with these. With them fixed all candidates are fitted and compared.
    """
    model = ViewModel(samples)
    radiance = samples.radiance[..., None]
    tables = [_Table(candidate) for candidate in candidates]
    for _ in range(_UPDATES):
        _improve(model, radiance, tables[0])
    coarse = [_search(model, radiance, table) for table in tables]
    best = int(np.argmin([search.least[0] for search in coarse]))
    if best > 0:
        for _ in range(_MORE):
            _improve(model, radiance, tables[best])
        coarse = [_search(model, radiance, table) for table in tables]
    whole = model.reduced(radiance)
    without = float(model.product(whole, whole)[0])
    estimates = [
        _estimate(model, radiance, candidate, search, without, repeats)
        for candidate, search in zip(candidates, coarse, strict=True)
    ]
    likely = [candidate.likely for candidate in candidates]
    return averaged(estimates, model.degrees_of_freedom, likely)


def _estimate(
    model: ViewModel,
    radiance: Float,
    candidate: Candidate,
    coarse: _Search,
    without: float,
    repeats: int,
) -> LobeEstimate:
    """One candidate's lobe, searched more closely than ``coarse``, with the variances as they are.
    without: the cost without specular light."""
    between = _level_2(_LEVEL_1[coarse.least[1]])
    bases = candidate.first(between), candidate.second(between)
    more = _Search(phis=between, terms=_terms(model, radiance, *bases))
    fine = coarse.and_more(more)
    least, best, psi = fine.least
    near = [fine.phis[k] for k in (max(best - 1, 0), best, min(best + 1, len(fine.phis) - 1))]
    bases = candidate.first(near), candidate.second(near)
    noisy = least + (_cost_with_noise(model, radiance, bases, psi) - least) / repeats
    found = lobe_from_costs(
        np.array(fine.phis), fine.terms, without, noisy, model.degrees_of_freedom, candidate.blur
    )
    of_rays = error_of_rays(model, radiance[..., 0], bases, near, psi)
    return replace(found, of_rays=of_rays)


class _Table:
    """A candidate's bases: two of level 1 for costs, one at single roughnesses for weights."""

    def __init__(self, candidate: Candidate) -> None:
        self.first, self.second = candidate.first(_LEVEL_1), candidate.second(_LEVEL_1)
        self.of_weights = cache(lambda phi: candidate.third([phi]))


def _improve(model: ViewModel, radiance: Float, table: _Table) -> None:
    _, best, psi = _search(model, radiance, table).least
    base, slope = table.of_weights(_LEVEL_1[best])
    model.update((base + psi * slope)[..., 0])


def _search(model: ViewModel, radiance: Float, table: _Table) -> _Search:
    return _Search(phis=_LEVEL_1, terms=_terms(model, radiance, table.first, table.second))


def _terms(model: ViewModel, radiance: Float, first: Pair, second: Pair) -> Double:
    """c0, c1, c2 of each roughness, (K, 3), from bases (P, 3, K) with independent noise."""
    sets = radiance - first[0], radiance - second[0], first[1], second[1]
    rest, other_rest, slope, other_slope = model.reduced(np.concatenate(sets, axis=2)).parts(4)
    crossed = model.product(slope, other_rest) + model.product(other_slope, rest)
    return np.stack(
        [model.product(rest, other_rest), crossed / 2, model.product(slope, other_slope)], axis=1
    )


def _cost_with_noise(
    model: ViewModel, radiance: Float, bases: tuple[Pair, Pair], psi: float
) -> float:
    """The cost of the lobe in the middle of three, with the bases' own noise in it: the mean of
    either basis' squares."""
    sets = [radiance - (base + np.float32(psi) * slope)[..., 1:2] for base, slope in bases]
    rest = model.reduced(np.concatenate(sets, axis=2))
    return float(model.product(rest, rest).mean())


def _level_2(near: float) -> list[float]:
    """More roughnesses on both sides of ``near``, one of level 1."""
    best = _LEVEL_1.index(near)
    ends = [_LEVEL_1[k] for k in range(max(best - 1, 0), min(best + 2, len(_LEVEL_1)))]
    between = [np.linspace(low, high, _LEVEL_2 + 2)[1:-1] for low, high in pairwise(ends)]
    return [float(phi) for part in between for phi in part]
