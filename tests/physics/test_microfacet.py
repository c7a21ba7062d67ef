"""The lobe of renderers: Smith's masking of the same alpha, and Fresnel's equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from tests.physics.surfaces import quad, world_of
from tests.physics.test_predict import RGB, _open_sky, _points
from usdbrdf.transport.brdf import (
    BECKMANN,
    CONDUCTOR,
    DIELECTRIC,
    F0_OF_PSI,
    PAPER,
    beckmann_distribution,
    beckmann_masking,
    distribution,
    reflectance,
    width_of_masking,
)
from usdbrdf.transport.directional_albedo import fitted_albedo
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.renderer_match import cycles_albedo


def _fresnel(ior: float, cosine: np.ndarray) -> np.ndarray:
    """By Snell's law and the amplitudes of both polarisations."""
    refracted = np.sqrt(1 - (1 - cosine**2) / ior**2)
    s = (cosine - ior * refracted) / (cosine + ior * refracted)
    p = (ior * cosine - refracted) / (ior * cosine + refracted)
    return (s**2 + p**2) / 2


@pytest.mark.parametrize("psi", [0.1, 0.25, 0.5, 0.75, 1.0])
def test_fresnels_equations_are_nearly_affine_in_psi(psi: float):
    cosine = np.linspace(0.45, 1, 50)
    root = np.sqrt(F0_OF_PSI * psi)
    base, rise = reflectance(cosine, DIELECTRIC)
    exact = _fresnel((1 + root) / (1 - root), cosine)
    if psi in (0.25, 0.75):  # through these
        np.testing.assert_allclose(base + F0_OF_PSI * psi * rise, exact, atol=1e-6)
    # Beyond them by what a hundredth of psi is worth, more at grazing angles.
    np.testing.assert_allclose(base + F0_OF_PSI * psi * rise, exact, atol=0.02)
    np.testing.assert_allclose((base + F0_OF_PSI * psi * rise)[-1], F0_OF_PSI * psi, atol=1e-6)


def test_schlick_alone_is_too_dark_at_grazing_angles():
    # Why psi came out twice as large on floors that are seen at a low angle.
    cosine = np.array([0.4])
    for kind, expected in ((PAPER, 0.115), (CONDUCTOR, 0.115), (DIELECTRIC, 0.130)):
        base, rise = reflectance(cosine, kind)
        assert float(base[0] + 0.04 * rise[0]) == pytest.approx(expected, abs=4e-3)
    assert width_of_masking(0.1, PAPER) == pytest.approx(0.3025)
    assert width_of_masking(0.1, DIELECTRIC) == width_of_masking(0.1, CONDUCTOR) == 0.1


def _microfacet_albedo(
    theta: float, alpha: float, psi: float, kind: int = DIELECTRIC, steps: int = 300
) -> float:
    """Directional albedo by quadrature over half vectors, dw = 4 (wo.h) dh."""
    wo = np.array([np.sin(theta), 0.0, np.cos(theta)])
    log_s = np.linspace(np.log(1e-4), np.log(1e4 / alpha), 4 * steps)
    azimuth = (np.arange(steps) + 0.5) * 2 * np.pi / steps
    t = np.arctan(alpha * np.exp(log_s))[:, None]
    h = np.stack(
        [np.sin(t) * np.cos(azimuth), np.sin(t) * np.sin(azimuth), np.cos(t) + 0 * azimuth], axis=-1
    )
    woh = h @ wo
    cos_in = 2 * woh * h[..., 2] - wo[2]
    front = (woh > 0) & (cos_in > 0)
    x, woh = np.where(front, cos_in, 1.0), np.where(front, woh, 1.0)

    def smith(c: np.ndarray) -> np.ndarray:
        if kind == BECKMANN:  # not the rational form
            s = np.minimum(c / (alpha * np.sqrt(np.maximum(1 - c**2, 1e-12))), 20)
            return 2 / (1 + erf(s) + np.exp(-(s**2)) / (s * np.sqrt(np.pi)))
        return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2))

    base, rise = reflectance(woh, DIELECTRIC)
    d = (beckmann_distribution if kind == BECKMANN else distribution)(np.sin(t) ** 2, alpha)
    f = d * smith(x) * smith(wo[2]) * (base + F0_OF_PSI * psi * rise) / (4 * x * wo[2])
    value = np.where(front, f * x * 4 * woh, 0) * np.sin(t) ** 2 * np.cos(t)
    return float(value.mean(axis=1).sum() * 2 * np.pi * (log_s[1] - log_s[0]))


