"""The P-square algorithm: the published example, and the exact quantile of the same samples."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.texturing.psquare import QuantileState, quantile, spread, update

# R. Jain and I. Chlamtac, CACM 28(10), 1985, table I: the median of these is followed to 4.44.
PUBLISHED = [
    0.02, 0.15, 0.74, 3.39, 0.83, 22.37, 10.15, 15.43, 38.62, 15.92, 34.60, 10.28, 1.47, 0.40,
    0.05, 11.39, 0.27, 0.42, 0.09, 11.37,
]  # fmt: skip

DISTRIBUTIONS = {
    "uniform": lambda rng, shape: rng.random(shape),
    "normal": lambda rng, shape: rng.normal(5, 1, shape),
    "exponential": lambda rng, shape: rng.exponential(1, shape),
    "lognormal": lambda rng, shape: rng.lognormal(0, 1.5, shape),
}


def _fed(samples: np.ndarray, p: float) -> QuantileState:
    """State of T texels after samples (n, T, 3)."""
    state = QuantileState.empty(samples.shape[1])
    texel = np.arange(samples.shape[1], dtype=np.int32)
    for row in samples:
        update(state, texel, np.ascontiguousarray(row, np.float32), p)
    return state


def _one_channel(values: list[float] | np.ndarray) -> np.ndarray:
    return np.repeat(np.asarray(values, np.float32)[:, None, None], 3, axis=2)


def _as_published(values: list[float], p: float) -> tuple[list[float], list[int]]:
    """Heights and positions of the five markers, box 1 of the paper word for word, in doubles."""
    q = sorted(values[:5])
    n = [1, 2, 3, 4, 5]
    wanted: list[float] = [1, 1 + 2 * p, 1 + 4 * p, 3 + 2 * p, 5]
    step = [0, p / 2, p, (1 + p) / 2, 1]
    for x in values[5:]:
        # B1: the cell k of x, extending the extremes.
        if x < q[0]:
            q[0], k = x, 0
        elif q[4] <= x:
            q[4], k = x, 3
        else:
            k = max(i for i in range(4) if q[i] <= x)
        # B2: the positions of the markers above it, and the desired ones.
        for i in range(k + 1, 5):
            n[i] += 1
        wanted = [w + s for w, s in zip(wanted, step, strict=True)]
        # B3: markers 2 to 4 move by one if they are off by one or more.
        for i in (1, 2, 3):
            d = wanted[i] - n[i]
            if (d >= 1 and n[i + 1] - n[i] > 1) or (d <= -1 and n[i - 1] - n[i] < -1):
                s = 1 if d > 0 else -1
                parabolic = q[i] + s / (n[i + 1] - n[i - 1]) * (
                    (n[i] - n[i - 1] + s) * (q[i + 1] - q[i]) / (n[i + 1] - n[i])
                    + (n[i + 1] - n[i] - s) * (q[i] - q[i - 1]) / (n[i] - n[i - 1])
                )
                if q[i - 1] < parabolic < q[i + 1]:
                    q[i] = parabolic
                else:
                    q[i] = q[i] + s * (q[i + s] - q[i]) / (n[i + s] - n[i])
                n[i] += s
    return q, n


def test_the_published_example_ends_where_it_should():
    # Last row of table I: heights 0.02, 0.49, 4.44, 17.20, 38.62 at 1, 6, 10, 16, 20.
    heights, positions = _as_published(PUBLISHED, 0.5)
    assert [round(h, 2) for h in heights] == [0.02, 0.49, 4.44, 17.20, 38.62]
    assert positions == [1, 6, 10, 16, 20]
    state = _fed(_one_channel(PUBLISHED), 0.5)
    np.testing.assert_allclose(state.heights[0, 0], heights, rtol=1e-6)
    np.testing.assert_array_equal(state.positions[0, 0], positions[1:4])
    assert round(float(quantile(state, 0.5)[0, 0]), 2) == 4.44
    assert round(float(spread(state, 0.5)[0, 0]), 2) == round(heights[3] - heights[1], 2)


# Eighths: the desired positions are exact in binary, so "off by one or more" has one meaning.
@pytest.mark.parametrize("p", [0.125, 0.5, 0.875])
@pytest.mark.parametrize("kind", sorted(DISTRIBUTIONS))
def test_every_step_follows_the_published_algorithm(kind: str, p: float):
    samples = DISTRIBUTIONS[kind](np.random.default_rng(12345), (120, 6, 3)).astype(np.float32)
    state = _fed(samples, p)
    for t in range(6):
        for c in range(3):
            heights, positions = _as_published(samples[:, t, c].astype(float).tolist(), p)
            # float32 heights: a rounding per step.
            np.testing.assert_allclose(state.heights[t, c], heights, rtol=2e-4)
            np.testing.assert_array_equal(state.positions[t, c], positions[1:4])


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_up_to_five_samples_are_exact(n: int, p: float):
    samples = np.random.default_rng(12345).lognormal(0, 1, (n, 50, 3)).astype(np.float32)
    np.testing.assert_allclose(
        quantile(_fed(samples, p), p), np.quantile(samples, p, axis=0), rtol=1e-6
    )


def test_up_to_five_samples_the_spread_is_exact_too():
    samples = np.random.default_rng(12345).random((4, 50, 3)).astype(np.float32)
    expected = np.quantile(samples, 0.75, axis=0) - np.quantile(samples, 0.25, axis=0)
    np.testing.assert_allclose(spread(_fed(samples, 0.5), 0.5), expected, atol=1e-6)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("kind", sorted(DISTRIBUTIONS))
def test_two_hundred_samples_come_near_the_exact_quantile(kind: str, p: float):
    # In ranks, which no choice of units changes: off by less than the exact quantile of 200 samples
    # itself scatters, sqrt(p (1 - p) / n) (0.035 for the median). Measured: 0.01 to 0.022.
    n = 200
    samples = DISTRIBUTIONS[kind](np.random.default_rng(12345), (n, 200, 3)).astype(np.float32)
    found = quantile(_fed(samples, p), p)
    off = (samples < found).mean(axis=0) - p
    assert np.sqrt((off**2).mean()) < np.sqrt(p * (1 - p) / n)
    # And without a systematic lean: a hundredth.
    assert abs(off.mean()) < 0.01


def test_a_highlight_in_a_fifth_of_the_frames_does_not_move_the_median():
    # What the method rests on: 80 % of the samples at 1 +- 0.02, 20 % of them up to ten times that.
    rng = np.random.default_rng(12345)
    shape = (200, 200, 3)
    samples = np.where(
        rng.random(shape) < 0.2, rng.uniform(5, 10, shape), rng.normal(1, 0.02, shape)
    )
    state = _fed(samples.astype(np.float32), 0.5)
    exact = np.quantile(samples, 0.5, axis=0)
    off = np.abs(quantile(state, 0.5) / exact - 1)
    assert np.median(off) < 0.01
    assert (off > 0.05).mean() < 0.05
    # The running mean beside it is drawn to 2.3.
    np.testing.assert_allclose(state.mean, samples.mean(axis=0), rtol=1e-4)
    assert state.mean.mean() == pytest.approx(2.3, abs=0.05)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_constant_samples_stay_what_they_are(p: float):
    state = _fed(np.full((50, 4, 3), 0.7, np.float32), p)
    np.testing.assert_array_equal(quantile(state, p), np.float32(0.7))
    np.testing.assert_array_equal(spread(state, p), 0)
    np.testing.assert_allclose(state.mean, 0.7, rtol=1e-6)


@pytest.mark.parametrize("order", ["sorted", "reversed"])
@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_ordered_samples_are_the_worst_case_and_still_bounded(order: str, p: float):
    # A light that is turned up during the capture. Markers follow by one rank per sample, so the
    # tail away from which the samples move lags: 0.09 in rank on average, the median 0.025.
    samples = np.sort(np.random.default_rng(12345).random((200, 100, 3)), axis=0)
    if order == "reversed":
        samples = samples[::-1]
    found = quantile(_fed(samples.astype(np.float32), p), p)
    off = (samples < found).mean(axis=0) - p
    assert np.sqrt((off**2).mean()) < (0.03 if p == 0.5 else 0.1)


def test_the_order_of_the_markers_never_breaks():
    rng = np.random.default_rng(12345)
    # Many ties, jumps over ten decades, and a texel that stops being seen.
    samples = (10.0 ** rng.integers(-5, 5, (300, 50, 3))).astype(np.float32)
    state = QuantileState.empty(50)
    for i, row in enumerate(samples):
        texel = np.arange(50 if i < 150 else 25, dtype=np.int32)
        update(state, texel, row[: len(texel)], 0.5)
        assert (np.diff(state.heights[: len(texel), :, : min(i + 1, 5)], axis=2) >= 0).all()
    np.testing.assert_array_equal(state.samples, np.where(np.arange(50) < 25, 300, 150))
    np.testing.assert_array_equal(state.heights[:25, :, 0], samples.min(axis=0)[:25])
    np.testing.assert_array_equal(state.heights[:25, :, 4], samples.max(axis=0)[:25])
    inner = np.concatenate([np.ones((50, 3, 1)), state.positions], axis=2)
    assert (np.diff(inner, axis=2) >= 1).all()
    assert (state.positions[..., 2] < state.samples[:, None]).all()


def test_channels_and_texels_do_not_mix():
    rng = np.random.default_rng(12345)
    samples = rng.random((30, 8, 3)).astype(np.float32)
    together = quantile(_fed(samples, 0.5), 0.5)
    for t in range(8):
        for c in range(3):
            alone = quantile(_fed(_one_channel(samples[:, t, c]), 0.5), 0.5)
            assert alone[0, 0] == together[t, c]


def test_a_texel_without_samples_is_nan():
    state = QuantileState.empty(3)
    update(state, np.array([1], np.int32), np.full((1, 3), 2.0, np.float32), 0.5)
    found = quantile(state, 0.5)
    assert np.isnan(found[[0, 2]]).all()
    assert (found[1] == 2).all()
    assert np.isnan(spread(state, 0.5)[[0, 2]]).all()


def test_the_state_does_not_grow_with_the_frames():
    def per_texel(state: QuantileState) -> float:
        return sum(values.nbytes for values in state) / len(state.samples)

    rng = np.random.default_rng(12345)
    few = _fed(rng.random((3, 100, 3)), 0.5)
    many = _fed(rng.random((500, 100, 3)), 0.5)
    assert per_texel(few) == per_texel(many) == 112
    assert per_texel(many) <= 128
