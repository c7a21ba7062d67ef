"""The parts that the sky is estimated in."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.shading.sky_patches import _BANDS, patches_of_sky
from usdbrdf.shading.surroundings import HEIGHT, WIDTH
from usdbrdf.transport.environment import directions_of_pixels


def _patches(z_up: bool, clipped: np.ndarray | None = None) -> np.ndarray:
    none = np.zeros(HEIGHT * WIDTH, np.bool_)
    return patches_of_sky(none if clipped is None else clipped, z_up)


@pytest.mark.parametrize("z_up", [True, False])
def test_bands_of_the_sky_are_cut_evenly_into_azimuths(z_up: bool):
    found = _patches(z_up)
    towards = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    elevation = np.degrees(np.arcsin(towards[:, 2 if z_up else 1]))
    first = 0
    for low, high, count in _BANDS:
        own = found[(elevation > low) & (elevation < high)]
        assert own.min() == first
        assert own.max() == first + count - 1
        # A picture has 96 columns or more: up to rounding each patch has as many.
        number = np.bincount(own - first)
        assert number.max() - number.min() <= np.ceil(len(own) / WIDTH)
        first += count
    # Neighbours in azimuth are one after the other: each patch is one piece of its rows.
    for row in found.reshape(HEIGHT, WIDTH):
        changes = np.count_nonzero(row != np.roll(row, 1))
        assert changes in (0, len(np.unique(row)))


def test_a_patch_is_where_it_is_whichever_axis_is_up():
    """Pictures are the same with either, so that their pixels lie in the same patches."""
    np.testing.assert_array_equal(_patches(True), _patches(False))


def test_what_clips_is_in_patches_of_its_own():
    clipped = np.random.default_rng(1).random(HEIGHT * WIDTH) < 0.3
    plain, found = _patches(True), _patches(True, clipped)
    count = sum(number for _, _, number in _BANDS)
    assert plain.max() == count - 1
    np.testing.assert_array_equal(found, plain + count * clipped)
