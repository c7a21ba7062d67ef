"""The search for one candidate's lobe, with samples that are known in full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.material import fit_lobe
from usdbrdf.material.fit_lobe import Candidate, Linear, _Fit

SAMPLES, VARIANCE, FREEDOM = 40, 0.01, 60
# Between two roughnesses that are always tried, in the middle of those that are tried then.
PHI, PSI, NEIGHBOURS = 0.285, 0.6, (0.2675, 0.285, 0.3025)
Shown = Callable[[Sequence[float]], tuple[Any, Any]]


class Even:
    """A model whose samples have one variance, and nothing of them is a texel's own."""

    degrees_of_freedom = FREEDOM
    groups = (np.arange(SAMPLES) % 5,)

    def reduced(self, values: Any) -> Any:
        def parts(count: int) -> list[Any]:
            return [self.reduced(part) for part in np.split(values, count, axis=-1)]

        return SimpleNamespace(values=values, parts=parts)

    def product(self, a: Any, b: Any) -> Any:
        return (a.values.astype(float) * b.values).sum(axis=(0, 1)) / VARIANCE

    def solved(self, values: Any) -> Any:
        return values / VARIANCE

    def sums_of_texels(self, each: Any) -> Any:
        return each.reshape(-1, 4, 2).sum(axis=1)


def shown(noise: float, seed: int) -> Shown:
    """A lobe that samples see from 0 to 0.6 rad beside its middle, before even surroundings, each
    with relative noise of its own."""
    off = np.linspace(0, 0.6, SAMPLES)[:, None, None] * np.array([1.0, 0.9, 1.1])[:, None]
    noisy = 1 + noise * np.random.default_rng(seed).standard_normal((SAMPLES, 3, 1))

    def at(phis: Sequence[float]) -> tuple[Any, Any]:
        square = np.square(phis) + 0.03**2
        lobe = square / (square + off**2) ** 2 / 20 + 0.1
        return (0.03 * lobe * noisy).astype(np.float32), (lobe * noisy).astype(np.float32)

    return at


def searched(
    noise: float, repeats: int = 1, phi: float = PHI
) -> tuple[Any, Any, tuple[Shown, Shown]]:
    exact, one, other = shown(0, 0), shown(noise, 1), shown(noise, 2)
    base, slope = exact([phi])
    radiance = (base + PSI * slope)[..., 0]
    fit = _Fit(Candidate(one, other, exact, 0.0), Even(), radiance)  # type: ignore[arg-type]
    without = float((radiance.astype(float) ** 2).sum() / VARIANCE)
    return fit.estimate(fit.coarse(), without, repeats), radiance, (one, other)


def test_a_cost_is_the_product_of_what_either_basis_leaves():
    _, radiance, (one, other) = searched(0.3)
    phis = (0.1, 0.4, 0.9)
    fit = _Fit(Candidate(one, other, one, 0.0), Even(), radiance)  # type: ignore[arg-type]
    terms = fit._terms(one(phis), other(phis))
    for psi in (0.0, 0.3, 1.0):
        left = [
            radiance[..., None] - base - psi * slope for base, slope in (one(phis), other(phis))
        ]
        wanted = (left[0].astype(float) * left[1]).sum(axis=(0, 1)) / VARIANCE
        np.testing.assert_allclose(terms @ [1, -2 * psi, psi**2], wanted, rtol=1e-4)


@pytest.mark.parametrize("phi", [0.0125, 0.04625, 0.1, PHI, 0.675, 0.925])
def test_what_is_there_is_found_between_the_roughnesses_that_are_always_tried(phi: float):
    found, _, _ = searched(0.0, phi=phi)
    assert found.phi == pytest.approx(phi, rel=0.015)
    assert found.psi == pytest.approx(PSI, abs=3e-3)
    assert found.cost == pytest.approx(0, abs=1e-6)
    assert found.of_rays == pytest.approx((0, 0), abs=1e-6)


