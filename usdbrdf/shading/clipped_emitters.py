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
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from usdbrdf import calibration
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int
from usdbrdf.model.mesh import halved


@kernel
def _factor(matrix: Double) -> Double:
    """Upper triangular U with U^T U = matrix, row by row."""
    upper = matrix.copy()
    n = len(matrix)
    for j in range(n):
        for k in range(j):
            share = upper[k, j]
            for i in range(j, n):
                upper[j, i] -= share * upper[k, i]
        root = 1 / np.sqrt(upper[j, j])
        for i in range(j, n):
            upper[j, i] *= root
        for i in range(j):
            upper[j, i] = 0
    return upper


@kernel
def _inverse_factor(upper: Double) -> Double:
    """W = U^-T, lower triangular: matrix^-1 = W^T W."""
    n = len(upper)
    inverse = np.zeros((n, n))
    for j in range(n):
        inverse[j, j] = 1
        for k in range(j):
            share = upper[k, j]
            for i in range(k + 1):
                inverse[j, i] -= share * inverse[k, i]
        for i in range(j + 1):
            inverse[j, i] /= upper[j, j]
    return inverse


@kernel
def weight_without_mean(matrix: Double) -> Double:
    """Inverse (n, n) of the covariance after the values' own weighted mean was taken out."""
    half = _inverse_factor(_factor(matrix))
    n = len(half)
    weight = np.zeros((n, n))
    for k in range(n):
        for j in range(k + 1):
            share = half[k, j]
            for i in range(k + 1):
                weight[j, i] += share * half[k, i]
    row = np.zeros(n)
    for j in range(n):
        for i in range(n):
            row[j] += weight[j, i]
    total = row.sum()
    for j in range(n):
        for i in range(n):
            weight[j, i] -= row[j] * row[i] / total
    return weight


@kernel
def restricted_cost(matrix: Double, residual: Double) -> float:
    """-2 log of the restricted likelihood of residuals (n,) whose mean is free (H. Patterson and
    R. Thompson, "Recovery of inter-block information when block sizes are unequal", 1971), up to a
    constant."""
    upper = _factor(matrix)
    n = len(upper)
    ones, solved = np.ones(n), residual.copy()
    log_determinant = 0.0
    for j in range(n):
        ones[j] /= upper[j, j]
        solved[j] /= upper[j, j]
        for i in range(j + 1, n):
            ones[i] -= upper[j, i] * ones[j]
            solved[i] -= upper[j, i] * solved[j]
        log_determinant += 2 * np.log(upper[j, j])
    square, mixed, total = 0.0, 0.0, 0.0
    for j in range(n):
        square += solved[j] ** 2
        mixed += solved[j] * ones[j]
        total += ones[j] ** 2
    cost: float = log_determinant + np.log(total) + square - mixed**2 / total
    return cost


_MIN_SEGMENT = calibration.count("lamps.min_segment")
_AMBIENT = calibration.number("lamps.ambient")
AMBIENT_SPREAD = calibration.number("lamps.ambient_spread")
_AMBIENT_ERROR = calibration.number("lamps.ambient_error")
_MOSTLY_AMBIENT = calibration.number("lamps.mostly_ambient")


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What N texels of reflectors show of K lamps.

    radiance        (N, 3) float32, measured L_d
    irradiance      (N, 3) float32, S_0 in W/m^2: from all light but the K lamps'
    lamp_irradiance (K, N, 3) float32, S_k: from lamp k alone, at its lower bound
    position        (N, 3) float32, in lamps.errors.unit
    segment         (N,) int32, equal where the albedo may be taken as alike
    object          (N,) int32, equal where errors may agree beyond the segment
    doubt           (N,) float64, how many times as badly as usual the texel tells what a plain
                    reflector would show, at least 1; equal in a segment
    prior           (K, 2) float64, mean and standard deviation of log g_k before the evidence
    shines          (K,) bool: it is a lamp for certain, and no surface that is lit brightly
    """

    radiance: Float
    irradiance: Float
    lamp_irradiance: Float
    position: Float
    segment: Int
    object: Int
    doubt: Double
    prior: Double
    shines: Bool


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Texels of one segment: log of pi L_d without ambient specular light (n, 3), its change by
    what that light may be wrong (n,), distances (n, n) in lamps.errors.unit, variance
    relative to the common noise of the texels (n,) and of the whole segment (scale, at least
    least_scale), and what its own specular light may differ by (specular, relative)."""

    index: npt.NDArray[np.int64]
    object: int
    observed: Double
    ambient: Double
    distance: Double
    variance: Double
    least_scale: float
    scale: float
    specular: float


