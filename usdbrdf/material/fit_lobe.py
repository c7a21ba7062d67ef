"""The lobe that explains many views best: two levels of roughness, specular in closed form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from usdbrdf.material.lobe_posterior import LobeEstimate, averaged, lobe_from_costs
from usdbrdf.material.view_model import ViewModel, ViewSamples

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Basis = Callable[[float], tuple[Float, Float]]

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

    first, second, third  phi -> (base, slope) of I_nd = base + psi slope, (P, 3) each, with
                          independent noise
    blur                  standard deviation of the normal over a footprint, in radians

    Noise squared would draw psi towards 0; the product of two independent noises does not. But
    weights that follow from these two would choose samples in which they cancel, and draw psi up:
    weights are the third's.
    """

    first: Basis
    second: Basis
    third: Basis
    blur: float


@dataclass(frozen=True, kw_only=True)
class _Search:
    """c0, c1, c2 of cost(psi) = c0 - 2 psi c1 + psi^2 c2 at each roughness, (K, 3)."""

    phis: Sequence[float]
    terms: Double

    @property
    def least(self) -> tuple[float, int, float]:
        """The least cost, with the index of its roughness and its psi in [0, 1]."""
        square = np.maximum(self.terms[:, 2], 1e-12 * max(float(self.terms[:, 0].max()), 1.0))
        psi = np.clip(self.terms[:, 1] / square, 0, 1)
        cost = self.terms[:, 0] - 2 * psi * self.terms[:, 1] + psi**2 * square
        best = int(cost.argmin())
        return float(cost[best]), best, float(psi[best])


def fit_lobe(samples: ViewSamples, candidates: Sequence[Candidate]) -> LobeEstimate:
    """The lobe that explains the samples best, averaged over the footprints that may be theirs.

    The errors' variances are found with the first candidate, and improved with the one that is best
    with these. With them fixed all candidates are fitted and compared.
    """
    model = ViewModel(samples)
    tables = [_Table(candidate) for candidate in candidates]
    for _ in range(_UPDATES):
        _improve(model, samples, tables[0])
    coarse = [_search(model, samples.radiance, table, _LEVEL_1) for table in tables]
    best = int(np.argmin([search.least[0] for search in coarse]))
    if best > 0:
        for _ in range(_MORE):
            _improve(model, samples, tables[best])
        coarse = [_search(model, samples.radiance, table, _LEVEL_1) for table in tables]
    whole = model.reduced(samples.radiance)
    without = model.product(whole, whole)
    estimates = [
        _estimate(model, samples.radiance, table, _LEVEL_1[search.least[1]], without, blur)
        for table, search, blur in zip(tables, coarse, [c.blur for c in candidates], strict=True)
    ]
    return averaged(estimates, model.degrees_of_freedom)


def _estimate(
    model: ViewModel, radiance: Float, table: _Table, near: float, without: float, blur: float
) -> LobeEstimate:
    """One candidate's lobe, searched closely about the roughness ``near``, with the variances as
    they are. without: the cost without specular light."""
    fine = _search(model, radiance, table, _with_level_2(near))
    return lobe_from_costs(
        np.array(fine.phis),
        fine.terms,
        without,
        _cost_with_noise(model, radiance, table, fine),
        model.degrees_of_freedom,
        blur,
    )


class _Table:
    """A candidate's bases, evaluated once per roughness: two for costs, one for weights."""

    def __init__(self, candidate: Candidate) -> None:
        self.at = cache(lambda phi: (candidate.first(phi), candidate.second(phi)))
        self.of_weights = cache(candidate.third)


def _improve(model: ViewModel, samples: ViewSamples, table: _Table) -> None:
    _, best, psi = _search(model, samples.radiance, table, _LEVEL_1).least
    base, slope = table.of_weights(_LEVEL_1[best])
    model.update(base + psi * slope)


def _search(model: ViewModel, radiance: Float, table: _Table, phis: Sequence[float]) -> _Search:
    bases = [basis for phi in phis for basis in table.at(phi)]
    rest = model.all_reduced([radiance - base for base, _ in bases])
    slopes = model.all_reduced([slope for _, slope in bases])
    terms = np.zeros((len(phis), 3))
    for k in range(len(phis)):
        pair, slope = rest[2 * k : 2 * k + 2], slopes[2 * k : 2 * k + 2]
        crossed = model.product(slope[0], pair[1]) + model.product(slope[1], pair[0])
        terms[k] = model.product(*pair), crossed / 2, model.product(*slope)
    return _Search(phis=phis, terms=terms)


def _cost_with_noise(model: ViewModel, radiance: Float, table: _Table, found: _Search) -> float:
    """The least cost with the bases' own noise in it: the mean of either basis' squares."""
    _, best, psi = found.least
    rest = [
        model.reduced(radiance - base - psi * slope) for base, slope in table.at(found.phis[best])
    ]
    return sum(model.product(one, one) for one in rest) / len(rest)


def _with_level_2(near: float) -> list[float]:
    """Level 1, and more roughnesses on both sides of ``near``, one of its own."""
    best = _LEVEL_1.index(near)
    ends = [_LEVEL_1[k] for k in range(max(best - 1, 0), min(best + 2, len(_LEVEL_1)))]
    between = [np.linspace(low, high, _LEVEL_2 + 2)[1:-1] for low, high in pairwise(ends)]
    return sorted({*_LEVEL_1, *(float(phi) for part in between for phi in part)})
