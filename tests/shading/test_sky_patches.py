"""The parts that the sky is estimated in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf import calibration
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading.sky_patches import _BANDS, patches_of_sky, sources_in_sky
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings
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


SATURATED, GROUND = 5.0, 1e-6
ABOVE = float(np.exp(calibration.pair("outside.above_limit")[0]))


def _first(z_up: bool, dark_part: float, bright: Any) -> Any:
    """At what radiance a patch just over the horizon starts, of which nothing was seen, where on
    one side of its middle all clips, or is ``bright``, and so much of the rest is dark."""
    patch = sum(number for _, _, number in _BANDS[:3]) - 12
    none = np.zeros(HEIGHT * WIDTH, np.bool_)
    own = _patches(z_up) == patch
    towards = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    middle = towards[own].mean(axis=0)
    near = towards @ middle > np.cos(calibration.number("outside.alike_within")) * np.linalg.norm(
        middle
    )
    around = np.flatnonzero(near & ~own)
    dark, clipped = none.copy(), none.copy()
    number = round(dark_part * len(around))
    dark[around[:number]] = True
    clipped[around[number:]] = bright is None
    radiance = np.zeros((len(none), 3), np.float32)
    radiance[dark] = GROUND
    radiance[around[number:]] = SATURATED if bright is None else bright
    measured = none.copy()
    measured[around] = ~clipped[around]
    seen = Surroundings(radiance=radiance, coverage=CoverageMap.of(measured, clipped), dark=dark)
    asked: Any = SimpleNamespace(reflected=np.ones((4, 3)))
    patches = patches_of_sky(clipped, z_up)
    used = np.array([patch])
    share = np.ones((int(patches.max()) + 1, 4))
    return np.exp(sources_in_sky(asked, seen, patches, share, used, z_up).mean[0]), number / len(
        around
    )


@pytest.mark.parametrize("z_up", [True, False])
@pytest.mark.parametrize("dark", [0.0, 0.3, 0.8])
def test_sky_beside_what_clips_starts_at_its_level_as_far_as_it_is_not_dark(
    z_up: bool, dark: float
):
    """What clips is above what saturates; where most of what is near is dark, the median would be
    nothing."""
    found, part = _first(z_up, dark, None)
    np.testing.assert_allclose(found, (1 - part) * SATURATED * ABOVE, rtol=1e-6)


def test_sky_beside_what_was_measured_starts_at_its_median_as_far_as_it_is_not_dark():
    bright = np.array([3.0, 2.0, 1.0])
    found, part = _first(True, 0.6, bright)
    np.testing.assert_allclose(found, (1 - part) * bright, rtol=1e-6)


def test_where_all_that_is_near_is_dark_the_sky_starts_dark():
    found, part = _first(True, 1.0, None)
    assert part == 1
    assert (found < 1e-3).all()
