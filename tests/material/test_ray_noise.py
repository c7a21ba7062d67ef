"""Fits that differ in their rays alone become one."""

from __future__ import annotations

import math
from functools import partial

import pytest

from usdbrdf.material.fit_lobe import first_seed, mean_of_repeats, repeated_where_noisy
from usdbrdf.material.verdict import NOTHING_KNOWN, LobeEstimate

ONE = LobeEstimate(
    phi=0.1, psi=0.5, phi_error=0.02, psi_error=0.06, unresolved=0.01, cost=1.0, evidence=0.8,
    of_rays=(0.01, 0.04),
)  # fmt: skip


def test_a_fit_is_repeated_with_rays_of_its_own_only_where_they_matter():
    seeds = []

    def fit(seed: int, repeats: int, one: LobeEstimate) -> LobeEstimate:
        seeds.append(seed)
        assert repeats == 4
        return one

    for one, expected in (
        (ONE._replace(of_rays=(0.009, 0.029)), 0),
        (ONE._replace(of_rays=(0.011, 0.0)), 4),
        (ONE._replace(of_rays=(0.0, 0.031)), 4),
        (ONE._replace(of_rays=(0.02, 0.05), evidence=0.1), 0),  # there is nothing to tell
    ):
        seeds.clear()
        for seed in range(3):
            repeated_where_noisy(one, partial(fit, one=one), seed)
        assert len({*seeds, *map(first_seed, range(3))}) == len(seeds) + 3 == 3 * expected + 3


def test_a_single_fit_keeps_its_values_and_states_what_its_rays_do():
    found = mean_of_repeats([ONE])
    assert (found.phi, found.psi, found.unresolved, found.cost) == (0.1, 0.5, 0.01, 1.0)
    assert found.phi_error == pytest.approx(math.hypot(0.02, 0.01))
    assert found.psi_error == pytest.approx(math.hypot(0.06, 0.04))


def test_repeats_are_averaged_and_their_rays_errors_fall():
    others = [ONE._replace(psi=0.5 + 0.01 * k) for k in (-1, 0, 1)]
    found = mean_of_repeats([ONE, *others])
    assert found.psi == pytest.approx(0.5)
    assert found.of_rays == pytest.approx((0.005, 0.02))
    assert found.psi_error == pytest.approx(math.hypot(0.06, 0.02))


def test_one_that_is_far_off_does_not_tell_for_all():
    found = mean_of_repeats([ONE, ONE, ONE, ONE._replace(of_rays=(5.0, 5.0))])
    assert found.of_rays == pytest.approx((0.005, 0.02))


def test_a_scatter_beyond_what_the_fits_foretell_counts():
    found = mean_of_repeats([ONE._replace(psi=psi) for psi in (0.3, 0.7, 0.3, 0.7)])
    assert found.of_rays[1] == pytest.approx(math.sqrt(0.16 / 3) / 2)
    assert mean_of_repeats([ONE._replace(psi_error=NOTHING_KNOWN)]).psi_error == NOTHING_KNOWN
