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

_EVEN = calibration.number("emitters.even")


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

    A reflector follows what reaches it, however badly the level of that is known: log L_d varies
    as much as log S does, and by its texture more. radiance, L_d; irradiance, S, and its standard
    ``error``, whose part of the variance is taken off: (T, 3).
    """
    light, reaches = radiance.mean(axis=1), irradiance.mean(axis=1)
    noise = error.mean(axis=1) / np.maximum(reaches, 1e-30)
    told = measured & (light > 0) & (reaches > 0)
    found = np.zeros(len(texels.resolution), np.bool_)
    for i in range(len(found)):
        own = texels.of_object(i)
        some = told[own]
        if not texels.area[own][some].any():
            continue
        area = texels.area[own][some].astype(np.float64)
        of_noise = float(np.average(noise[own][some] ** 2, weights=area))
        of_light, of_irradiance = (
            _variance(np.log(values[own][some], dtype=np.float64), area)
            for values in (light, reaches)
        )
        # What the error itself makes most of says nothing.
        found[i] = of_irradiance > 2 * of_noise
        found[i] &= of_light < _EVEN * (of_irradiance - of_noise)
    return found


def _variance(values: Double, weights: Double) -> float:
    mean = np.average(values, weights=weights)
    return float(np.average((values - mean) ** 2, weights=weights))
