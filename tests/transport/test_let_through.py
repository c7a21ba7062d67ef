"""What comes through a dielectric's surface from below, against Fresnel's equations."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.transport.brdf import F0_OF_PSI, dielectric_fresnel
from usdbrdf.transport.let_through import (
    kept_below,
    share_let_through,
    share_seen,
    table_let_through,
)

# Cosines that weigh alike under uniform light.
EVEN = np.sqrt((np.arange(4000) + 0.5) / 4000)


def _let_through(phi: float, psi: float, cosine: np.ndarray) -> np.ndarray:
    one = np.ones(len(cosine), np.float32)
    return share_let_through(phi * one, psi * one, cosine)


@pytest.mark.parametrize("phi", [0.0, 0.15, 0.5, 1.0])
@pytest.mark.parametrize("psi", [0.1, 0.5, 1.0])
def test_its_mean_over_the_hemisphere_is_one(phi: float, psi: float):
    assert _let_through(phi, psi, EVEN).mean() == pytest.approx(1, abs=0.004)


def test_of_a_smooth_surface_it_is_what_fresnel_leaves():
    psi = 0.5
    root = np.sqrt(F0_OF_PSI * psi)
    ior = (1 + root) / (1 - root)
    mean = 1 - dielectric_fresnel(ior, EVEN).mean()
    cosine = np.cos(np.radians([0, 20, 40, 60, 70, 80]))
    true = (1 - dielectric_fresnel(ior, cosine)) / mean
    np.testing.assert_allclose(_let_through(0.0, psi, cosine), true, rtol=0.015)


def test_facets_at_all_angles_level_it_out():
    cosine = np.cos(np.radians([0, 80]))
    contrast = [np.ptp(_let_through(phi, 0.5, cosine)) for phi in (0.0, 0.1, 0.3, 0.8)]
    assert contrast == sorted(contrast, reverse=True)
    assert contrast[-1] < 0.1 < 0.3 < contrast[0]


def test_what_does_not_reflect_lets_all_through():
    np.testing.assert_allclose(_let_through(0.2, 0.0, EVEN), 1, atol=1e-6)


def test_of_a_lobe_with_colours_the_mean_counts():
    phi, cosine = np.full(1, 0.1, np.float32), np.full(1, 0.3)
    coloured = share_let_through(phi, np.array([[0.2, 0.5, 0.8]], np.float32), cosine)
    np.testing.assert_allclose(coloured, share_let_through(phi, np.array([0.5]), cosine))


@pytest.mark.parametrize("phi", [0.0, 0.15, 0.6])
def test_what_the_fit_takes_off_is_the_same_to_first_order(phi: float):
    cosine = np.cos(np.radians([0, 20, 40, 60, 70, 75])).astype(np.float32)
    base, slope = (part[:, 1] for part in kept_below([0.9, phi], cosine))
    for psi in (0.4, 0.8):
        found = 1 - (base + psi * slope)
        np.testing.assert_allclose(found, _let_through(phi, psi, cosine), atol=0.025)


@pytest.mark.parametrize("phi", [0.0, 0.15, 0.6])
@pytest.mark.parametrize("psi", [0.0, 0.05, 0.5, 1.0])
def test_from_the_front_more_is_seen_than_on_the_mean(phi: float, psi: float):
    front = np.linspace(np.sqrt(0.5), 1, 1001)
    seen = share_seen(np.array([phi]), np.array([psi]))
    assert seen == pytest.approx(_let_through(phi, psi, front).mean(), abs=3e-3)
    assert seen == pytest.approx(1, abs=1e-6) if psi == 0 else seen > 1


def test_a_table_holds_the_same_at_even_cosines():
    phi, psi = np.array([0.0, 0.3], np.float32), np.array([0.5, 0.9], np.float32)
    table = table_let_through(phi, psi)
    cosines = np.linspace(0, 1, table.shape[1])[1:]
    for row, one, other in zip(table, phi, psi, strict=True):
        np.testing.assert_allclose(row[1:], _let_through(one, other, cosines), atol=1e-6)