@pytest.mark.parametrize(
    ("degrees", "phi", "psi"), [(10, 0.1, 0.5), (60, 0.2, 1.0), (70, 0.4, 0.3)]
)
def test_even_light_is_multiplied_by_the_directional_albedo(degrees: float, phi: float, psi: float):
    lit = replace(_open_sky(), lobe=DIELECTRIC)
    one = np.ones(400, np.float32)
    found = lobe_radiance(lit, _points(degrees * np.ones(400)), phi * one, psi * one, 64, 0)
    wanted = _microfacet_albedo(np.radians(degrees), phi, psi)
    np.testing.assert_allclose(found.mean(axis=0), RGB * wanted, rtol=0.01)
    cosine = np.array([np.cos(np.radians(degrees))])
    table = fitted_albedo(phi, np.array([F0_OF_PSI * psi]), cosine, kind=DIELECTRIC)
    assert float(table[0, 0]) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize(("degrees", "phi"), [(10, 0.1), (60, 0.2), (70, 0.4)])
def test_facets_after_beckmann_reflect_even_light_by_their_albedo(degrees: float, phi: float):
    lit = replace(_open_sky(), lobe=BECKMANN)
    one = np.ones(400, np.float32)
    found = lobe_radiance(lit, _points(degrees * np.ones(400)), phi * one, 0.5 * one, 64, 0)
    wanted = _microfacet_albedo(np.radians(degrees), phi, 0.5, BECKMANN)
    np.testing.assert_allclose(found.mean(axis=0), RGB * wanted, rtol=0.015)


@pytest.mark.parametrize("alpha", [0.01, 0.1, 0.5, 1.0])
def test_facets_cover_the_surface_once(alpha: float):
    theta = np.concatenate([[0], np.geomspace(1e-5, np.pi / 2, 20_000)])
    for of_angle in (distribution, beckmann_distribution):
        seen = of_angle(np.sin(theta) ** 2, alpha) * np.cos(theta) * np.sin(theta)
        assert 2 * np.pi * np.trapezoid(seen, theta) == pytest.approx(1, abs=1e-3)
    assert np.isfinite(beckmann_distribution(np.float32(1), np.float32(alpha)))


def test_cycles_shows_nearly_what_was_fitted():
    # Its masking is the height-correlated one, and light between facets is little.
    f0 = np.array([0.02, 0.04, 0.08])
    for phi in (0.05, 0.2, 0.4):
        fitted = fitted_albedo(phi, f0, kind=DIELECTRIC).mean(axis=0)
        np.testing.assert_allclose(fitted, cycles_albedo(phi, f0).lobe.mean(axis=0), rtol=0.12)


def test_objects_with_facets_after_beckmann_reflect_by_these():
    # Three floors side by side; the second has them.
    world = world_of([quad((4 * k, 0, 0), (4, 0, 0), (0, 4, 0)) for k in range(3)])
    lit = world.lit(world.per_object([RGB] * 3))
    sky = replace(lit, environment=_open_sky().environment, lobe=DIELECTRIC)
    face = np.array([0, 2, 3, 4, 5, 1], np.int32)
    points = _points(70 * np.ones(6))._replace(face=face)
    one, stream = np.ones(6, np.float32), np.arange(6)

    def found(lit: LitScene, own: np.ndarray) -> np.ndarray:
        return lobe_radiance(lit, points.take(own), 0.3 * one[own], one[own], 32, 0, own)

    all_of_them = found(replace(sky, beckmann=np.array([False, True, False])), stream)
    rounded = np.isin(stream, [1, 2])
    for kind, own in ((DIELECTRIC, ~rounded), (BECKMANN, rounded)):
        which = np.flatnonzero(own)
        np.testing.assert_array_equal(all_of_them[own], found(replace(sky, lobe=kind), which))
    assert (found(replace(sky, lobe=DIELECTRIC), stream) != all_of_them)[rounded].all()


def test_light_that_comes_and_goes_along_the_normal_is_finite():
    one = np.ones(64, np.float32)
    lit = replace(_open_sky(), lobe=BECKMANN)
    assert np.isfinite(lobe_radiance(lit, _points(0 * one), 0.1 * one, one, 64, 0)).all()
    beyond = np.float32([1 - 1e-7, 1, 1 + 1e-7, 1 + 4e-7])
    np.testing.assert_allclose(beckmann_masking(beyond, np.float32(0.1)), 0.5, rtol=1e-4)


def test_a_metal_among_dielectrics_reflects_by_its_own_equations():
    # One call, two kinds: each as if it were alone, with the same random numbers.
    one, stream = np.ones(6, np.float32), np.arange(6)
    points = _points(40 * np.ones(6))
    gold = np.array([0.97, 0.8, 0.32], np.float32) / np.float32(F0_OF_PSI)
    psi = np.where(np.arange(6)[:, None] % 2 == 0, np.float32(0.5), gold[None])
    lit = replace(_open_sky(), lobe=DIELECTRIC)
    both = lobe_radiance(lit, points, 0.1 * one, psi, 32, 0, stream)
    for kind, own in ((DIELECTRIC, stream[::2]), (CONDUCTOR, stream[1::2])):
        alone = lobe_radiance(
            replace(lit, lobe=kind), points.take(own), 0.1 * one[own], psi[own], 32, 0, own
        )
        np.testing.assert_array_equal(both[own], alone)
    assert (both[1::2] > 5 * both[::2]).all()
