"""Metals: a lobe without a diffuse part, with a reflectance of its own in each channel, against the
dielectric that explains the same samples.

A conductor's radiance is base + F0 slope / 0.08 in each channel, whatever the texel; a dielectric's
is a diffuse part that is free of each texel, or one albedo of the object times S, and a lobe of F0
up to 0.08. The likelihood of the samples under each, errors relative to what the texel shows and of
one unknown size, decides. What is free of each texel, a diffuse part, or the error of the light
that a metal mirrors there, is paid for, being integrated over all that it is likely to be
(H. Jeffreys, "Theory of Probability", 1961).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.material.fit_lobe import OfPhis
from usdbrdf.material.verdict import LobeEstimate
from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.transport.brdf import F0_OF_PSI

_PHIS = calibration.numbers("conductor.roughnesses")
_LEAST_F0 = calibration.number("conductor.least_f0")
_CLEARER = calibration.number("conductor.clearer")
_MODEL_ERROR = calibration.number("conductor.model_error")
_LEAST_ERROR = calibration.number("conductor.least_error")
# Of a sample, relative: what is further off is no more against a model than this.
_FURTHEST = calibration.number("conductor.furthest")
# Reflectances from which the search for one begins.
_STARTS = (0.1, 0.3, 0.5, 0.7, 0.9)


class Conductor(NamedTuple):
    """phi; f0 (3,), reflectance at normal incidence; their standard deviations phi_error, f0_error;
    clearer: by how much the logarithm of the errors is less than any dielectric's."""

    phi: float
    f0: tuple[float, float, float]
    phi_error: float
    f0_error: float
    clearer: float


def conductor_of(
    radiance: Float,
    texel: Long,
    irradiance: Float,
    bases: tuple[OfPhis, OfPhis],
    dielectric: LobeEstimate,
    *,
    certain: bool = False,
    of_dielectric: tuple[OfPhis, OfPhis] | None = None,
) -> Conductor | None:
    """The metal that explains P samples clearly better than the best dielectric; None without one,
    unless it is ``certain`` to be a metal.

    radiance    (P, 3) of the samples; texel (P,) counted from 0 without gaps
    irradiance  (P, 3), W/m^2, S at the sample's texel
    bases       twice roughnesses -> (base, slope), (P, 3, K), with independent noise
    of_dielectric  the same of the ``dielectric``'s kind of lobe, where that is another
    """
    count = int(texel.max()) + 1
    views = np.bincount(texel, minlength=count)
    mean = np.bincount(texel, radiance.mean(axis=1), count) / views
    level = np.maximum(mean, 1e-3 * mean.mean())[texel][:, None]
    seen = radiance / level
    lobes = [_relative(basis(_PHIS), level) for basis in bases]
    errors, reflectances = np.zeros(len(_PHIS)), np.zeros((len(_PHIS), 3))
    for k in range(len(_PHIS)):
        (base, slope), (other_base, other_slope) = ((b[..., k], s[..., k]) for b, s in lobes)
        f0 = _least_squares(seen, (base, other_base), (slope, other_slope))
        reflectances[k] = f0
        errors[k] = _size(seen - base - f0 * slope, seen - other_base - f0 * other_slope)
    best = int(errors.argmin())
    f0 = reflectances[best]
    # What is rougher still than all that are tried looks like a diffuse surface, and may be one.
    if (f0.mean() < _LEAST_F0 or best == len(_PHIS) - 1) and not certain:
        return None
    found = [_relative(basis([dielectric.phi]), level) for basis in of_dielectric or bases]
    psi = dielectric.psi * F0_OF_PSI
    one, other = ((base + psi * slope)[..., 0] for base, slope in found)
    diffuse = irradiance / np.pi / level
    albedo = _least_squares(seen, (one, other), (diffuse, diffuse))
    of_best = [(base[..., best], slope[..., best]) for base, slope in lobes]
    of_metal = [seen - base - f0 * slope for base, slope in of_best]
    of_rival = [seen - part - albedo * diffuse for part in (one, other)]
    clearer = _log_error(of_rival, texel) - _log_error(of_metal, texel)
    if clearer < _CLEARER and not certain:
        return None
    f0 = _median_of_texels(seen, of_best, f0, texel)
    likely = np.exp(-0.5 * count * (np.log(errors / errors[best])))
    likely *= np.gradient(np.array(_PHIS))
    likely /= likely.sum()
    phi = float(likely @ np.array(_PHIS))
    phi_error = math.sqrt(float(likely @ (np.array(_PHIS) - phi) ** 2))
    return Conductor(
        phi=float(_PHIS[best]),
        f0=(float(f0[0]), float(f0[1]), float(f0[2])),
        # The grid's step and what the model lacks are errors too.
        phi_error=math.hypot(phi_error, float(np.gradient(np.array(_PHIS))[best]) / 2),
        f0_error=math.hypot(
            math.sqrt(float((likely @ (reflectances - f0) ** 2).mean())), _MODEL_ERROR
        ),
        clearer=clearer,
    )


