"""The brightest light that spills onto a pixel's neighbours, against NumPy's and SciPy's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from usdbrdf.texturing.samples import _median, brightest_glare


def _expected(radiance: np.ndarray, valid: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    level = radiance.max(axis=2)
    usual = float(np.median(level[valid])) if valid.any() else 0.0
    glaring = np.where((valid | clipped) & (level > 10 * usual), level, 0)
    return ndimage.maximum_filter(glaring, 7, mode="nearest")


@pytest.mark.parametrize("lamps", [0, 5, 40])
def test_lamps_reach_three_pixels(lamps: int):
    rng = np.random.default_rng(lamps)
    radiance = rng.lognormal(0, 0.3, (61, 47, 3)).astype(np.float32)
    rows, columns = rng.integers(0, 61, lamps), rng.integers(0, 47, lamps)
    radiance[rows, columns] = rng.uniform(50, 90, (lamps, 3))
    clipped = radiance.max(axis=2) > 80
    valid = ~clipped & (rng.random((61, 47)) > 0.1)
    radiance[~valid & ~clipped] = np.nan  # what is not known is not looked at
    known = np.nan_to_num(radiance)
    found = brightest_glare(radiance, valid, clipped)
    np.testing.assert_array_equal(found, _expected(known, valid, clipped))
    assert (found > 0).any() == (lamps > 0)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 1000, 1001])
def test_the_median_is_numpys(count: int):
    # Close together and far apart, on both sides of zero.
    rng = np.random.default_rng(count)
    level = (rng.normal(0, 1, (40, 50)) * 10.0 ** rng.integers(-6, 6, (40, 50))).astype(np.float32)
    level[:20] = 1 + level[:20] * np.float32(1e-7)
    valid = np.zeros(level.shape, bool)
    valid.flat[rng.permutation(level.size)[:count]] = True
    expected = float(np.median(level[valid])) if count else 0.0
    assert _median(level, valid) == expected


def test_without_a_valid_pixel_the_clipped_ones_glare():
    radiance = np.full((9, 9, 3), 2.0, np.float32)
    nowhere = np.zeros((9, 9), bool)
    lamp = nowhere.copy()
    lamp[4, 4] = True
    found = brightest_glare(radiance, nowhere, lamp)
    assert found[1, 7] == 2
    assert found[0, 4] == 0
