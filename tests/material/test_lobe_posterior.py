"""From costs to a lobe with errors, where the answer can be written down."""

from __future__ import annotations

import math

import numpy as np
import pytest

from usdbrdf.material.verdict import NOTHING_KNOWN, lobe_from_costs

PHIS = np.linspace(0, 1, 101)
FREEDOM = 1000


def _normal(
    phi: float, psi: float, phi_error: float, psi_error: float, least: float
) -> tuple[np.ndarray, float]:
    """terms of cost = least + ((phi - .) / phi_error)^2 + ((psi - .) / psi_error)^2, and the cost
    at psi = 0 with the best phi."""
    c2 = np.full(len(PHIS), psi_error**-2)
    c0 = least + ((PHIS - phi) / phi_error) ** 2 + psi**2 * c2
    return np.stack([c0, psi * c2, c2], axis=-1), least + (psi / psi_error) ** 2


@pytest.mark.parametrize("scatter", [(1.0, 1.0), (4.0, 2.25)])
def test_a_normal_posterior_has_its_own_deviations(scatter: tuple[float, float]):
    least = 50.0
    terms, without = _normal(0.415, 0.6, 0.04, 0.05, least)
    found = lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.0, scatter)
    assert (found.phi, found.psi) == pytest.approx((0.415, 0.6))
    assert found.phi_error == pytest.approx(0.04 * math.sqrt(scatter[0]), rel=0.02)
    assert found.psi_error == pytest.approx(0.05 * math.sqrt(scatter[1]), rel=0.02)
    assert found.cost == pytest.approx(least / FREEDOM, rel=1e-3)
    assert found.evidence == pytest.approx(1 - least / without, abs=1e-3)
    assert found.unresolved == 0


def test_uneven_roughnesses_count_by_the_space_between_them():
    # The same cost at few and at many roughnesses: the same deviations.
    phis = np.concatenate([np.linspace(0, 0.4, 21), np.linspace(0.4, 0.5, 41)[1:],
                           np.linspace(0.5, 1, 26)[1:]])  # fmt: skip
    terms, without = _normal(0.45, 0.6, 0.1, 0.05, 50)
    between = np.stack([np.interp(phis, PHIS, term) for term in terms.T], axis=-1)
    found = lobe_from_costs(phis, between, without, 0.0, FREEDOM, 0.0)
    assert found.phi_error == pytest.approx(0.1, rel=0.03)


def test_specular_beyond_its_range_is_clamped():
    for true, wanted in ((-0.3, 0.0), (1.4, 1.0)):
        terms, without = _normal(0.3, true, 0.05, 0.2, 50)
        found = lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.0)
        assert found.psi == pytest.approx(wanted)
        # Nearer to the truth is cheaper: what is left of the normal is narrower than the whole.
        assert 0 < found.psi_error < 0.2


def test_costs_that_do_not_differ_say_that_nothing_is_known():
    terms = np.tile([500.0, 0.0, 0.0], (len(PHIS), 1))
    found = lobe_from_costs(PHIS, terms, 500.0, 0.0, FREEDOM, 0.0)
    assert found.evidence == 0
    # From an end of the range everything is even farther away than from its middle.
    assert found.phi_error == pytest.approx(NOTHING_KNOWN)
    assert found.psi_error == pytest.approx(NOTHING_KNOWN)


@pytest.mark.fault("L6")
@pytest.mark.parametrize("without", [0.0, 20.0])
def test_a_lobe_that_explains_nothing_has_no_evidence(without: float):
    terms, _ = _normal(0.3, 0.5, 0.1, 0.1, 50)
    assert lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.0).evidence == 0


@pytest.mark.parametrize("unit", [1e-3, 1e-2, 1.0])
def test_evidence_is_a_share_whatever_the_costs_are(unit: float):
    # A parabola in psi from the cost without a lobe down to a tenth of it, at any roughness.
    without, psi = 20.0 * unit, 0.6
    c2 = 0.9 * without / psi**2
    terms = np.tile([without, psi * c2, c2], (len(PHIS), 1))
    found = lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.0)
    assert found.evidence == pytest.approx(0.9)
    assert found.cost == pytest.approx(0.1 * without / FREEDOM)


def test_a_lobe_narrower_than_its_footprint_is_unresolved():
    widths = []
    for phi in (0.5, 0.1, 0.02):
        terms, without = _normal(phi, 0.5, 0.02, 0.05, 50)
        widths.append(lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.03).unresolved)
    assert widths == pytest.approx([math.hypot(phi, 1.5 * 0.03) - phi for phi in (0.5, 0.1, 0.02)])


def test_noise_of_the_rays_widens_the_errors():
    terms, without = _normal(0.415, 0.6, 0.04, 0.05, 50)
    quiet, noisy = (lobe_from_costs(PHIS, terms, without, n, FREEDOM, 0.0) for n in (50.0, 200.0))
    assert noisy.phi_error == pytest.approx(2 * quiet.phi_error, rel=0.02)
    assert noisy.psi_error == pytest.approx(2 * quiet.psi_error, rel=0.02)


def test_a_lobe_that_the_rays_noise_may_have_made_is_none():
    terms, without = _normal(0.415, 0.4, 0.04, 0.05, 50)
    clear, hazy = (
        lobe_from_costs(PHIS, terms, without, 0.0, FREEDOM, 0.0, of_rays=(0.0, of_rays))
        for of_rays in (0.0, 1.0)
    )
    assert clear.psi_median == pytest.approx(0.4, abs=0.01)
    assert hazy.psi_median == 0
    assert hazy.psi_upper > clear.psi_upper + 0.3
    # What the rays do to psi itself is added to its error by the mean of the repeats.
    assert (hazy.psi, hazy.psi_error) == (clear.psi, clear.psi_error)
