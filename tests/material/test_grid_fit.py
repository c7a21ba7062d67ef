"""The grid over roughness with specular in closed form, on made-up image models."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from usdbrdf.material.fit_target import (
    FrameSamples,
    GridFit,
    _explained,
    _flat_interval,
    fit_grid,
    fit_metal,
    multiple_of,
    nothing,
    relative_costs,
)

PIXELS = 300
Residual = Literal["paper", "scaled"]


def _scene(seed: int = 12345):
    """diffuse (P, 3) and a basis whose shape over the pixels depends on phi."""
    rng = np.random.default_rng(seed)
    diffuse = rng.uniform(0.2, 0.8, (PIXELS, 3)).astype(np.float32)
    place = rng.uniform(-1, 1, PIXELS)

    def basis(phi: float) -> tuple[np.ndarray, np.ndarray]:
        width = 0.1 + phi
        lobe = np.exp(-((place / width) ** 2)) / width
        light = (lobe[:, None] * [1.0, 0.9, 0.8]).astype(np.float32)
        return np.float32(0.1) * light, light

    return diffuse, basis


def _fit(
    observed: np.ndarray,
    diffuse: np.ndarray,
    basis: Callable,
    residual: Residual,
    weight: np.ndarray | None = None,
) -> GridFit:
    if weight is None:
        weight = np.ones((len(diffuse), 1), np.float32)
    if residual == "paper":
        return fit_grid((observed - diffuse).astype(np.float32), weight, basis, nothing)
    without = multiple_of(diffuse * np.sqrt(weight.astype(float)))
    return fit_grid(observed.astype(np.float32), weight, basis, without)


def _render(diffuse, basis, phi: float, psi: float):
    base, slope = basis(phi)
    return diffuse + base + psi * slope


@pytest.mark.parametrize("residual", ["paper", "scaled"])
@pytest.mark.parametrize(("phi", "psi"), [(0.0, 0.4), (0.3, 0.25), (0.64, 0.9), (1.0, 0.5)])
def test_what_lies_on_the_grid_is_found_exactly(residual: Residual, phi: float, psi: float):
    # Level 2 has steps of 0.02 in the interior, of 0.01 at the ends.
    diffuse, basis = _scene()
    found = _fit(_render(diffuse, basis, phi, psi), diffuse, basis, residual)
    assert (found.phi, found.psi) == (pytest.approx(phi, abs=1e-6), pytest.approx(psi, abs=1e-4))
    assert found.cost < 1e-10
    assert found.evidence > 0.999


def test_what_lies_between_is_found_to_half_a_step():
    diffuse, basis = _scene()
    found = _fit(_render(diffuse, basis, 0.431, 0.6), diffuse, basis, "paper")
    assert found.phi == pytest.approx(0.431, abs=0.0101)
    assert found.psi == pytest.approx(0.6, abs=0.05)


def test_a_wrong_level_of_the_diffuse_image_bends_paper_but_not_scaled():
    diffuse, basis = _scene()
    observed = _render(diffuse, basis, 0.3, 0.25)
    scale = np.array([0.9, 0.8, 0.95], np.float32)
    scaled = _fit(observed, diffuse * scale, basis, "scaled")
    assert (scaled.phi, scaled.psi) == (pytest.approx(0.3, abs=1e-6), pytest.approx(0.25, abs=1e-4))
    paper = _fit(observed, diffuse * scale, basis, "paper")
    assert abs(paper.psi - 0.25) > 0.02 or abs(paper.phi - 0.3) > 0.05


@pytest.mark.parametrize(("true", "clamped"), [(1.7, 1.0), (-0.5, 0.0)])
def test_specular_stays_in_its_range(true: float, clamped: float):
    diffuse, basis = _scene()
    found = _fit(_render(diffuse, basis, 0.3, true), diffuse, basis, "paper")
    assert found.psi == clamped
    # The cost is that of the clamped value, not of the unconstrained minimum.
    base, slope = basis(found.phi)
    rest = _render(diffuse, basis, 0.3, true) - diffuse - base - clamped * slope
    assert found.cost == pytest.approx((rest.astype(float) ** 2).mean(), rel=1e-4)
    assert found.cost > 1e-4


def test_weights_choose_which_pixels_count():
    diffuse, basis = _scene()
    observed = _render(diffuse, basis, 0.3, 0.25)
    observed[:100] += 3  # outliers
    weight = np.ones((PIXELS, 1), np.float32)
    weight[:100] = 0
    for residual in ("paper", "scaled"):
        found = _fit(observed, diffuse, basis, residual, weight)
        assert found.phi == pytest.approx(0.3, abs=1e-6)
        assert found.psi == pytest.approx(0.25, abs=1e-4)
    assert _fit(observed, diffuse, basis, "paper").psi != pytest.approx(0.25, abs=0.05)


def test_evidence_is_the_share_of_the_residual_that_the_lobe_explains():
    # Observed = diffuse + lobe + noise with a known power: evidence = 1 - noise / (noise + lobe).
    diffuse, basis = _scene()
    base, slope = basis(0.3)
    lobe = base + 0.5 * slope
    noise = np.random.default_rng(1).standard_normal(lobe.shape)
    noise *= np.sqrt((lobe**2).mean() / (noise**2).mean())
    found = _fit(diffuse + lobe + noise, diffuse, basis, "paper")
    assert found.evidence == pytest.approx(0.5, abs=0.05)
    # Nothing to explain, nothing explained.
    nothing = _fit(diffuse.copy(), diffuse, lambda phi: (0 * base, 0 * slope), "paper")
    assert nothing.evidence == 0
    assert nothing.psi == 0


def test_what_is_projected_out_is_gone_and_stays_gone():
    rng = np.random.default_rng(12345)
    values = rng.standard_normal((PIXELS, 3))
    diffuse = rng.uniform(0.2, 0.8, (PIXELS, 3)) * rng.uniform(0.5, 2, (PIXELS, 1))
    project, removed = multiple_of(diffuse), diffuse * [3, -1, 0.5]
    np.testing.assert_allclose(project(removed), 0, atol=1e-12)
    np.testing.assert_allclose(project(values + removed), project(values), atol=1e-12)
    np.testing.assert_allclose(project(project(values)), project(values), atol=1e-12)
    # Orthogonal: nothing is lost but that.
    assert (project(values) * removed).sum() == pytest.approx(0, abs=1e-9)


@pytest.mark.fault("L6")
def test_a_flat_cost_gives_the_middle_of_what_fits():
    # No lobe at all: every roughness fits alike.
    diffuse, basis = _scene()
    noise = 0.01 * np.random.default_rng(1).standard_normal(diffuse.shape)
    found = _fit(diffuse + noise, diffuse, lambda phi: tuple(0 * b for b in basis(phi)), "paper")
    assert (found.phi_low, found.phi_high) == (0, 1)
    assert found.phi == pytest.approx(0.5, abs=0.06)
    sharp = _fit(_render(diffuse, basis, 0.3, 0.5) + noise, diffuse, basis, "paper")
    assert sharp.phi_low >= 0.26
    assert sharp.phi_high <= 0.34


def test_two_levels_ask_for_at_most_twenty_two_roughnesses():
    diffuse, basis = _scene()
    asked: list[float] = []

    def counting(phi: float):
        asked.append(phi)
        return basis(phi)

    _fit(_render(diffuse, basis, 0.43, 0.6), diffuse, counting, "paper")
    assert len(asked) <= 22
    assert len(set(asked)) == len(asked)
    assert set(np.round(np.linspace(0, 1, 11), 12)) <= {round(phi, 12) for phi in asked}
    assert min(asked) >= 0
    assert max(asked) <= 1


def test_relative_costs_are_least_at_the_lobe_that_made_the_pixels():
    diffuse, basis = _scene()
    phis, psis = [0.1, 0.3, 0.5], [0.0, 0.2, 0.4, 0.6]

    def of_phis(kind, some):
        assert kind == 2
        pairs = [basis(phi) for phi in some]
        return tuple(np.stack(parts, axis=-1) for parts in zip(*pairs, strict=True))

    base, slope = basis(0.3)
    observed = 1.1 * diffuse + base + np.float32(0.4) * slope
    samples = FrameSamples(observed, diffuse, np.ones(PIXELS, np.float32), of_phis)
    costs = relative_costs(SimpleNamespace(lobe=2), samples, phis, psis)
    assert np.unravel_index(costs.argmin(), costs.shape) == (1, 2)
    assert costs[1, 2] == pytest.approx(0, abs=1e-9)
    assert costs.shape == (3, 4)
    assert costs[0, 0] > 0.05


@pytest.mark.parametrize("phi", [0.1, 0.4])
def test_a_metal_comes_back_in_each_channel(phi):
    _, basis = _scene()
    f0 = np.array([0.9, 0.6, 0.3])
    base, slope = basis(phi)
    observed = (base + f0 / 0.08 * slope).astype(np.float32)
    weight = np.ones((PIXELS, 1), np.float32)
    found = fit_metal(observed, weight, basis)
    assert found.phi == pytest.approx(phi, abs=1e-6)
    assert found.f0 == pytest.approx(tuple(f0), abs=1e-4)
    assert found.evidence > 0.9999
    assert found.phi_low <= phi <= found.phi_high
    # Brighter than any mirror: no reflectance is above 1.
    assert max(fit_metal(4 * observed, weight, basis).f0) == 1
    assert fit_metal(0 * observed, weight, basis).f0 == (0, 0, 0)


def test_the_flat_stretch_reaches_as_far_as_costs_stay_within_a_hundredth():
    """To both sides of the least, to the ends of all, and no farther than the first that is more;
    its middle is the tried roughness that lies nearest, of two the lower."""
    phis = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]

    def stretch(*costs: float):
        return _flat_interval(dict(zip(phis, costs, strict=True)))

    assert stretch(1.0, 2, 1.005, 1.0, 1.009, 2, 1) == (0, 0, 0)
    assert stretch(1.2, 2, 1.005, 1.0, 1.009, 2, 0.9) == (0.6, 0.6, 0.6)
    assert stretch(3, 2, 1.005, 1.0, 1.009, 2, 3) == (0.2, 0.3, 0.4)
    assert stretch(3, 2, 1.015, 1.0, 1.009, 1.011, 3) == (0.3, 0.3, 0.4)
    assert stretch(3, 3, 3, 3, 1.009, 1.005, 1.0) == (0.4, 0.5, 0.6)
    assert stretch(1.0, 1.009, 1.005, 3, 3, 3, 3) == (0.0, 0.1, 0.2)
    assert stretch(*[1.0] * 7) == (0.0, 0.3, 0.6)
    # In any order of asking.
    assert _flat_interval({0.5: 1.0, 0.125: 4.0, 0.25: 1.005}) == (0.25, 0.25, 0.5)


def test_pixels_weigh_by_their_radiance_and_a_floor():
    """The inverse of its square, a tenth of the median added."""
    diffuse = np.array([[0.0, 0, 0], [0.5, 1, 1.5], [3, 3, 3]], np.float32)
    samples = FrameSamples(diffuse, diffuse, np.ones(3), lambda *_: None)
    np.testing.assert_allclose(
        samples.weight(), [[1 / 0.1**2], [1 / 1.1**2], [1 / 3.1**2]], rtol=1e-5
    )
    black = FrameSamples(0 * diffuse, 0 * diffuse, np.ones(3), lambda *_: None)
    # Of a thing that reflects nothing each pixel tells as much.
    weight = black.weight()
    assert np.isfinite(weight).all()
    assert (weight == weight[0]).all()
    assert weight[0] > 0


def test_what_is_explained_is_a_share_of_the_squares():
    target = np.array([[1.0, 2, 2]])
    assert _explained(0.0, target) == 1
    assert _explained(3.0, target) == pytest.approx(1 - 3 / 9)
    assert _explained(18.0, target) == 0
    assert _explained(0.0, 0 * target) == 0


def test_a_cost_is_of_each_residual_and_no_metal_explains_black():
    _, basis = _scene()
    base, slope = basis(0.3)
    off = np.random.default_rng(3).normal(0, 0.01, base.shape).astype(np.float32)
    found = fit_metal(base + 10 * slope + off, np.full((PIXELS, 1), 4, np.float32), basis)
    assert found.cost == pytest.approx(4 * 0.01**2, rel=0.1)
    assert found.f0 == pytest.approx((0.8, 0.8, 0.8), abs=0.01)
