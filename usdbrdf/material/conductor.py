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
from usdbrdf.model.arrays import Bool, Double, Float, Long
from usdbrdf.transport.brdf import F0_OF_PSI

_PHIS = calibration.numbers("conductor.roughnesses")
_LEAST_F0 = calibration.number("conductor.least_f0")
_CLEARER = calibration.number("conductor.clearer")
_MODEL_ERROR = calibration.number("conductor.model_error")
_LEAST_ERROR = calibration.number("conductor.least_error")
# Of a sample, relative: what is further off is no more against a model than this.
_FURTHEST = calibration.number("conductor.furthest")
# Of its reflectance what changes with the view tells of a metal at least; and how many times as
# bright as the light that is known a texel's may be.
_OF_CHANGES, _BRIGHTER = calibration.pair("conductor.of_changes")
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
    views = np.bincount(texel)
    level = _level_of_texels(radiance, texel, views)
    seen = radiance / level
    lobes = [_relative(basis(_PHIS), level) for basis in bases]
    reflectances, errors = _at_every_roughness(seen, lobes)
    best = int(errors.argmin())
    f0 = reflectances[best]
    # What is rougher still than all that are tried looks like a diffuse surface, and may be one.
    if (f0.mean() < _LEAST_F0 or best == len(_PHIS) - 1) and not certain:
        return None
    found = [_relative(basis([dielectric.phi]), level) for basis in of_dielectric or bases]
    lit = irradiance / np.pi / level
    of_rival = _log_error_of_dielectric(seen, found, dielectric.psi, lit, texel, views)
    of_best = [(base[..., best], slope[..., best]) for base, slope in lobes]
    models = [base + f0 * slope for base, slope in of_best]
    clearer = of_rival - _log_error_of_metal(seen, models, texel, views)
    # A diffuse part passes for that of a metal whose light is told too dark, and changes not.
    changing = _of_changes(seen, of_best, models, texel, views)
    f0, scatter = _median_of_texels(seen, of_best, models, texel)
    told = clearer >= _CLEARER and changing.mean() >= max(_OF_CHANGES * f0.mean(), _LEAST_F0)
    if not told and not certain:
        return None
    phi_error, spread = _spread(reflectances, errors, len(views))
    return Conductor(
        phi=float(_PHIS[best]),
        f0=(float(f0[0]), float(f0[1]), float(f0[2])),
        # The grid's step and what the model lacks are errors too.
        phi_error=math.hypot(phi_error, float(np.gradient(np.array(_PHIS))[best]) / 2),
        f0_error=math.hypot(spread, float(scatter.mean()), _MODEL_ERROR),
        clearer=clearer,
    )


def _level_of_texels(radiance: Float, texel: Long, views: Long) -> Double:
    """(P, 1): what the sample's texel shows in the mean of its views and channels, not quite 0."""
    mean = np.bincount(texel, radiance.mean(axis=1)) / views
    return np.asarray(np.maximum(mean, 1e-3 * mean.mean())[texel][:, None])


def _relative(lobe: tuple[Float, Float], level: Double) -> tuple[Double, Double]:
    """base, and the slope by F0, in units of what texels show."""
    base, slope = (part / level[..., None] for part in lobe)
    return base.astype(np.float64), slope.astype(np.float64) / F0_OF_PSI


def _at_every_roughness(seen: Double, lobes: list[tuple[Double, Double]]) -> tuple[Double, Double]:
    """The metal of least error at each of the roughnesses: its reflectance (K, 3), and the size of
    the error (K,) that it leaves."""
    errors, reflectances = np.zeros(len(_PHIS)), np.zeros((len(_PHIS), 3))
    for k in range(len(_PHIS)):
        (base, slope), (other_base, other_slope) = ((b[..., k], s[..., k]) for b, s in lobes)
        f0 = _least_squares(seen, (base, other_base), (slope, other_slope))
        reflectances[k] = f0
        errors[k] = _size(seen - base - f0 * slope, seen - other_base - f0 * other_slope)
    return reflectances, errors


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
    seen: Double, lobes: list[tuple[Double, Double]], models: list[Double], texel: Long
) -> tuple[Double, Double]:
    """The reflectance (3,) in [0, 1] that half of the texels show more than, and its standard error
    by their scatter; samples as far from the ``models`` as counts are left out. Errors of the light
    that a texel mirrors, the same in all views, make that of least squares too small."""
    base, slope = ((one + other) / 2 for one, other in zip(*lobes, strict=True))
    used = np.abs(seen - (models[0] + models[1]) / 2) < _FURTHEST
    count = int(texel.max()) + 1
    shown = _sums(used * (seen - base), texel, count)
    mirrored = _sums(used * slope, texel, count)
    told = (mirrored > 1e-9 * mirrored.max()).all(axis=1)
    if not told.any():
        return np.zeros(3), np.ones(3)
    each = shown[told] / mirrored[told]
    middle = np.median(each, axis=0)
    # The standard error of a median is 1.25 times that of a mean.
    scatter = 1.25 * 1.4826 * np.median(np.abs(each - middle), axis=0) / math.sqrt(len(each))
    return np.asarray(np.clip(middle, 0, 1), np.float64), scatter