def test_variances_follow_from_the_best_lobe_of_the_third_basis():
    """Of the roughnesses that are always tried; its light is what ``ViewModel.update`` asks for."""

    class Heard(Even):
        def update(self, non_diffuse: Any) -> None:
            self.heard = non_diffuse

    exact, third, model = shown(0.0, 0), shown(0.5, 3), Heard()
    base, slope = exact([0.25])
    fit = _Fit(Candidate(exact, exact, third, 0.0), model, (base + PSI * slope)[..., 0])  # type: ignore[arg-type]
    fit.improve()
    base, slope = third([0.25])
    np.testing.assert_allclose(model.heard, (base + PSI * slope)[..., 0], rtol=1e-4)


@pytest.mark.parametrize(("phi", "count"), [(0.0, 3), (0.25, 6), (1.0, 3)])
def test_the_search_goes_on_on_either_side_of_the_best_alone(phi: float, count: int):
    asked: list[Sequence[float]] = []

    def at(phis: Sequence[float]) -> tuple[Any, Any]:
        asked.append(phis)
        return shown(0.0, 0)(phis)

    base, slope = at([phi])
    fit = _Fit(Candidate(at, at, at, 0.0), Even(), (base + PSI * slope)[..., 0])  # type: ignore[arg-type]
    fit.estimate(fit.coarse(), 1.0, 1)
    _, tried, _, closer, _ = asked
    assert len(closer) == count
    assert not set(closer) & set(tried)
    nearest = [min(tried, key=lambda one, phi=other: abs(one - phi)) for other in closer]
    beside = sorted(tried, key=lambda one: abs(one - phi))[: 1 + count // 3]
    assert set(nearest) <= set(beside)


@pytest.mark.parametrize(("phi", "near"), [(0.0, (0.0, 0.0, 0.0025)), (1.0, (0.975, 1.0, 1.0))])
def test_at_either_end_there_is_one_neighbour(monkeypatch, phi: float, near: tuple[float, ...]):
    asked = []
    about = Linear.about

    def told(*given: Any) -> Linear:
        asked.append(given[3])
        return about(*given)

    monkeypatch.setattr(fit_lobe.Linear, "about", told)
    searched(0.0, phi=phi)
    assert asked == [pytest.approx(near)]


def test_the_rays_errors_are_those_about_the_best_lobe_and_its_neighbours():
    found, radiance, (one, other) = searched(0.02)
    bases = one(NEIGHBOURS), other(NEIGHBOURS)
    psi = _best_psi(radiance, one, other)
    about = Linear.about(Even(), radiance, bases, NEIGHBOURS, psi)  # type: ignore[arg-type]
    assert found.of_rays == pytest.approx(about.error_of_rays(Even().sums_of_texels), rel=1e-4)
    assert min(found.of_rays) > 1e-4


def _best_psi(radiance: Any, one: Shown, other: Shown) -> float:
    (base, slope), (other_base, other_slope) = one([PHI]), other([PHI])
    rest, other_rest = radiance[..., None] - base, radiance[..., None] - other_base
    crossed = (slope * other_rest + other_slope * rest).sum() / 2
    return float(crossed / (slope * other_slope).sum())


@pytest.mark.parametrize("repeats", [1, 4])
def test_of_several_fits_the_mean_has_that_share_of_the_rays_noise(monkeypatch, repeats: int):
    """Either basis' squares are dearer than their product by half the square of what they differ
    by: of the mean of several by that much less. Errors are those of the mean, too."""
    told: dict[str, Any] = {}
    from_costs = fit_lobe.lobe_from_costs

    def heard(phis, terms, without, noisy, freedom, blur, scatter, of_rays):
        told.update(noisy=noisy, of_rays=of_rays, freedom=freedom)
        least = min(c0 - c1**2 / c2 for c0, c1, c2 in terms)
        told["least"] = least
        return from_costs(phis, terms, without, noisy, freedom, blur, scatter, of_rays)

    monkeypatch.setattr(fit_lobe, "lobe_from_costs", heard)
    found, radiance, (one, other) = searched(0.02, repeats)
    psi = _best_psi(radiance, one, other)
    lobes = [base + psi * slope for base, slope in (one([PHI]), other([PHI]))]
    apart = float(((lobes[0] - lobes[1]).astype(float) ** 2).sum()) / VARIANCE
    assert told["noisy"] - told["least"] == pytest.approx(apart / 2 / repeats, rel=1e-3)
    assert told["of_rays"] == pytest.approx(np.array(found.of_rays) / np.sqrt(repeats))
    assert told["freedom"] == FREEDOM