def segments_of(evidence: Evidence) -> list[Segment]:
    """Segments with enough texels that are lit and not black."""
    total = evidence.irradiance + evidence.lamp_irradiance.sum(axis=0)
    usable = (evidence.radiance > 0).all(axis=1) & (total > 0).all(axis=1)
    segments = []
    for number in np.unique(evidence.segment[usable]):
        index = np.flatnonzero(usable & (evidence.segment == number))
        if len(index) < _MIN_SEGMENT:
            continue
        position = evidence.position[index].astype(np.float64)
        whole = np.pi * evidence.radiance[index].astype(np.float64)
        # log(pi L_d - share S_0), with the ambient share and with what it may be wrong by on top.
        observed, more = (
            np.log(whole - np.minimum(share * evidence.irradiance[index], _MOSTLY_AMBIENT * whole))
            for share in (_AMBIENT, _AMBIENT + _AMBIENT_ERROR)
        )
        least_scale = float(evidence.doubt[index[0]]) ** 2
        segments.append(
            Segment(
                index=index,
                object=int(evidence.object[index[0]]),
                observed=observed,
                ambient=(more - observed).mean(axis=1),
                distance=np.linalg.norm(position[:, None] - position, axis=-1),
                variance=np.ones(len(index)),
                least_scale=least_scale,
                scale=least_scale,
                specular=0.0,
            )
        )
    return segments


def log_irradiance(evidence: Evidence, index: npt.NDArray[np.int64], log_g: Double) -> Double:
    """log S (n, 3) of the texels."""
    lamps = np.einsum("kc,knc->nc", np.exp(log_g), evidence.lamp_irradiance[:, index])
    return np.asarray(np.log(evidence.irradiance[index] + lamps))


def segment_covariance(item: Segment, shape: Double) -> Double:
    """(n, n), of the logarithms: noise^2 variance_i on the diagonal, and a part that agrees over a
    length, of which there is more where the segment's own specular light differs.

    shape (3,): logarithms of noise, agreeing part and length
    """
    noise, agreeing, length = np.exp(shape)
    smooth = (agreeing**2 + item.specular**2) * np.exp(-item.distance / length)
    return np.asarray(item.scale * np.asarray(smooth + np.diag(noise**2 * item.variance)))


def lamp_share(evidence: Evidence, item: Segment, log_g: Double) -> Double:
    """How much of S is whose lamp's, (K, n, 3): the derivative of log S by log g."""
    lamps = np.exp(log_g)[:, None] * evidence.lamp_irradiance[:, item.index]
    return np.asarray(lamps / (evidence.irradiance[item.index] + lamps.sum(axis=0)))


def normal_equations(
    evidence: Evidence, item: Segment, weight: Double, log_g: Double
) -> tuple[Double, Double, Double]:
    """Per channel: curvature (3, K, K), gradient (3, K) and weighted square (3,)."""
    residual = item.observed - log_irradiance(evidence, item.index, log_g)
    share = lamp_share(evidence, item, log_g)
    weighted = np.einsum("nm,kmc->ckn", weight, share)
    curvature = np.einsum("ckn,lnc->ckl", weighted, share)
    gradient = np.einsum("ckn,nc->ck", weighted, residual)
    square = np.einsum("nc,nm,mc->c", residual, weight, residual)
    return curvature, gradient, square


MAX_ERROR = calibration.number("lamps.max_error")
LEAST_ERROR = calibration.number("lamps.least_error")
UNTOLD = calibration.number("lamps.untold")
_FEW_OBJECTS = calibration.count("lamps.few_objects")
_STUDENT_FREEDOM = calibration.number("lamps.student_freedom")
ALONE, ERROR_ALONE = calibration.pair("lamps.alone")
_ROUNDS = 6
_STEPS = 30
LAMP_PRIOR = calibration.pair("lamps.prior")
_START = np.log(calibration.numbers("lamps.errors.start"))
_LIMITS = np.log(calibration.numbers("lamps.errors.limits")).reshape(3, 2)
Weighed: TypeAlias = tuple[Segment, Double]


