"""How far pictures were smoothed, from their noise."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from usdbrdf.material.fit_views import _likely
from usdbrdf.material.observations import correlations, smoothing_of


def _noise(smoothed_by: float, later: float = 0.0, tiles: int = 200):
    """(tiles, 24, 24): one and white noise of 2 %, smoothed, and white noise on top."""
    random = np.random.default_rng(3)
    noise = random.normal(size=(tiles, 40, 40))
    if smoothed_by > 0:
        noise = gaussian_filter(noise, (0, smoothed_by, smoothed_by))
    noise = 0.02 * noise[:, 8:-8, 8:-8] / noise.std()
    return 1 + noise + later * random.normal(size=noise.shape)


def test_noise_of_separate_pixels_is_not_smoothed():
    assert smoothing_of([correlations(_noise(0))]) == 0


@pytest.mark.parametrize("blur", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("later", [0.0, 0.02])
def test_the_blur_of_smoothed_noise_is_found_whatever_was_added_later(blur, later):
    # The mean of a tile is its own: long correlations come out a little short.
    assert smoothing_of([correlations(_noise(blur, later))]) == pytest.approx(blur, rel=0.12)


def test_a_few_tiles_say_nothing():
    assert math.isnan(smoothing_of([correlations(_noise(2, tiles=20))]))
    assert math.isnan(smoothing_of([]))


def test_structure_of_the_surface_is_no_smoothing():
    row, column = np.indices((24, 24))
    slopes = np.random.default_rng(4).normal(size=(2, 200, 1, 1))
    assert math.isnan(smoothing_of([correlations(1 + slopes[0] * row + slopes[1] * column)]))


def test_footprints_are_likely_about_what_the_noise_tells():
    widths = (0.7, 0.5, 1.0, 1.4, 2.0)
    sharp, smooth = ([_likely(width, s) for width in widths] for s in (0.0, 2.0))
    assert widths[int(np.argmax(sharp))] == 0.7
    assert widths[int(np.argmax(smooth))] == 2.0
    assert [_likely(width, math.nan) for width in widths] == [1.0] * 5
