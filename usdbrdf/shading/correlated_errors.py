"""Gaussian errors of which neighbours share a part, on surfaces whose mean is free.

Small dense matrices by compiled loops of one thread rather than by LAPACK, whose sums, and so
the published bytes, depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import kernel

Double = npt.NDArray[np.float64]


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