@dataclass(frozen=True, kw_only=True)
class EstimatedRadiance:
    """multiplier (K, 3) float64, g_k per channel; standard_error (K, 3) float64, relative;
    determined (K,) bool: the error is small enough, and the lamp not darker than its bound."""

    multiplier: Double
    standard_error: Double
    determined: Bool

    def least(self) -> Double:
        """(K, 3): a multiplier that each lamp exceeds by all likelihood, two standard errors below
        the estimate; 1, its bound, where the evidence says no more."""
        brightest, index = self.multiplier.max(axis=1), self.multiplier.argmax(axis=1)
        below = np.exp(-2 * self.standard_error[np.arange(len(index)), index])
        held: Double = np.where(
            (brightest * below > 1)[:, None], self.multiplier * below[:, None], 1.0
        )
        return held

    def of_lamps(self, which: Bool) -> EstimatedRadiance:
        """The same of those of the lamps (K,), of the others nothing."""
        none = nothing_known(len(which))
        return EstimatedRadiance(
            multiplier=np.where(which[:, None], self.multiplier, none.multiplier),
            standard_error=np.where(which[:, None], self.standard_error, none.standard_error),
            determined=self.determined & which,
        )

    def else_of(self, other: EstimatedRadiance) -> EstimatedRadiance:
        """Of those of the lamps (K,) of which this tells too little what is determined in the
        ``other``; what this tells to be no lamp stays so."""
        which = other.determined & (self.standard_error.max(axis=1) > MAX_ERROR)
        return EstimatedRadiance(
            multiplier=np.where(which[:, None], other.multiplier, self.multiplier),
            standard_error=np.where(which[:, None], other.standard_error, self.standard_error),
            determined=self.determined | which,
        )


def estimate_clipped_emitters(evidence: Evidence) -> EstimatedRadiance:
    """Multipliers g_k of the lamps' lower bounds, with honest errors.

    The standard error is the larger of the curvature's and of a jackknife over the objects, or over
    parts of one that tells a lamp alone; and what is not in these, see docs/equations.md. A
    channel in which a lamp did not clip may come out below 1; its brightest one cannot.
    """
    segments, lamps = segments_of(evidence), len(evidence.prior)
    if not segments:
        return nothing_known(lamps)
    log_g, shape = np.repeat(evidence.prior[:, :1], 3, axis=1), _START
    for _ in range(_ROUNDS):
        weighed = _weighed(segments, shape)
        log_g = _solve(evidence, weighed, log_g)
        segments = [_judged(evidence, item, weight, log_g) for item, weight in weighed]
        shape = _likeliest(evidence, segments, shape, log_g)
    weighed = _weighed(segments, shape)
    log_g = _solve(evidence, weighed, log_g)
    error = _standard_error(evidence, weighed, log_g, shape)
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


def _weighed(segments: list[Segment], shape: Double) -> list[Weighed]:
    return [(item, weight_without_mean(segment_covariance(item, shape))) for item in segments]


