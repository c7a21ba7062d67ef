"""What the noise of the rays does to a fit, and the mean of fits with rays of their own.

A mirror shows a lamp in few of its samples, and few rays meet it there: then psi depends on which.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from usdbrdf.material.lobe_posterior import NOTHING_KNOWN, LobeEstimate
from usdbrdf.material.verdict import SOME_EVIDENCE
from usdbrdf.material.view_model import ViewModel

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Pair = tuple[Float, Float]

# Where what the rays do is more than this share of the samples' errors, the fit is the mean of so
# many with rays of their own.
_NOISY, _REPEATS = 0.5, 4


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