def _scale_of_texels(seen: Double, models: list[Double], texel: Long, count: int) -> Double:
    """(T, 3): how many times as bright as the models say a texel is in all views."""
    one, other = models
    squares = _sums(one * other, texel, count)
    known = squares > 1e-9 * squares.max()
    product = _sums(seen * (one + other) / 2, texel, count)
    return np.where(known, np.clip(product / np.where(known, squares, 1), 0, _BRIGHTER), 1)


def _spread(reflectances: Double, errors: Double, texels: int) -> tuple[float, float]:
    """Standard deviations of phi and of the reflectance over the roughnesses, by what the errors
    make of their likelihood, of as many independent samples as there are texels."""
    phis, best = np.array(_PHIS), errors.argmin()
    likely = np.exp(-0.5 * texels * np.log(errors / errors[best])) * np.gradient(phis)
    likely /= likely.sum()
    of_phi = float(likely @ (phis - likely @ phis) ** 2)
    of_f0 = float((likely @ (reflectances - reflectances[best]) ** 2).mean())
    return math.sqrt(of_phi), math.sqrt(of_f0)


def _of_changes(
    seen: Double, lobes: list[tuple[Double, Double]], models: list[Double], texel: Long, views: Long
) -> Double:
    """The reflectance (3,) by what changes with the view alone."""
    used = np.abs(seen - (models[0] + models[1]) / 2) < _FURTHEST
    number = np.maximum(_sums(used, texel, len(views)), 1)

    def change(values: Double) -> Double:
        return used * (values - (_sums(used * values, texel, len(views)) / number)[texel])

    (one, of_one), (other, of_other) = (
        (change(seen - base), change(slope)) for base, slope in lobes
    )
    product = (one * of_other + other * of_one).sum(axis=0) / 2
    squares = (of_one * of_other).sum(axis=0)
    return np.where(squares > 0, product / np.where(squares > 0, squares, 1), 0)


def _sums(values: Double | Bool, texel: Long, count: int) -> Double:
    """(T, 3) over the views of each texel."""
    return np.stack([np.bincount(texel, channel, count) for channel in values.T], axis=-1)


def _log_error_of_dielectric(
    seen: Double,
    lobes: list[tuple[Double, Double]],
    psi: float,
    lit: Double,
    texel: Long,
    views: Long,
) -> float:
    """See ``_log_error``. lit (P, 3): what a white texel would show of its irradiance."""
    one, other = ((base + psi * F0_OF_PSI * slope)[..., 0] for base, slope in lobes)
    albedo = _least_squares(seen, (one, other), (lit, lit))
    rests = [seen - part - albedo * lit for part in (one, other)]
    return _log_error(rests, [_without_means(rest, texel, views) for rest in rests], views)


def _log_error_of_metal(seen: Double, models: list[Double], texel: Long, views: Long) -> float:
    """See ``_log_error``."""
    scale = _scale_of_texels(seen, models, texel, len(views))[texel]
    freed = [seen - scale * model for model in models]
    return _log_error([seen - model for model in models], freed, views)


def _log_error(rests: list[Double], freed: list[Double], views: Long) -> float:
    """ln of the size of the errors, (P, 3) by two predictions with independent noise, that a model
    of one value leaves of samples; or, where that explains more, of the model in which each of the
    texels, that so many ``views`` show, has a value of its own, which leaves what is ``freed``: a
    diffuse part, or how bright the light that it mirrors is."""
    uniform, share = _size(*rests), len(views) / float(views.sum())
    # Each texel's own value takes its share of the errors with it, and was before about as far from
    # that of all as the model of one value is off.
    own = _size(*freed) / math.sqrt(max(1 - share, share))
    paid = share * math.log(max(uniform, own) / (own * math.sqrt(2 * math.pi * share)))
    return min(math.log(uniform), math.log(own) + max(paid, 0.0))


def _without_means(values: Double, texel: Long, views: Long) -> Double:
    return np.asarray(values - (_sums(values, texel, len(views)) / views[:, None])[texel])


def _size(first: Double, second: Double) -> float:
    """Root mean square of what a model leaves, from two predictions with independent noise."""
    return max(math.sqrt(max(float((_cut(first) * _cut(second)).mean()), 0.0)), _LEAST_ERROR)


def _cut(rest: Double) -> Double:
    return np.clip(rest, -_FURTHEST, _FURTHEST)
