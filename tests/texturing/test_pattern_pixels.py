"""What single pixels cover of an atlas, and what counts of what they show."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.texturing import pattern_pixels
from usdbrdf.texturing.pattern_pixels import _without_common, covers

WIDTH, HEIGHT = 20, 16
STEPS = [
    [[1.0, 0.0], [0.0, 1.0]],
    [[0.4, 0.3], [-0.2, 0.7]],
    [[1.6, -0.5], [0.3, 1.4]],
    [[0.0, 1.2], [-1.5, 0.2]],
]


def _covered(where, step, column, row):
    covered = np.full(25, np.nan, np.float32)
    fits = covers(np.float32(where), np.float32(step), column, row, WIDTH, HEIGHT, covered)
    return fits, covered.reshape(5, 5)


def _hats(where, step, column, row):
    """The same by hats of linear interpolation, at the middles of even parts of the pixel."""
    (xx, xy), (yx, yy) = step
    across, down = (int(np.ceil(2 * max(abs(a), abs(b)))) + 1 for a, b in ((xx, xy), (yx, yy)))
    right = (np.arange(across) + 0.5) / across - 0.5
    below = ((np.arange(down) + 0.5) / down - 0.5)[:, None]
    x = np.clip(where[0] - 0.5 + right * xx + below * yx, 0, WIDTH - 1)
    y = np.clip(where[1] - 0.5 + right * xy + below * yy, 0, HEIGHT - 1)
    hat = [
        np.maximum(1 - np.abs(at[..., None] - (middle + np.arange(-2, 3))), 0)
        for at, middle in ((x, column), (y, row))
    ]
    return np.einsum("bax,bay->yx", *hat) / (across * down)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("off", [(0.5, 0.5), (0.1, 0.8)])
@pytest.mark.parametrize(("column", "row"), [(8, 6), (0, 6), (19, 15), (8, 0), (1, 14)])
def test_a_pixel_covers_what_its_parts_lie_between(step, off, column, row):
    where = column + off[0], row + off[1]
    fits, covered = _covered(where, step, column, row)
    assert fits
    np.testing.assert_allclose(covered, _hats(where, step, column, row), atol=1e-5)
    assert covered.sum() == pytest.approx(1, abs=1e-5)


def test_a_pixel_that_covers_more_than_two_texels_to_a_side_does_not_fit():
    where = 8.5, 6.5
    assert _covered(where, [[3.9, 0], [0, 1]], 8, 6)[0]
    assert not _covered(where, [[5.2, 0], [0, 1]], 8, 6)[0]
    assert not _covered(where, [[1, 0], [0, 5.2]], 8, 6)[0]
    for axis in range(2):
        for way in (-1, 1):
            for far, fits in ((1.65, True), (1.69, False)):
                moved = list(where)
                moved[axis] += way * far
                assert _covered(moved, [[1, 0], [0, 1]], 8, 6)[0] == fits


NOISE, ERROR = 0.01, 0.05


def _without(rest, values, variance, shown=None, texel=None):
    """(H, W, 3) and (H, W)."""
    size = rest.shape[:2]
    beside, weight = np.full((*size, 3), np.nan, np.float32), np.zeros(size, np.float32)
    shown = np.zeros(size, np.int32) if shown is None else shown
    texel = np.zeros(size, np.int32) if texel is None else texel
    _without_common(
        len(rest), shown, texel, np.asarray(rest, np.float32), np.float32(values),
        np.float32(variance), NOISE, ERROR, beside, weight,
    )  # fmt: skip
    return beside, weight


def test_what_a_pixel_has_in_common_with_those_around_it_is_taken_off():
    rng = np.random.default_rng(1)
    rest = rng.normal(0, 0.01, (12, 14, 3)).astype(np.float32) + np.float32([1, 2, 3])
    shown = np.zeros((12, 14), np.int32)
    shown[:, 9:] = 1
    rest[:, 9:] += 5
    rest[4, 3] = np.nan
    beside, weight = _without(rest, [[0.3, 0.6, 0.9]], [0.04], shown)
    assert np.isnan(beside[4, 3]).all()
    assert weight[4, 3] == 0
    for j, i in ((0, 0), (5, 5), (11, 13), (6, 8), (3, 9), (4, 4)):
        near = np.s_[max(j - 3, 0) : j + 4, max(i - 3, 0) : i + 4]
        own = rest[near][(shown[near] == shown[j, i]) & np.isfinite(rest[near][..., 0])]
        np.testing.assert_allclose(beside[j, i], rest[j, i] - own.mean(axis=0), atol=1e-5)
    known = np.isfinite(rest[..., 0])
    assert (weight[known] > 0).all()


def test_weights_are_of_the_error_and_less_the_farther_a_pixel_lies_off():
    """Tukey's biweight about the mean, of what texels differ by on top of a pixel's own error."""
    limit = pattern_pixels._OUTLYING
    values, variance = [[0.3, 0.6, 0.9], [3.0, 3.0, 3.0]], [0.02, 0.05]
    own = [(ERROR * level) ** 2 + NOISE**2 for level in (0.6, 3.0)]
    texel = np.zeros((20, 20), np.int32)
    texel[10, 10] = 1
    for at, number in (((5, 5), 0), ((10, 10), 1)):
        for share in (0.0, 0.6, 0.9, 1.2):
            rest = np.zeros((20, 20, 3), np.float32)
            # What it adds to the mean of the 49 is taken off as well.
            size = share * limit * np.sqrt(own[number] + variance[number]) * 49 / 48
            rest[at] = size * np.array([1.2, 0.4, -1.0]) / np.sqrt(2.6 / 3)
            beside, weight = _without(rest, values, variance, texel=texel)
            wanted = max(1 - share**2, 0) ** 2 / own[number]
            assert weight[at] == pytest.approx(wanted, rel=1e-3)
            if share:
                level = np.sqrt((beside[at] ** 2).mean())
                assert level == pytest.approx(size * 48 / 49, rel=1e-4)


def test_too_few_around_a_pixel_tell_nothing_in_common():
    for count, told in ((9, False), (10, True)):
        rest = np.full((12, 14, 3), np.nan, np.float32)
        rest.reshape(-1, 3)[[14 * (k // 5) + k % 5 for k in range(count)]] = 1
        _, weight = _without(rest, [[0.3, 0.6, 0.9]], [0.04])
        # In a corner of it all others are near enough.
        assert (weight[0, 2] > 0) == told
