"""How badly S is known by the lights that were inferred: relative standard errors of it."""

from __future__ import annotations

import math

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.texels import Texels
from usdbrdf.shading.clipped_light import ClippedLight
from usdbrdf.shading.outside import Outside
from usdbrdf.shading.unseen_lamps import UnseenLamps
from usdbrdf.transport.environment import mean_radiance

_EVEN, _LEAST_UNEVEN, _FOLLOWS = calibration.numbers("emitters.even")


def doubt_of_outside(outside: Outside | None, lit: Float, measured: Bool) -> float:
    """By the light from outside. A sun may be all the light of what it shines on, and its error is
    that of S there. Of a sky alone, which a crack lets in as well, what it sends in on the mean
    counts, beside what those surfaces that were ``measured`` (T,) send on, ``lit`` (T, 3)."""
    if outside is None or not measured.any():
        return 0.0
    if outside.environment.sun.shines or not outside.is_estimated:
        return outside.doubt
    sky = mean_radiance(outside.environment.image)
    kept = float(np.median(lit[measured].mean(axis=1)))
    return outside.doubt * min(outside.open_share * sky / max(kept, 1e-30), 1.0)


def doubt_of_irradiance(
    texels: Texels,
    light: ClippedLight,
    unseen: UnseenLamps,
    outside: Outside | None,
    measured: Bool,
    irradiance: Float,
) -> float:
    """By the lamps that clip or that no frame shows, weighed by their power, and what is outside.
    All lamps, measured ones and the sky too, send at least what ``measured`` surfaces do not send
    on of S, ``irradiance`` (T, 3): the sky falls on the outside of walls too, which lights nothing
    that was measured."""
    clipped, owner = light.groups, texels.object_index()
    lamps = [
        (float(light.estimate.standard_error[k].max()), clipped.group == k)
        for k in np.flatnonzero(clipped.lamp & light.estimate.determined)
    ]
    numbers = zip(unseen.error.tolist(), unseen.object.tolist(), strict=True)
    lamps += [(error, owner == number) for error, number in numbers]
    power, doubt, inferred = 0.0, 0.0, np.zeros(len(texels.area), np.bool_)
    for error, own in lamps:
        one = float(texels.area[own] @ light.lit[own].mean(axis=1))
        power, doubt, inferred = power + one, math.hypot(doubt, error * one), inferred | own
    kept = np.maximum(irradiance / np.pi - light.lit, 0).mean(axis=1)
    told = measured & ~inferred
    every = max(power, float(texels.area[told] @ kept[told]), 1e-30)
    return math.hypot(doubt / every, doubt_of_outside(outside, light.lit, measured))


def shines_evenly(
    texels: Texels, radiance: Float, irradiance: Float, error: Float, measured: Bool
) -> Bool:
    """Objects (num_objects,) that are ``measured`` (T,) to be evenly bright in light that is not.

    A diffuse reflector follows what reaches it, however badly the level of that is known: log L_d
    varies as much as log S does, and by its texture more. radiance, L_d; irradiance, S, and its
    standard ``error``, whose part of the variance is taken off: (T, 3).
    """
    light, reaches, off = (values.mean(axis=1) for values in (radiance, irradiance, error))
    told = measured & (light > 0) & (reaches > 0)
    found = np.zeros(len(texels.resolution), np.bool_)
    for i in range(len(found)):
        own = texels.of_object(i).start + np.flatnonzero(told[texels.of_object(i)])
        area = texels.area[own].astype(np.float64)
        if not area.any():
            continue
        # Where rays missed a lamp by chance S is small, and so is the error that they tell of it.
        level = float(np.average(reaches[own], weights=area))
        noise = float(np.average((off[own] / level) ** 2, weights=area))
        bright, lit = (_middle(values[own], area) for values in (light, reaches))
        of_light, of_irradiance = (_variance(logs, area) for logs in (bright, lit))
        # What the error itself makes most of says nothing; and where lamps are told wrong, S may
        # vary too much, but what a reflector shows of that still follows it.
        found[i] = of_irradiance > max(2 * noise, _LEAST_UNEVEN**2)
        found[i] &= of_light < _EVEN * (of_irradiance - noise)
        found[i] &= _correlation(bright, lit, area) < _FOLLOWS
    return found


def _middle(values: Float, weights: Double) -> Double:
    """Logarithms of the values, none beyond the middle nine tenths of them: a rim that touches
    something, and has next to no light, plays no part."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order]) - weights[order] / 2
    ends = np.interp(np.array([0.05, 0.95]) * weights.sum(), below, values[order])
    low, high = np.maximum(ends, 1e-30)
    return np.asarray(np.log(np.clip(values, low, high)), np.float64)


def _variance(values: Double, weights: Double) -> float:
    mean = np.average(values, weights=weights)
    return float(np.average((values - mean) ** 2, weights=weights))


def _correlation(one: Double, other: Double, weights: Double) -> float:
    means = [np.average(values, weights=weights) for values in (one, other)]
    both = float(np.average((one - means[0]) * (other - means[1]), weights=weights))
    return both / max(math.sqrt(_variance(one, weights) * _variance(other, weights)), 1e-30)
