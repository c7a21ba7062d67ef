"""Statistical tests for samplers and estimators, with Sidak's correction for many at once.

Seeds are fixed, so a test that passes goes on passing; the significance level only says how far
from the right answer a wrong one must be to show.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy import stats

Double = npt.NDArray[np.float64]

# Chance of a false alarm per test: with some two hundred of them, a fifth in all when seeds change.
SIGNIFICANCE = 0.001


def sidak(tests: int, significance: float = SIGNIFICANCE) -> float:
    """Level for each of ``tests`` independent tests so that the chance of any false alarm among
    them is ``significance``: 1 - (1 - level)^tests = significance."""
    return float(-np.expm1(np.log1p(-significance) / tests))


def expected_in_cells(
    density: Callable[[Double, Double], Double], a: Double, b: Double, order: int = 8
) -> Double:
    """Probability of every cell of the grid with edges a (A+1,) and b (B+1,): (A, B).

    density takes the chart's coordinates and includes the Jacobian; each cell is integrated by
    order x order Gauss-Legendre points.
    """
    node, weight = np.polynomial.legendre.leggauss(order)
    points_a, weights_a = _nodes(a, node, weight)
    points_b, weights_b = _nodes(b, node, weight)
    values = density(*np.meshgrid(points_a, points_b, indexing="ij"))
    values = values * weights_a[:, None] * weights_b[None, :]
    return values.reshape(len(a) - 1, order, len(b) - 1, order).sum(axis=(1, 3))


def _nodes(edges: Double, node: Double, weight: Double) -> tuple[Double, Double]:
    half = np.diff(edges) / 2
    middle = (edges[1:] + edges[:-1]) / 2
    return (middle[:, None] + half[:, None] * node).ravel(), (half[:, None] * weight).ravel()


def chi_square_p(counts: npt.ArrayLike, expected: npt.ArrayLike) -> float:
    """p-value of observed counts against expected ones (any shape, same total).

    Cells that expect fewer than five are pooled, smallest first, as the test's approximation asks.
    """
    observed = np.ravel(counts).astype(float)
    wanted = np.ravel(expected).astype(float)
    order = np.argsort(wanted)
    observed, wanted = observed[order], wanted[order]
    rare = int(np.searchsorted(np.cumsum(wanted), 5.0)) + 1 if wanted[0] < 5 else 0
    while rare < len(wanted) and wanted[rare] < 5:
        rare += 1
    if rare:
        observed = np.concatenate([[observed[:rare].sum()], observed[rare:]])
        wanted = np.concatenate([[wanted[:rare].sum()], wanted[rare:]])
    if wanted[0] <= 0:
        assert observed[0] == 0, f"{observed[0]:.0f} samples fell where the density is zero"
        observed, wanted = observed[1:], wanted[1:]
    statistic = ((observed - wanted) ** 2 / wanted).sum()
    return float(stats.chi2.sf(statistic, len(wanted) - 1))


def assert_distributed(p_values: npt.ArrayLike, significance: float = SIGNIFICANCE) -> None:
    """No p-value of a family of tests may fall below its Sidak level."""
    p = np.ravel(p_values)
    level = sidak(len(p), significance)
    worst = int(p.argmin())
    assert p[worst] >= level, f"test {worst} of {len(p)}: p = {p[worst]:.3g} (level {level:.3g})"


def assert_same_mean(replicates: Double, expected: npt.ArrayLike, slack: float = 0.0) -> None:
    """Independent estimates replicates (R, ...) have the mean ``expected`` (...).

    Student's t from the replicates' own scatter, Sidak over all entries. slack is a relative error
    that the expected value itself may have; give its origin where it is used.
    """
    number = len(replicates)
    mean = replicates.mean(axis=0, dtype=np.float64)
    error = replicates.std(axis=0, ddof=1, dtype=np.float64) / np.sqrt(number)
    wanted = np.broadcast_to(np.asarray(expected, np.float64), mean.shape)
    # float32 sums: where there is no scatter at all the rounding is what is left.
    allowed = (slack + 2e-6) * np.abs(wanted)
    off = np.maximum(np.abs(mean - wanted) - allowed, 0) / np.maximum(error, 1e-30)
    p = np.atleast_1d(2 * stats.t.sf(off, number - 1))
    level = sidak(p.size)
    worst = np.unravel_index(p.argmin(), p.shape)
    assert p.min() >= level, (
        f"entry {worst}: {np.atleast_1d(mean)[worst]:.6g} +- {np.atleast_1d(error)[worst]:.2g}, "
        f"expected {np.atleast_1d(wanted)[worst]:.6g}: p = {p.min():.3g} (level {level:.3g})"
    )
