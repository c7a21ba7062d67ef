"""The figures against values known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from usdbrdf.evaluation.metrics import finite, nrmse, psnr, relative_l2
from usdbrdf.files.colour import display_exposure

REFERENCE = np.random.default_rng(1).random((6, 5, 3)).astype(np.float32) + np.float32(0.1)
ALL = np.ones((6, 5), bool)


def test_equal_pictures_have_no_error():
    assert relative_l2(REFERENCE, REFERENCE, ALL) == 0
    assert psnr(REFERENCE, REFERENCE, ALL) == math.inf


def test_a_picture_a_tenth_too_bright_has_a_relative_l2_of_a_tenth():
    assert relative_l2(REFERENCE * 1.1, REFERENCE, ALL) == pytest.approx(0.1, rel=1e-5)


def test_an_offset_of_a_tenth_is_20_db():
    assert psnr(REFERENCE + 0.1, REFERENCE, ALL) == pytest.approx(20, abs=1e-4)


def test_only_counted_pixels_count():
    counted = ALL.copy()
    counted[0, 0] = False
    image = REFERENCE.copy()
    image[0, 0] = np.nan
    assert relative_l2(image, REFERENCE, counted) == 0
    assert psnr(image, REFERENCE, counted) == math.inf
    assert math.isnan(relative_l2(image, REFERENCE, ~ALL))
    assert math.isnan(psnr(image, REFERENCE, ~ALL))


def test_a_large_texel_weighs_more():
    reference = np.ones((2, 3), np.float32)
    values = np.array([[1, 1, 1], [3, 3, 3]], np.float32)
    # Squared errors 0 and 4 with weights 3 and 1, over mean squares of 1.
    assert nrmse(values, reference, np.array([3.0, 1.0], np.float32)) == pytest.approx(1.0)
    assert math.isnan(nrmse(values[:0], reference[:0], np.zeros(0, np.float32)))


def test_the_exposure_shows_the_90th_percentile_as_eight_tenths():
    level = np.linspace(0, 10, 101).astype(np.float32)
    assert display_exposure(level) == pytest.approx(0.8 / 9)
    assert display_exposure(level[:0]) == display_exposure(np.zeros(3, np.float32)) == 1


def test_documents_get_no_infinity():
    assert finite(math.inf) is None
    assert finite(math.nan, 2) is None
    assert finite(1.23456, 2) == 1.23
