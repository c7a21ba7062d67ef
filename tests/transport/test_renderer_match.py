"""The mapping of the fitted lobe to UsdPreviewSurface: the models it stands on, and its inverse."""

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from usdbrdf.transport import renderer_match
from usdbrdf.transport.brdf import DIELECTRIC, distribution, fresnel, masking, masking_width
from usdbrdf.transport.directional_albedo import fitted_albedo, view_cosines
from usdbrdf.transport.let_through import share_seen
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


def test_dielectrics_reflect_as_fresnel_says():
    """The mean over both polarisations, from the angle below the surface."""
    f0, cosine = np.array([0.04, 0.2, 0.32]), np.array([1.0, 0.8, 0.3, 1e-9])
    found = renderer_match._dielectric(f0, cosine)
    index = (1 + np.sqrt(f0)) / (1 - np.sqrt(f0))
    below = np.sqrt(1 - (1 - cosine[:, None] ** 2) / index**2)
    c = cosine[:, None]
    across = ((c - index * below) / (c + index * below)) ** 2
    along = ((index * c - below) / (index * c + below)) ** 2
    np.testing.assert_allclose(found, (across + along) / 2, rtol=1e-9)
    np.testing.assert_allclose(found[0], f0)
    np.testing.assert_allclose(found[-1], 1, atol=1e-6)


def test_tables_are_read_bilinearly_between_their_knots_and_not_beyond():
    phi, f0 = renderer_match._PHI, renderer_match._F0
    # From mirrors to phi = 1, closer where it is small; up to four times a plain surface's.
    np.testing.assert_allclose(phi[[0, 12, 24]], [0, 0.25, 1])
    np.testing.assert_allclose(f0[[0, 10, 20]], [0, 0.08, 0.32])
    row, column = np.mgrid[:25, :21]
    values = 2 * row**2 + 30 * column + row * column
    asked = np.array([phi[3], (phi[3] + phi[4]) / 2, phi[24], 2.0, 0.0])
    of_f0 = np.array([f0[7], 0.25 * f0[7] + 0.75 * f0[8], f0[20], 1.0, 0.0])
    between = 2 * (9 + 16) / 2 + 30 * 7.75 + 3.5 * 7.75
    wanted = [values[3, 7], between, values[24, 20], values[24, 20], 0]
    np.testing.assert_allclose(renderer_match._bilinear(values, asked, of_f0), wanted)


def test_the_least_lies_at_the_vertex_and_within_a_step_of_what_was_tried():
    x = np.linspace(0, 1, 11)
    error = np.array([(x - 0.43) ** 2, 3 * (x - 0.08) ** 2 + 1, -x, x])
    found = renderer_match._least(error, x)
    np.testing.assert_allclose(found[:2], [0.43, 0.08])
    assert found[2] > 0.9
    assert found[3] < 0.1


def test_a_metal_is_shown_by_its_share_of_the_brightest_of_the_table():
    for phi in (0.0, 0.3, 1.0):
        share = renderer_match.shown_share_of_metal(phi)
        assert share == pytest.approx(float(shown_lobe(phi, 4.0).f0) / 0.32)


@pytest.mark.parametrize(("row", "column"), [(12, 10), (6, 14), (20, 5)])
def test_beside_the_renderers_own_lobe_as_much_leaves_as_from_the_fit(row: int, column: int):
    """At knots of the table, of a grey of a half as it is seen from the front."""
    phi, f0 = (row / 24) ** 2, np.array([0.08 * (column / 10) ** 2])
    factor = renderer_match.kept_beside_microfacets(phi, float(f0[0]))
    fitted = fitted_albedo(phi, f0, kind=DIELECTRIC).mean()
    there = cycles_albedo(phi, f0)
    seen = 0.5 / share_seen(np.array([phi]), f0 / 0.08)[0]
    total = there.lobe.mean() + factor * 0.5 * there.diffuse.mean()
    assert total == pytest.approx(fitted + seen, rel=1e-6)


@pytest.mark.parametrize(("phi", "f0"), [(0.4, 0.04), (0.7, 0.3)])
def test_the_factor_gives_a_ggx_lobe_the_albedo_of_the_fit(phi: float, f0: float):
    """Both by an integral over directions, of even light from everywhere."""
    count = 64
    mid = (np.arange(count) + 0.5) / count
    square, other, turn = np.meshgrid(mid, mid, mid, indexing="ij")
    cos_i, cos_o = np.sqrt(square), np.sqrt(other)  # each by its cosine
    sin_i, sin_o = np.sqrt(1 - square), np.sqrt(1 - other)
    towards = sin_i * sin_o * np.cos(2 * np.pi * turn) + cos_i * cos_o
    half = np.sqrt((1 + towards) / 2)
    cos_h = (cos_i + cos_o) / (2 * half)
    facets = distribution(1 - cos_h**2, phi) * fresnel(f0, half)

    def albedo(y: float) -> float:  # masking holds 1 / 4 cos cos
        return float((np.pi * facets * masking(cos_i, y) * masking(cos_o, y)).mean())

    wanted = albedo(masking_width(phi)) / albedo(phi)
    assert renderer_match.matching_factor(phi, f0) == pytest.approx(wanted, rel=0.02)
    assert abs(wanted - 1) > 0.01
