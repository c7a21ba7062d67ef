"""The lobe about what was found, against sums that are written out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.material.fit_lobe import Linear
from usdbrdf.material.verdict import NOTHING_KNOWN

SAMPLES, PSI = 24, 0.3
PHIS = (0.2, 0.3, 0.44)


class Even:
    """A model whose samples have one variance, and nothing of them is a texel's own."""

    def __init__(self, variance: float) -> None:
        self.variance = variance

    def reduced(self, values: Any) -> SimpleNamespace:
        return SimpleNamespace(values=values)

    def solved(self, values: Any) -> Any:
        return values / self.variance


def straight(rng: np.random.Generator) -> Any:
    """Of a base and a slope that are straight lines in phi: (base, slope), and base and slope as
    (offset, gradient), (P, 3) each."""
    lines = rng.uniform(0.2, 1.0, (2, 2, SAMPLES, 3))
    base, slope = (np.stack([o + g * phi for phi in PHIS], axis=-1) for o, g in lines)
    return (base, slope), lines


@pytest.fixture
def two() -> Any:
    rng = np.random.default_rng(5)
    return straight(rng), straight(rng), rng.uniform(0.0, 2.0, (SAMPLES, 3))


def test_derivatives_of_straight_lines_are_their_gradients(two: Any):
    (first, of_first), (second, of_second), radiance = two
    linear = Linear.about(Even(0.25), radiance, (first, second), PHIS, PSI)  # type: ignore[arg-type]
    lobes, derivatives = [], []
    for (base, by_base), (slope, by_slope) in (of_first, of_second):
        at = slope + by_slope * PHIS[1]
        lobes.append(base + by_base * PHIS[1] + PSI * at)
        derivatives.append(np.stack([by_base + PSI * by_slope, at], axis=-1))
    np.testing.assert_allclose(linear.by_first, derivatives[0], rtol=1e-5)
    np.testing.assert_allclose(linear.by_second, derivatives[1], rtol=1e-5)
    np.testing.assert_allclose(linear.between, lobes[0] - lobes[1], atol=1e-6)
    left = np.stack([radiance - lobe for lobe in lobes], axis=-1)
    wanted = np.concatenate([*derivatives, left], axis=-1) / 0.25
    np.testing.assert_allclose(linear.solved, wanted, rtol=1e-4, atol=1e-5)


def test_the_precision_is_that_of_both_bases_and_of_what_was_known_before(two: Any):
    (first, _), (second, _), radiance = two
    linear = Linear.about(Even(0.25), radiance, (first, second), PHIS, PSI)  # type: ignore[arg-type]
    crossed = sum(
        np.outer(linear.by_first[p, c], linear.by_second[p, c]) / 0.25
        for p in range(SAMPLES)
        for c in range(3)
    )
    wanted = (crossed + crossed.T) / 2 + np.eye(2) * NOTHING_KNOWN**-2
    np.testing.assert_allclose(linear.precision, wanted, rtol=1e-6)
    # Bases that contradict each other tell nothing, and no less than that.
    opposite = -first[0], -first[1]
    none = Linear.about(Even(1e-3), radiance, (first, opposite), PHIS, PSI)  # type: ignore[arg-type]
    np.testing.assert_allclose(none.precision, np.eye(2) * NOTHING_KNOWN**-2, atol=1e-9)


def of(by_first: Any, by_second: Any, between: Any, left: Any, precision: Any) -> Linear:
    """With C = 1; left: what either basis leaves of the samples."""
    solved = np.concatenate([by_first, by_second, *[one[..., None] for one in left]], axis=-1)
    return Linear(by_first, by_second, between, solved, np.asarray(precision))


PRECISION = np.array([[5.0, 1.0], [1.0, 3.0]])


def test_noise_moves_both_parameters_by_what_it_pulls(two: Any):
    """Half of the sum over both bases of J' n, and of d' e; what samples pull adds up in squares,
    or as their texels have it."""
    rng = np.random.default_rng(6)
    by, other = rng.normal(size=(2, SAMPLES, 3, 2))
    between, left, left_too = rng.normal(size=(3, SAMPLES, 3))
    linear = of(by, other, between, (left, left_too), PRECISION)
    pull = np.zeros((SAMPLES, 2))
    for p in range(SAMPLES):
        for c in range(3):
            mean, apart = (by[p, c] + other[p, c]) / 2, by[p, c] - other[p, c]
            pull[p] += mean * between[p, c] - apart * (left[p, c] + left_too[p, c]) / 2
    moved = pull / 2 @ np.linalg.inv(PRECISION)
    assert linear.error_of_rays(lambda each: each) == pytest.approx(
        tuple(np.sqrt((moved**2).sum(axis=0)))
    )

    def of_texels(each: Any) -> Any:  # four samples each
        return each.reshape(-1, 4, 2).sum(axis=1)

    together = moved.reshape(-1, 4, 2).sum(axis=1)
    assert linear.error_of_rays(of_texels) == pytest.approx(
        tuple(np.sqrt((together**2).sum(axis=0)))
    )


def scatter_of(linear: Linear, group: Any) -> Any:
    """Liang's and Zeger's sum, group by group, beside what the precision tells."""
    pulls = []
    for number in range(int(group.max()) + 1):
        of_group = group == number
        j1, j2 = linear.by_first[of_group], linear.by_second[of_group]
        e1, e2 = linear.solved[of_group][..., 4], linear.solved[of_group][..., 5]
        pulls.append((j1 * e2[..., None] + j2 * e1[..., None]).sum(axis=(0, 1)) / 2)
    count, told = len(pulls), np.linalg.inv(PRECISION)
    square = sum(np.outer(pull, pull) for pull in np.array(pulls) - np.mean(pulls, axis=0))
    return np.diagonal(told @ square @ told) * count / (count - 2) / np.diagonal(told)


@pytest.mark.parametrize("count", [3, 4, 8])
def test_groups_that_pull_together_scatter_more_than_samples_tell(count: int):
    rng = np.random.default_rng(7)
    by, other = rng.normal(size=(2, SAMPLES, 3, 2))
    left, left_too = 3 * rng.normal(size=(2, SAMPLES, 3))
    linear = of(by, other, np.zeros((SAMPLES, 3)), (left, left_too), PRECISION)
    group = np.arange(SAMPLES) % count
    wanted = scatter_of(linear, group)
    assert min(wanted) > 1
    assert linear.scatter([group]) == pytest.approx(tuple(wanted))
    # Of kinds of groups the one that scatters most, parameter by parameter.
    pairs = np.arange(SAMPLES) // 2
    both = np.maximum(wanted, scatter_of(linear, pairs))
    assert linear.scatter([pairs, group]) == pytest.approx(tuple(both))


def test_few_groups_and_calm_ones_say_nothing():
    rng = np.random.default_rng(8)
    by, other = rng.normal(size=(2, SAMPLES, 3, 2))
    left, left_too = 3 * rng.normal(size=(2, SAMPLES, 3))
    linear = of(by, other, np.zeros((SAMPLES, 3)), (left, left_too), PRECISION)
    assert linear.scatter([np.arange(SAMPLES) % 2, np.zeros(SAMPLES, int)]) == (1.0, 1.0)
    calm = of(by, other, np.zeros((SAMPLES, 3)), (1e-3 * left, 1e-3 * left_too), PRECISION)
    assert calm.scatter([np.arange(SAMPLES) % 8]) == (1.0, 1.0)
