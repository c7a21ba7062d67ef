"""rho = pi L_d / S, and where it means nothing."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.shading.base_color import albedo_from_irradiance


def test_the_albedo_of_a_lambertian_surface():
    # L_d = rho S / pi.
    rho = np.array([[0.1, 0.5, 0.9], [0, 1, 0.3]], np.float32)
    shading = np.array([[1, 2, 3], [0.5, 10, 1e3]], np.float32)
    found, known = albedo_from_irradiance(rho * shading / np.float32(np.pi), shading, 1e-3)
    np.testing.assert_allclose(found, rho, rtol=1e-6)
    assert known.all()


@pytest.mark.fault("L4")
def test_too_little_light_is_unknown_not_dark():
    radiance = np.full((4, 3), 0.1, np.float32)
    shading = np.array([[1, 1, 1], [1, 1, 0.01], [0, 0, 0], [0.05, 0.05, 0.05]], np.float32)
    found, known = albedo_from_irradiance(radiance, shading, 0.05)
    # One channel below the floor is enough; at the floor is below.
    np.testing.assert_array_equal(known, [True, False, False, False])
    np.testing.assert_array_equal(found[~known], 0)
    assert np.isfinite(found).all()


@pytest.mark.fault("L5")
def test_more_than_one_is_reported_as_it_is():
    found, known = albedo_from_irradiance(
        np.full((1, 3), 2.0, np.float32), np.full((1, 3), np.pi, np.float32), 1e-3
    )
    np.testing.assert_allclose(found, 2, rtol=1e-6)
    assert known.all()
