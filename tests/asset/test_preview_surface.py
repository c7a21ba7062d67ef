"""The one place where the paper's parameters become UsdPreviewSurface's."""

import pytest

from usdbrdf.asset.preview_lobe import preview_surface_from_fit


@pytest.mark.parametrize(
    ("psi", "ior"), [(0.0, 1.0), (0.25, 1.3294), (0.5, 1.5), (0.75, 1.6488), (1.0, 1.7888)]
)
def test_ior(psi, ior):
    assert preview_surface_from_fit(0.5, psi)[1] == pytest.approx(ior, abs=6e-5)


@pytest.mark.parametrize("psi", [0.0, 0.1, 0.5, 1.0])
def test_ior_gives_back_the_reflectance_at_normal_incidence(psi):
    ior = preview_surface_from_fit(0.5, psi).ior
    assert ((1 - ior) / (1 + ior)) ** 2 == pytest.approx(0.08 * psi)


@pytest.mark.parametrize(
    ("phi", "roughness"), [(0.0, 0.0316228), (0.001, 0.0316228), (0.09, 0.3), (1.0, 1.0)]
)
def test_roughness_squared_is_alpha(phi, roughness):
    assert preview_surface_from_fit(phi, 0.5)[0] == pytest.approx(roughness, rel=1e-5)