def _solve(evidence: Evidence, weighed: list[Weighed], log_g: Double) -> Double:
    """Gauss-Newton with damping on the sum over the segments and the prior."""
    mean, precision = evidence.prior[:, :1], evidence.prior[:, 1] ** -2

    def at(log_g: Double) -> tuple[Double, Double, Double]:
        parts = [normal_equations(evidence, item, weight, log_g) for item, weight in weighed]
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
    scale = max(item.least_scale, (freedom + misfit) / (freedom + count))
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
    evidence: Evidence, weighed: list[Weighed], log_g: Double, shape: Double
) -> Double:
    """(K, 3), of log g."""
    segments = [item for item, _ in weighed]
    parts = [normal_equations(evidence, item, weight, log_g) for item, weight in weighed]
    whole = np.asarray(sum(part[0] for part in parts)) + np.diag(evidence.prior[:, 1] ** -2)
    count = sum(len(item.index) - 1 for item in segments)
    misfit = np.asarray(sum(part[2] for part in parts)) / max(count - len(log_g), 1)
    inverse = np.linalg.inv(whole)
    curved = np.sqrt(np.einsum("ckk->kc", inverse) * np.maximum(misfit, 1))
    # And if what each object brings (segments where they are few) errs as a whole; but of what
    # tells a lamp alone parts do, and all of it by as much as is stated.
    owner = np.array([item.object for item in segments])
    if len(np.unique(owner)) < _FEW_OBJECTS:
        owner = np.arange(len(segments))
    brought = [(part[0], part[1]) for part in parts]
    jackknife = _without_each(whole, _summed(brought, owner))
    told = np.array([np.einsum("ckk->k", part[0]) for part in parts])
    known = told.sum(axis=0) > 3 * evidence.prior[:, 1] ** -2
    alone = (told > ALONE * told.sum(axis=0)) & evidence.shines & known
    for k in np.flatnonzero(alone.any(axis=0)):
        i = int(alone[:, k].argmax())
        others = np.arange(len(segments)) != i
        blocks = _summed([brought[n] for n in np.flatnonzero(others)], owner[others])
        blocks += _parts_of(evidence, segments[i], brought[i], log_g, shape)
        share = told[i, k] / told[:, k].sum()
        jackknife[k] = np.hypot(_without_each(whole, blocks)[k], ERROR_ALONE * share)
    # And with more ambient specular light everywhere:
    pull = sum(
        np.einsum("knc,nm,m->ck", lamp_share(evidence, item, log_g), weight, item.ambient)
        for item, weight in weighed
    )
    ambient = np.einsum("ckl,cl->kc", inverse, pull)
    whole_error = np.maximum(curved, jackknife) ** 2 + ambient**2 + LEAST_ERROR**2
    return np.asarray(np.sqrt(whole_error))


Block: TypeAlias = tuple[Double, Double]


def _summed(brought: list[Block], owner: Array) -> list[Block]:
    """Curvature (3, K, K) and gradient (3, K) that go with each owner of segments."""
    return [
        (
            np.sum([brought[i][0] for i in np.flatnonzero(owner == number)], axis=0),
            np.sum([brought[i][1] for i in np.flatnonzero(owner == number)], axis=0),
        )
        for number in np.unique(owner)
    ]


def _without_each(whole: Double, blocks: list[Block]) -> Double:
    """(K, 3): the jackknife's standard error of log g, of which the solution moves by
    (H - H_block)^-1 gradient_block without a block; infinite where there is but one."""
    if len(blocks) < 2:
        return np.full((whole.shape[1], 3), np.inf)
    moved = np.sum(
        [
            np.linalg.solve(whole - curvature, gradient[..., None])[..., 0].T ** 2
            for curvature, gradient in blocks
        ],
        axis=0,
    )
    error: Double = np.sqrt((1 - 1 / len(blocks)) * moved)
    return error


def _parts_of(
    evidence: Evidence, item: Segment, brought: Block, log_g: Double, shape: Double
) -> list[Block]:
    """What goes with parts of a segment that lie beside each other: without all of what tells a
    lamp alone nothing would be known, which is no measure of how far it errs."""
    parts = []
    for kept in _without_parts(evidence.position[item.index]):
        less = _some_of(item, kept)
        weight = weight_without_mean(segment_covariance(less, shape))
        left = normal_equations(evidence, less, weight, log_g)
        parts.append((brought[0] - left[0], brought[1] - left[1]))
    return parts


def _without_parts(position: Float) -> list[Bool]:
    """Of points (n, 3): those outside of each of eight parts beside each other, which are halved
    along their widest side three times."""
    parts = [np.arange(len(position))]
    for _ in range(3):
        halves = (half for part in parts for half in halved(position, part))
        parts = [half for half in halves if len(half)]
    kept = np.ones((len(parts), len(position)), np.bool_)
    for own, part in zip(kept, parts, strict=True):
        own[part] = False
    return list(kept)


def _some_of(item: Segment, kept: Bool) -> Segment:
    return replace(
        item,
        index=item.index[kept],
        observed=item.observed[kept],
        ambient=item.ambient[kept],
        distance=item.distance[np.ix_(kept, kept)],
        variance=item.variance[kept],
    )
