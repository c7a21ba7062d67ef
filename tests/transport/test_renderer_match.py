"""The mapping of the fitted lobe to UsdPreviewSurface: the models it stands on, and its inverse."""

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from usdbrdf.transport.directional_albedo import fitted_albedo, view_cosines
from usdbrdf.transport.renderer_match import cycles_albedo, measured_lobe, shown_lobe, storm_albedo

ANGLES = np.radians([10, 45, 75])
# Directional albedo at psi = 1 by independent quadratures: the fit, and Storm's own formula.
FITTED = {
    0.05: (0.0796, 0.0789, 0.177),
    0.1: (0.0785, 0.0776, 0.149),
    0.3: (0.0685, 0.0670, 0.0966),
    0.6: (0.0467, 0.0488, 0.0691),
    1.0: (0.0248, 0.0295, 0.0457),
}
STORM = {
    0.05: (0.1115, 0.1127, 0.325),
    0.1: (0.0865, 0.0862, 0.200),
    0.3: (0.0687, 0.0659, 0.0975),
    0.6: (0.0457, 0.0465, 0.0648),
    1.0: (0.0248, 0.0295, 0.0456),
}


@pytest.mark.parametrize("phi", sorted(FITTED))
def test_models_have_the_albedo_of_the_table(phi):
    f0, cosines = np.array([0.08]), np.cos(ANGLES)
    np.testing.assert_allclose(fitted_albedo(phi, f0, cosines)[:, 0], FITTED[phi], rtol=0.01)
    storm = storm_albedo(phi, f0, cosines, mirror_error=True)
    np.testing.assert_allclose(storm.lobe[:, 0], STORM[phi], rtol=0.01)
    # What is left of the diffuse term, mean of 1 - F(w.h): 1 - F0 but at the edge.
    np.testing.assert_allclose(storm.diffuse[:, 0], (0.920, 0.918, 0.908), atol=1e-3)
    # Smith's masking in Cycles agrees with the fit near the normal, not at the edge.
    cycles = cycles_albedo(phi, f0, cosines).lobe[:, 0]
    assert cycles[2] > 1.3 * FITTED[phi][2]


@pytest.mark.parametrize("psi", [0.0, 0.25, 0.5])
def test_the_table_extended_over_psi(psi):
    for phi in (0.02, 0.3, 1.0):
        expected = [directional_albedo(theta, phi, psi, steps=200) for theta in ANGLES]
        found = fitted_albedo(phi, np.array([0.08 * psi]), np.cos(ANGLES))[:, 0]
        np.testing.assert_allclose(found, expected, rtol=0.02)


@pytest.mark.parametrize("phi", [0.05, 0.1, 0.3, 0.6])
def test_matched_is_closer_than_measured_in_both_renderers(phi):
    psi = np.array([0.25, 0.5, 1.0])
    fit = fitted_albedo(phi, 0.08 * psi)
    shown = shown_lobe(np.full(3, phi), psi)
    for albedo in (cycles_albedo, storm_albedo):
        literal, matched = albedo(phi, 0.08 * psi), albedo(phi, shown.f0)

        def error(lobe, diffuse):
            return np.sqrt((((lobe + 0.5 * diffuse) / (fit + 0.5) - 1) ** 2).mean())

        assert error(matched.lobe, shown.diffuse * matched.diffuse) < 0.9 * error(*literal)


def test_uniform_light_leaves_as_much_as_from_the_fit():
    for phi in (0.05, 0.3, 0.8):
        shown = shown_lobe(phi, 0.5)
        for albedo in (cycles_albedo, storm_albedo):
            there = albedo(phi, np.array([shown.f0]))
            total = (there.lobe + 0.5 * shown.diffuse * there.diffuse).mean()
            expected = (fitted_albedo(phi, np.array([0.04])) + 0.5).mean()
            assert total == pytest.approx(expected, rel=0.03)
    assert len(view_cosines()) > 10


def test_the_inverse_gives_back_psi():
    for phi in (0.0, 0.003, 0.05, 0.31, 1.0):
        for psi in (0.0, 0.02, 0.37, 1.0, 3.0):
            shown = shown_lobe(phi, psi)
            again, factor = measured_lobe(phi, float(shown.f0))
            assert again == pytest.approx(psi, abs=1e-9)
            assert factor == pytest.approx(float(shown.diffuse), abs=1e-12)


def test_more_reflectance_is_more_psi():
    for phi in (0.0, 0.2, 1.0):
        psi = [measured_lobe(phi, f0)[0] for f0 in np.linspace(0.001, 0.2, 30)]
        assert (np.diff(psi) > 0).all()
    # No reflectance is no psi; what is beyond the table is its end.
    assert measured_lobe(0.3, 0.0)[0] == 0
    assert measured_lobe(0.3, 0.9)[0] == pytest.approx(4)
