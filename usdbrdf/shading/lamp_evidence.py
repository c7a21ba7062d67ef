"""What the texels of reflectors show of lamps, segment by segment, and how it varies with them;
neighbours share a part of their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf import calibration
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Double, Float, Int


def covariance(shape: Double, distance: Double, variance: Double, shared: float) -> Double:
    """(n, n) of n texels: noise^2 variance_i on the diagonal, and a part that agrees over a length.

    shape (3,): logarithms of noise, agreeing part and length (metres); distance (n, n) metres;
    variance (n,): of the texels, relative; shared: more of the agreeing part, standard deviation.
    """
    noise, agreeing, length = np.exp(shape)
    smooth = (agreeing**2 + shared**2) * np.exp(-distance / length)
    return np.asarray(smooth + np.diag(noise**2 * variance))


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
    position        (N, 3) float32, metres
    segment         (N,) int32, equal where the albedo may be taken as alike
    object          (N,) int32, equal where errors may agree beyond the segment
    prior           (K, 2) float64, mean and standard deviation of log g_k before the evidence
    """

    radiance: Float
    irradiance: Float
    lamp_irradiance: Float
    position: Float
    segment: Int
    object: Int
    prior: Double


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Texels of one segment: log of pi L_d without ambient specular light (n, 3), its change by
    what that light may be wrong (n,), distances (n, n) in metres, variance relative to the common
    noise of the texels (n,) and of the whole segment (scale), and what its own specular light may
    differ by (specular, relative)."""

    index: npt.NDArray[np.int64]
    object: int
    observed: Double
    ambient: Double
    distance: Double
    variance: Double
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
        observed = _without_ambient(evidence, index, _AMBIENT)
        more = _without_ambient(evidence, index, _AMBIENT + _AMBIENT_ERROR)
        segments.append(
            Segment(
                index=index,
                object=int(evidence.object[index[0]]),
                observed=observed,
                ambient=(more - observed).mean(axis=1),
                distance=np.linalg.norm(position[:, None] - position, axis=-1),
                variance=np.ones(len(index)),
                scale=1.0,
                specular=0.0,
            )
        )
    return segments


def _without_ambient(evidence: Evidence, index: npt.NDArray[np.int64], share: float) -> Double:
    """log(pi L_d - share S_0) (n, 3)."""
    whole = np.pi * evidence.radiance[index].astype(np.float64)
    ambient = np.minimum(share * evidence.irradiance[index], _MOSTLY_AMBIENT * whole)
    return np.asarray(np.log(whole - ambient))


def log_irradiance(evidence: Evidence, index: npt.NDArray[np.int64], log_g: Double) -> Double:
    """log S (n, 3) of the texels."""
    lamps = np.einsum("kc,knc->nc", np.exp(log_g), evidence.lamp_irradiance[:, index])
    return np.asarray(np.log(evidence.irradiance[index] + lamps))


def segment_covariance(item: Segment, shape: Double) -> Double:
    """(n, n), of the logarithms; shape as in ``covariance``."""
    return item.scale * covariance(shape, item.distance, item.variance, item.specular)


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