def _relative(lobe: tuple[Float, Float], level: Float) -> tuple[Double, Double]:
    """base, and the slope by F0, in units of what texels show."""
    base, slope = (part / level[..., None] for part in lobe)
    return base.astype(np.float64), slope.astype(np.float64) / F0_OF_PSI


def _least_squares(
    seen: Double, base: tuple[Double, Double], slope: tuple[Double, Double]
) -> Double:
    """The reflectance (3,) in [0, 1], from products of what has independent noise, with which least
    is left: samples that are off by as much as counts there tell nothing more, and are left out."""
    # One ray that finds a lamp which the frame does not show would outweigh all else.
    shown, product = slope[0] + slope[1], slope[0] * slope[1]
    of_seen = ((seen - base[0]) * slope[1] + (seen - base[1]) * slope[0]) / 2
    found, left = np.zeros((len(_STARTS), 3)), np.zeros((len(_STARTS), 3))
    for k, start in enumerate(_STARTS):
        f0 = np.full(3, start)
        for _ in range(8):
            off = seen - (base[0] + base[1] + f0 * shown) / 2
            used = np.abs(off) < _FURTHEST
            squares = (used * product).sum(axis=0)
            told = (used * of_seen).sum(axis=0) / np.maximum(squares, 1e-12)
            f0 = np.where(squares > 0, np.clip(told, 0, 1), f0)
        one, other = (_cut(seen - b - f0 * s) for b, s in zip(base, slope, strict=True))
        found[k], left[k] = f0, (one * other).mean(axis=0)
    return found[left.argmin(axis=0), range(3)]


def _median_of_texels(
    seen: Double, lobes: list[tuple[Double, Double]], f0: Double, texel: Long
) -> Double:
    """The reflectance (3,) in [0, 1] that half of the texels show more than, with ``f0`` (3,) by
    least squares as a start: errors of the light that a texel mirrors, the same in all views, are
    errors of the slope, and make that too small."""
    base, slope = (sum(parts) / 2 for parts in zip(*lobes, strict=True))
    used = np.abs(seen - base - f0 * slope) < _FURTHEST
    count = int(texel.max()) + 1
    shown, mirrored = (
        np.stack([np.bincount(texel, channel, count) for channel in (used * values).T], axis=-1)
        for values in (seen - base, slope)
    )
    told = mirrored > 1e-9 * mirrored.max()
    found = [
        np.median(shown[own, c] / mirrored[own, c]) if own.any() else f0[c]
        for c, own in enumerate(told.T)
    ]
    return np.asarray(np.clip(found, 0, 1), np.float64)


def _log_error(rests: list[Double], texel: Long) -> float:
    """ln of the size of the errors, (P, 3) by two predictions with independent noise, that a model
    leaves of samples; where that explains more, of the model in which each texel is off by a value
    of its own in all views: a diffuse part besides, or what is wrong with the light it mirrors."""
    uniform, views = _size(*rests), np.bincount(texel)
    share = len(views) / len(texel)
    # Each texel's own mean takes its share of the errors with it, and was before about as far from
    # that of all as the model of one value is off.
    means = [_without_means(rest, texel, views) for rest in rests]
    own = _size(*means) / math.sqrt(max(1 - share, share))
    paid = share * math.log(max(uniform, own) / (own * math.sqrt(2 * math.pi * share)))
    return min(math.log(uniform), math.log(own) + max(paid, 0.0))


def _without_means(values: Double, texel: Long, views: Long) -> Double:
    sums = np.stack([np.bincount(texel, channel, len(views)) for channel in values.T], axis=-1)
    return np.asarray(values - (sums / views[:, None])[texel])


def _size(first: Double, second: Double) -> float:
    """Root mean square of what a model leaves, from two predictions with independent noise."""
    return max(math.sqrt(max(float((_cut(first) * _cut(second)).mean()), 0.0)), _LEAST_ERROR)


def _cut(rest: Double) -> Double:
    return np.clip(rest, -_FURTHEST, _FURTHEST)
