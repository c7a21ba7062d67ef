"""What the errors of light that was inferred, not seen, make of a lobe that mirrors it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from usdbrdf.material.conductor import Conductor
from usdbrdf.material.fit_views import SampledObject, of_metal, tint_of
from usdbrdf.material.verdict import MAX_PSI_ERROR, NOTHING_KNOWN, SOME_EVIDENCE, LobeEstimate
from usdbrdf.material.view_model import UPDATES, ViewModel
from usdbrdf.model.arrays import Float
from usdbrdf.transport.brdf import F0_OF_PSI

_UPPER = 1.645  # standard deviations that are exceeded with a probability of 5 %
_SEED_OF_DOUBT = 0xD0B7


def with_doubts_of_light(
    lobe: int,
    sampled: Callable[[], SampledObject],
    seed: int,
    found: LobeEstimate,
    metal: Conductor | None,
) -> tuple[LobeEstimate, Conductor | None]:
    """The same with the errors that follow from those of light that was inferred, not seen: what a
    lobe mirrors of a lamp is psi times the lamp's radiance, and only that is measured. All doubts
    are taken to be off the same way. Where psi of a dielectric is badly known anyway nothing is
    traced."""
    untold = found.evidence < SOME_EVIDENCE or found.psi_error > MAX_PSI_ERROR
    if untold and metal is None:
        return found, metal
    kind, phi, psi = lobe, found.phi, found.psi
    if metal is not None:
        kind, phi, psi = of_metal(lobe), metal.phi, max(metal.f0) / F0_OF_PSI
    tint = tint_of(metal) if metal is not None else np.ones((3, 1), np.float32)
    off = error_by_doubt(sampled(), kind, phi, psi, seed, tint)
    if metal is not None:
        error = min(math.hypot(metal.f0_error, F0_OF_PSI * off), float(NOTHING_KNOWN))
        metal = metal._replace(f0_error=error)
        off *= found.psi / psi if psi > 0 else 1.0
    psi_error = min(math.hypot(found.psi_error, off), float(NOTHING_KNOWN))
    above = math.hypot(found.psi_upper - found.psi, _UPPER * off)
    upper = min(max(found.psi_upper, found.psi + above), 1.0)
    return found._replace(psi_error=psi_error, psi_upper=upper), metal


def error_by_doubt(
    sampled: SampledObject, kind: int, phi: float, psi: float, seed: int, tint: Float
) -> float:
    """By how much psi would be off if all light were by its standard error: what a lobe would then
    mirror more, or less, as the samples tell psi; psi itself where they do not. tint (3, 1): of
    what is mirrored."""
    model = ViewModel(sampled.samples)
    first = 3 * (_SEED_OF_DOUBT + seed)

    def lobe(own_seed: int, *, of_doubt: bool = False) -> tuple[Float, Float]:
        base, slope = sampled.lobe(kind, phi, own_seed, of_doubt=of_doubt)
        return base, tint * slope

    lobes = [lobe(first + n) for n in range(2)]
    shown = np.mean([base + np.float32(psi) * slope for base, slope in lobes], axis=0)[..., 0]
    for _ in range(UPDATES):
        model.update(shown)
    base, slope = lobe(first + 2, of_doubt=True)
    slopes = [slope for _, slope in lobes]
    values = np.concatenate([*slopes, base + np.float32(psi) * slope], axis=2)
    one, other, doubt = model.reduced(values).parts(3)
    # Products of independent noises are none on the mean.
    whole = float(model.product(one, other)[0])
    part = (float(model.product(one, doubt)[0]) + float(model.product(other, doubt)[0])) / 2
    return max(part / whole, 0.0) if whole > 0 else psi
