"""Weighted means that outliers do not spoil, against their definition and their statistics."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.texturing.robust_mean import MeanState, RobustMean, robust_mean, update


def _state(values: np.ndarray, deviation: np.ndarray) -> MeanState:
    """values (N, T, 3), deviation (N,) or (N, T)."""
    count, texels = values.shape[:2]
    state = MeanState.empty(texels)
    deviation = np.broadcast_to(np.reshape(deviation, (count, -1)), (count, texels))
    footprint = np.tile(np.float32([1, 0, 1]), (texels, 1))
    for some, errors in zip(values.astype(np.float32), deviation.astype(np.float32), strict=True):
        update(state, np.arange(texels, dtype=np.int32), some, errors, footprint, footprint)
    return state


def _found(values: np.ndarray, deviation: np.ndarray) -> RobustMean:
    return robust_mean(_state(values, deviation))


@pytest.mark.parametrize("count", [1, 2, 4, 5, 6, 10, 13])
def test_without_outliers_it_is_the_weighted_mean(count: int):
    random = np.random.default_rng(count)
    deviation = random.uniform(0.5, 2, count)
    # All within two deviations of 7: none can be an outlier.
    values = 7 + deviation[:, None, None] * random.uniform(-1, 1, (count, 50, 3))
    weight = 1 / deviation**2
    expected = np.einsum("n,ntc->tc", weight, values) / weight.sum()
    np.testing.assert_allclose(_found(values, deviation).mean, expected, rtol=2e-6)


@pytest.mark.parametrize("spoilt", [(0, 1), (3, 4), (6,), (0, 9), (4, 5, 11)])
def test_highlights_in_some_frames_do_not_move_it(spoilt: tuple[int, ...]):
    values = 1 + 0.03 * np.random.default_rng(3).standard_normal((15, 200, 3))
    clean = _found(values, np.full(15, 0.03)).mean
    values[list(spoilt)] += 50
    moved = _found(values, np.full(15, 0.03)).mean - clean
    # A third of what the sample's own error would be; the plain mean moves by 3.3 and more.
    assert np.abs(moved).mean() < 0.01 * len(spoilt)
    assert np.abs(moved).max() < 0.03 * len(spoilt)


def test_error_is_that_of_the_best_weights_and_is_reported():
    # A third of the frames ten times as noisy as the others, as with exposure bracketing.
    deviation = np.tile([0.01, 0.02, 0.1], 4)
    noise = np.random.default_rng(5).standard_normal((12, 20_000, 3))
    found = _found(1 + deviation[:, None, None] * noise, deviation)
    best = 1 / (1 / deviation**2).sum()
    # Huber's estimate at 2.5 deviations loses next to nothing where there are no outliers.
    assert 0.97 * best < found.mean.var() < 1.06 * best
    assert np.abs(found.mean.mean() - 1) < 5 * np.sqrt(best / 60_000)
    np.testing.assert_allclose(found.variance.mean(), best, rtol=0.1)
    median = np.median(1 + deviation[:, None, None] * noise, axis=0).var()
    assert found.mean.var() < 0.6 * median


def test_errors_larger_than_said_are_reported_as_they_are():
    noise = 0.2 * np.random.default_rng(6).standard_normal((20, 5000, 3))
    found = _found(1 + noise, np.full(20, 0.05))
    assert 0.6 * found.mean.var() < found.variance.mean() < 1.2 * found.mean.var()


def _add(
    state: MeanState, texel: int, value: list, error: float, beside: list, uneven: list
) -> None:
    """One sample more."""
    one = (np.float32([row]) for row in (beside, uneven))
    update(state, np.array([texel], np.int32), np.float32([value]), np.float32([error]), *one)


def test_few_samples_and_none():
    state = MeanState.empty(3)
    assert np.isnan(robust_mean(state).mean).all()
    _add(state, 1, [1, 2, 3], 0.1, [4, 1, 2], [1, 1, 1])
    found = robust_mean(state)
    np.testing.assert_allclose(found.mean[1], [1, 2, 3])
    np.testing.assert_allclose(found.footprint[1], [4, 1, 2])
    assert found.variance[1] == pytest.approx(0.1**2, rel=1e-4)
    assert np.isnan(found.mean[[0, 2]]).all()
    # Two of a kind: the median of the first few is between them, not one of them.
    _add(state, 1, [3, 2, 3], 0.1, [4, 1, 2], [1, 1, 1])
    np.testing.assert_allclose(robust_mean(state).mean[1], [2, 2, 3], rtol=1e-6)


def test_footprint_is_weighted_as_the_samples_are():
    state = MeanState.empty(1)
    _add(state, 0, [1, 1, 1], 1, [1, 0, 1], [1, 2, 3])
    _add(state, 0, [1, 1, 1], 0.5, [6, 5, 11], [2, 2, 8])
    np.testing.assert_allclose(robust_mean(state).footprint[0], [5, 4, 9], rtol=1e-6)
    np.testing.assert_allclose(robust_mean(state).uneven[0], [1.8, 2, 7], rtol=1e-6)


def test_reading_changes_nothing_and_going_on_gives_the_same_bits():
    values = np.random.default_rng(7).uniform(0, 2, (13, 40, 3))
    whole = _state(values, np.full(13, 0.1))
    head = _state(values[:7], np.full(7, 0.1))
    before = {name: array.copy() for name, array in head._asdict().items()}
    robust_mean(head)
    for name, array in head._asdict().items():
        np.testing.assert_array_equal(array, before[name])
    saved = MeanState(**before)
    footprint = np.tile(np.float32([1, 0, 1]), (40, 1))
    for some in values[7:].astype(np.float32):
        error = np.full(40, 0.1, np.float32)
        update(saved, np.arange(40, dtype=np.int32), some, error, footprint, footprint)
    for name, array in whole._asdict().items():
        np.testing.assert_array_equal(saved._asdict()[name], array)


def test_state_is_132_bytes_per_texel():
    assert sum(array.nbytes for array in MeanState.empty(1000)._asdict().values()) == 144_000


def test_one_good_sample_beside_bad_ones_keeps_its_error():
    deviation = np.array([0.03, 1.0, 2.0, 1.5, 1.0])
    noise = np.random.default_rng(8).standard_normal((5, 500, 3))
    found = _found(1 + deviation[:, None, None] * noise, deviation)
    np.testing.assert_allclose(found.variance, 0.03**2, rtol=0.1)


def test_what_is_kept_of_a_texel_is_in_single_precision():
    found = _found(np.ones((3, 5, 3)), np.full(3, 0.1))._asdict()
    assert {name: values.dtype for name, values in found.items()} == dict.fromkeys(
        ("mean", "variance", "footprint", "uneven"), np.dtype(np.float32)
    )
