"""Radiance of lamps that clip in every photograph, from the light that they cast.

Irradiance is linear in the lamps: S = S_0 + sum_k g_k S_k, with S_0 from everything measured and
S_k from lamp k at the radiance at which it clipped. On a surface of one albedo log L_d follows
log S whatever the albedo is, so the multipliers g_k are those that make it follow best.

Albedo is free per segment (one object, one facing) and a Gaussian process within it: an
independent part (texture, noise) and a part that agrees over some length (dirt, specular light
kept in L_d, errors of S), found by restricted maximum likelihood, so that the errors of neighbours
do not count as independent. Outliers weigh as under Student's t.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double
from usdbrdf.shading.lamp_evidence import (
    AMBIENT_SPREAD,
    Evidence,
    Segment,
    lamp_share,
    log_irradiance,
    normal_equations,
    restricted_cost,
    segment_covariance,
    segments_of,
    weight_without_mean,
)

MAX_ERROR = calibration.number("lamps.max_error")
_LEAST_ERROR = calibration.number("lamps.least_error")
_FEW_OBJECTS = calibration.count("lamps.few_objects")
_STUDENT_FREEDOM = calibration.number("lamps.student_freedom")
_ROUNDS = 6
_STEPS = 30
LAMP_PRIOR = calibration.pair("lamps.prior")
_START = np.log(calibration.numbers("lamps.errors.start"))
_LIMITS = np.log(calibration.numbers("lamps.errors.limits")).reshape(3, 2)


@dataclass(frozen=True, kw_only=True)
class EstimatedRadiance:
    """multiplier (K, 3) float64, g_k per channel; standard_error (K, 3) float64, relative;
    determined (K,) bool: the error is small enough, and the lamp not darker than its bound."""

    multiplier: Double
    standard_error: Double
    determined: Bool


def estimate_clipped_emitters(evidence: Evidence) -> EstimatedRadiance:
    """Multipliers g_k of the lamps' lower bounds, with honest errors.

    The standard error is the larger of the curvature's and of a jackknife over the objects. A
    channel in which a lamp did not clip may come out below 1; its brightest one cannot.
    """
    segments, lamps = segments_of(evidence), len(evidence.prior)
    if not segments:
        return nothing_known(lamps)
    log_g, shape = np.repeat(evidence.prior[:, :1], 3, axis=1), _START
    for _ in range(_ROUNDS):
        weights = [weight_without_mean(segment_covariance(item, shape)) for item in segments]
        log_g = _solve(evidence, segments, weights, log_g)
        segments = [
            _judged(evidence, item, weight, log_g)
            for item, weight in zip(segments, weights, strict=True)
        ]
        shape = _likeliest(evidence, segments, shape, log_g)
    weights = [weight_without_mean(segment_covariance(item, shape)) for item in segments]
    log_g = _solve(evidence, segments, weights, log_g)
    error = _standard_error(evidence, segments, weights, log_g)
    brightest, channel = log_g.max(axis=1), log_g.argmax(axis=1)
    possible = brightest > -2 * error[np.arange(lamps), channel]
    return EstimatedRadiance(
        multiplier=np.exp(log_g - np.minimum(brightest, 0)[:, None]),
        standard_error=error,
        determined=(error.max(axis=1) <= MAX_ERROR) & possible,
    )


def nothing_known(lamps: int) -> EstimatedRadiance:
    """All stay at their bounds."""
    return EstimatedRadiance(
        multiplier=np.ones((lamps, 3)),
        standard_error=np.full((lamps, 3), np.inf),
        determined=np.zeros(lamps, np.bool_),
    )


def _solve(
    evidence: Evidence, segments: list[Segment], weights: list[Double], log_g: Double
) -> Double:
    """Gauss-Newton with damping on the sum over the segments and the prior."""
    mean, precision = evidence.prior[:, :1], evidence.prior[:, 1] ** -2

    def at(log_g: Double) -> tuple[Double, Double, Double]:
        parts = [
            normal_equations(evidence, item, weight, log_g)
            for item, weight in zip(segments, weights, strict=True)
        ]
        off = (mean - log_g).T
        curvature = sum(part[0] for part in parts) + np.diag(precision)
        gradient = sum(part[1] for part in parts) + precision * off
        cost = sum(part[2] for part in parts) + (precision * off**2).sum(axis=1)
        return np.asarray(curvature), np.asarray(gradient), np.asarray(cost)

    damping = np.full(3, 1e-3)
    curvature, gradient, cost = at(log_g)
    for _ in range(_STEPS):
        damped = curvature * (1 + damping[:, None, None] * np.eye(len(log_g)))
        step = np.clip(np.linalg.solve(damped, gradient[..., None])[..., 0].T, -1, 1)
        tried = at(log_g + step)
        better = tried[2] <= cost
        damping = np.where(better, damping / 10, damping * 10)
        log_g = log_g + step * better
        curvature = np.where(better[:, None, None], tried[0], curvature)
        gradient = np.where(better[:, None], tried[1], gradient)
        cost = np.where(better, tried[2], cost)
        if np.abs(step).max() < 1e-4:
            break
    return log_g


def _judged(evidence: Evidence, item: Segment, weight: Double, log_g: Double) -> Segment:
    """The segment with its outliers and its overall misfit judged anew."""
    residual = item.observed - log_irradiance(evidence, item.index, log_g)
    albedo = float(np.exp(np.median(residual)))
    residual = residual.mean(axis=1)
    # Each texel against what all others of the segment say of it.
    error = (weight @ residual) ** 2 / np.maximum(np.diag(weight), 1e-12)
    freedom = _STUDENT_FREEDOM
    variance = (freedom + error * item.scale) / (freedom + 1)
    misfit = item.scale * float(residual @ weight @ residual)
    count = len(item.index) - 1
    scale = max(1.0, (freedom + misfit) / (freedom + count))
    specular = AMBIENT_SPREAD / min(max(albedo, 0.01), 1)
    return replace(item, variance=np.maximum(variance, 1.0), scale=scale, specular=specular)


def _likeliest(evidence: Evidence, segments: list[Segment], shape: Double, log_g: Double) -> Double:
    """Noise, agreeing part and length of highest restricted likelihood."""
    residuals = [
        (item.observed - log_irradiance(evidence, item.index, log_g)).mean(axis=1)
        for item in segments
    ]

    def cost(shape: Double) -> float:
        return sum(
            restricted_cost(segment_covariance(item, shape), residual)
            for item, residual in zip(segments, residuals, strict=True)
        )

    found = minimize(
        cost, shape, method="Nelder-Mead", bounds=_LIMITS,
        options={"maxfev": 40, "xatol": 0.05, "fatol": 0.5},
    )  # fmt: skip
    return np.asarray(found.x)


def _standard_error(
    evidence: Evidence, segments: list[Segment], weights: list[Double], log_g: Double
) -> Double:
    """(K, 3), of log g."""
    parts = [
        normal_equations(evidence, item, weight, log_g)
        for item, weight in zip(segments, weights, strict=True)
    ]
    whole = np.asarray(sum(part[0] for part in parts)) + np.diag(evidence.prior[:, 1] ** -2)
    count = sum(len(item.index) - 1 for item in segments)
    misfit = np.asarray(sum(part[2] for part in parts)) / max(count - len(log_g), 1)
    inverse = np.linalg.inv(whole)
    curved = np.sqrt(np.einsum("ckk->kc", inverse) * np.maximum(misfit, 1))
    jackknife = _jackknife(segments, parts, whole)
    # And with more ambient specular light everywhere:
    pull = sum(
        np.einsum("knc,nm,m->ck", lamp_share(evidence, item, log_g), weight, item.ambient)
        for item, weight in zip(segments, weights, strict=True)
    )
    ambient = np.einsum("ckl,cl->kc", inverse, pull)
    whole_error = np.maximum(curved, jackknife) ** 2 + ambient**2 + _LEAST_ERROR**2
    return np.asarray(np.sqrt(whole_error))


def _jackknife(
    segments: list[Segment], parts: list[tuple[Double, Double, Double]], whole: Double
) -> Double:
    """(K, 3): error of log g if objects (segments where they are few) err as a whole."""
    owner = np.array([item.object for item in segments])
    if len(np.unique(owner)) < _FEW_OBJECTS:
        owner = np.arange(len(segments))
    total = np.zeros((whole.shape[1], 3))
    blocks = np.unique(owner)
    for block in blocks:
        own = [part for part, number in zip(parts, owner, strict=True) if number == block]
        curvature = whole - np.asarray(sum(part[0] for part in own))
        gradient = np.asarray(sum(part[1] for part in own))
        # Without the block the solution would move by (H - H_block)^-1 gradient_block.
        total += np.linalg.solve(curvature, gradient[..., None])[..., 0].T ** 2
    return np.asarray(np.sqrt((1 - 1 / len(blocks)) * total))
