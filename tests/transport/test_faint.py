"""Towards F0 = 0 a dielectric reflects nothing, at any angle."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.transport.brdf import (
    CONDUCTOR,
    DIELECTRIC,
    PAPER,
    dielectric_fresnel,
    reflectance,
    share_of_base,
)

COSINE = (np.arange(200) + 0.5) / 200


def _fresnel(f0: float) -> np.ndarray:
    base, rise = reflectance(COSINE, DIELECTRIC)
    return share_of_base(f0, DIELECTRIC) * base + f0 * rise


@pytest.mark.parametrize("f0", [0.0008, 0.002, 0.005, 0.01, 0.016, 0.02, 0.04, 0.06])
def test_a_faint_dielectric_follows_fresnels_equations(f0: float):
    truth = dielectric_fresnel((1 + f0**0.5) / (1 - f0**0.5), COSINE)
    error = np.sqrt(np.average((_fresnel(f0) - truth) ** 2, weights=COSINE))
    assert error < 0.03


def test_one_of_no_reflectance_reflects_nothing():
    assert not _fresnel(0.0).any()


@pytest.mark.parametrize("kind", [PAPER, CONDUCTOR])
def test_the_papers_lobe_and_metals_keep_schlicks_term(kind: int):
    assert share_of_base(np.zeros(3), kind) == 1.0
