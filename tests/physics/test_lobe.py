"""The lobe of equations 3 to 6: normalised, reciprocal, affine in psi, never more than it gets."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo, f_nd
from usdbrdf.transport.brdf import (
    alpha_of_phi,
    clamped,
    distribution,
    fresnel,
    grazing,
    lobe,
    masking,
    masking_width,
)

# Directional albedo at psi = 1 for light leaving at 10, 45 and 75 degrees, by an independent
# quadrature of the paper's equations (three digits).
ALBEDO = {
    0.05: (0.0796, 0.0789, 0.177),
    0.1: (0.0785, 0.0776, 0.149),
    0.3: (0.0685, 0.0670, 0.0966),
    0.6: (0.0467, 0.0488, 0.0691),
    1.0: (0.0248, 0.0295, 0.0457),
}
ANGLES = np.radians([10, 45, 75])


def _directions(number: int) -> np.ndarray:
    """Unit vectors, some below the horizon of +z."""
    w = np.random.default_rng(12345).standard_normal((number, 3))
    w[:, 2] = np.abs(w[:, 2]) - 0.1
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def _lobe_albedo(theta: float, phi: float, steps: int = 96) -> tuple[float, float]:
    """(base, slope) of the directional albedo by quadrature of the package's own ``lobe``.

    Half vectors at tan(t) = alpha s, log s even; dw = 4 (wo.h) sin^2 t cos t dlog(s) dazimuth.
    """
    n, wo = np.array([0.0, 0, 1]), np.array([np.sin(theta), 0, np.cos(theta)])
    alpha = max(0.001, phi)
    log_s = np.linspace(np.log(1e-3), np.log(1e3 / alpha), 4 * steps)
    azimuth = (np.arange(steps) + 0.5) * 2 * np.pi / steps
    total = np.zeros(2)
    for t in np.arctan(alpha * np.exp(log_s)):
        h = np.stack(
            [np.sin(t) * np.cos(azimuth), np.sin(t) * np.sin(azimuth), np.cos(t) + 0 * azimuth],
            axis=-1,
        )
        woh = h @ wo
        for hk, c in zip(h[woh > 0], woh[woh > 0], strict=True):
            w = 2 * c * hk - wo
            if w[2] > 0:
                weight = w[2] * 4 * c * np.sin(t) ** 2 * np.cos(t)
                total += weight * np.array(lobe(n, w, wo, phi))
    base, slope = total * (log_s[1] - log_s[0]) * 2 * np.pi / steps
    return base, slope


@pytest.mark.parametrize("alpha", [0.001, 0.01, 0.1, 0.3, 0.7, 1.0])
def test_the_normal_distribution_is_normalised(alpha: float):
    # Integral of D cos dw = 1. With x = sin^2: dw cos = pi dx, so it is pi times that of D over
    # x in [0, 1]; x = alpha^2 e^s spreads the peak.
    s = np.linspace(np.log(1e-8), np.log(1 / alpha**2), 20_001)
    x = alpha**2 * np.exp(s)
    d = np.array([distribution(value, alpha) for value in x])
    integral = np.pi * np.trapezoid(d * x, s)
    assert integral == pytest.approx(1, abs=1e-5)


def test_alpha_is_phi_with_a_floor():
    assert alpha_of_phi(0.0) == 0.001
    assert alpha_of_phi(0.001) == 0.001
    assert alpha_of_phi(0.37) == 0.37


def test_masking_at_its_ends():
    # G1(1, y) = 1 / (1 + sqrt(1 + y^2 - y^2)) = 1/2: at normal incidence nothing is masked, and
    # G1^2 = 1 / (4 n.w n.wo). At y = 1 (phi = 1) G1(x) = 1 / (x + 1). phi = 0: y = 1/4.
    for phi in (0.0, 0.3, 1.0):
        assert masking(1.0, masking_width(phi)) == pytest.approx(0.5)
    for x in (0.01, 0.4, 0.9):
        assert masking(x, masking_width(1.0)) == pytest.approx(1 / (1 + x))
        assert masking(x, masking_width(0.0)) == pytest.approx(
            1 / (x + np.sqrt(x * x + (1 - x * x) / 16))
        )


def test_schlick_at_its_ends():
    assert grazing(1.0) == 0
    assert grazing(0.0) == 1
    assert grazing(0.5) == pytest.approx(1 / 32)
    # Rounding may give a cosine just above 1.
    assert grazing(clamped(1 + 1e-9)) == 0
    assert fresnel(0.04, 1.0) == pytest.approx(0.04)
    assert fresnel(0.04, 0.0) == 1


@pytest.mark.parametrize("phi", [0.0, 0.02, 0.3, 1.0])
def test_the_lobe_equals_the_printed_equations(phi: float):
    n = np.array([0.0, 0, 1])
    w, wo = _directions(400), _directions(800)[400:]
    # A few pairs near the mirror direction, where small phi has its values.
    w[:100] = 2 * wo[:100, 2:3] * n - wo[:100] + 1e-3 * w[:100]
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    pairs = np.array([lobe(n, a, b, phi) for a, b in zip(w, wo, strict=True)])
    for psi in (0.0, 0.25, 1.0):
        ours = pairs[:, 0] + psi * pairs[:, 1]
        # 1 + (alpha^2 - 1) cos^2, as printed, loses 1e-16 / alpha^2 of its digits.
        np.testing.assert_allclose(ours, f_nd(n, w, wo, phi, psi), rtol=1e-8, atol=1e-300)


def test_the_lobe_does_not_care_how_the_frame_is_turned():
    rng = np.random.default_rng(12345)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    n = np.array([0.0, 0, 1])
    for w, wo in zip(_directions(50), _directions(100)[50:], strict=True):
        np.testing.assert_allclose(
            lobe(turn @ n, turn @ w, turn @ wo, 0.2), lobe(n, w, wo, 0.2), rtol=1e-9
        )


def test_the_lobe_is_reciprocal():
    n = np.array([0.0, 0, 1])
    for w, wo in zip(_directions(200), _directions(400)[200:], strict=True):
        for phi in (0.0, 0.1, 0.8):
            np.testing.assert_allclose(lobe(n, w, wo, phi), lobe(n, wo, w, phi), rtol=1e-10)


def test_nothing_is_reflected_through_the_surface():
    n = np.array([0.0, 0, 1])
    up, down = np.array([0.6, 0, 0.8]), np.array([0.6, 0, -0.8])
    assert lobe(n, down, up, 0.5) == (0, 0)
    assert lobe(n, up, down, 0.5) == (0, 0)
    assert lobe(n, down, down, 0.5) == (0, 0)


@pytest.mark.parametrize("phi", sorted(ALBEDO))
def test_directional_albedo_against_the_table(phi: float):
    for theta, table in zip(ANGLES, ALBEDO[phi], strict=True):
        base, slope = _lobe_albedo(theta, phi)
        assert base + slope == pytest.approx(table, rel=0.01)
        # Affine in psi: the printed equations at other psi, integrated by themselves.
        for psi in (0.25, 0.5, 1.0):
            expected = directional_albedo(theta, phi, psi, steps=200)
            assert base + psi * slope == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("phi", [0.02, 0.1, 0.5, 1.0])
def test_without_specular_the_grazing_part_is_left(phi: float):
    # F0 = 0 leaves F = (1 - w.h)^5: nearly nothing at normal view, 0.7 to 13 % at 75 degrees.
    base = [_lobe_albedo(theta, phi, steps=48)[0] for theta in ANGLES]
    expected = [directional_albedo(theta, phi, 0.0, steps=200) for theta in ANGLES]
    np.testing.assert_allclose(base, expected, rtol=0.01)
    assert base[0] < base[2]
    assert base[2] > 0.005


@pytest.mark.parametrize("phi", [0.0, 0.02, 0.1, 0.3, 0.6, 1.0])
def test_no_more_light_leaves_than_arrives(phi: float):
    # Affine in psi, of which 0 and 1 are the ends.
    for degrees in (0, 30, 60, 75, 85, 89):
        base, slope = _lobe_albedo(np.radians(degrees), phi, steps=48)
        assert 0 <= base <= base + slope <= 1
