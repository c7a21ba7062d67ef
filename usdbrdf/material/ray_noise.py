"""What the noise of the rays does to a fit, and the mean of fits with rays of their own.

A mirror shows a lamp in few of its samples, and few rays meet it there: then psi depends on which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from usdbrdf.material.lobe_posterior import NOTHING_KNOWN, LobeEstimate
from usdbrdf.material.view_model import ViewModel

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Pair = tuple[Float, Float]


def error_of_rays(
    model: ViewModel, first: Pair, second: Pair, phis: Sequence[float], psi: float
) -> tuple[float, float]:
    """Standard deviations of phi and psi that the rays' noise alone brings about.

    first, second  (base, slope), (P, 3, 3) each, with independent noise, at three ``phis``: the one
                   that was found and its neighbours

    Gauss-Newton: noise n in the predicted lobe moves (phi, psi) by H^-1 J' C^-1 n, H = J' C^-1 J.
    The difference of the two predictions has twice the variance of one, four times that of their
    mean. Rays of different texels are independent, those of one texel's views are the same. This is
    of first order: strong noise also moves the samples' weights, and does some times as much.
    """
    lobes = [base + np.float32(psi) * slope for base, slope in (first, second)]
    by_phi, by_psi = (lobes[0] + lobes[1]) / 2, (first[1] + second[1]) / 2
    step = phis[2] - phis[0]
    along = np.stack([(by_phi[..., 2] - by_phi[..., 0]) / step, by_psi[..., 1]], axis=-1)
    solved = model.solved(along)
    normal = np.einsum("pci,pcj->ij", solved, along) + np.eye(2) / NOTHING_KNOWN**2
    noise = (lobes[0] - lobes[1])[..., 1]
    pull = model.of_texels(np.einsum("pci,pc->pi", solved, noise)) / 2
    inverse = np.linalg.inv(normal)
    phi, of_psi = np.sqrt(np.diag(inverse @ (pull.T @ pull) @ inverse))
    return float(phi), float(of_psi)


def mean_of_repeats(found: Sequence[LobeEstimate]) -> LobeEstimate:
    """The mean of fits that differ in their rays alone, its stated errors with the rays' share:
    from their scatter, or as each of them says, whichever is more."""
    values = np.array([[one.phi, one.psi] for one in found])
    stated = np.array([[one.phi_error, one.psi_error] for one in found])
    of_rays = np.sqrt((np.array([one.of_rays for one in found]) ** 2).mean(axis=0))
    if len(found) > 1:
        of_rays = np.maximum(of_rays, values.std(axis=0, ddof=1))
    of_rays /= np.sqrt(len(found))
    phi, psi = values.mean(axis=0)
    errors = np.minimum(np.hypot(stated.mean(axis=0), of_rays), NOTHING_KNOWN)
    return replace(
        found[0],
        phi=float(phi),
        psi=float(psi),
        phi_error=float(errors[0]),
        psi_error=float(errors[1]),
        unresolved=float(np.mean([one.unresolved for one in found])),
        cost=float(np.mean([one.cost for one in found])),
        evidence=float(np.mean([one.evidence for one in found])),
        of_rays=(float(of_rays[0]), float(of_rays[1])),
    )
