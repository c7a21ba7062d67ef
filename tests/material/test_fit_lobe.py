"""Lobes from made-up views whose frames err as frames do: what comes back, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from usdbrdf.material.fit_lobe import Candidate, Linear, fit_lobe, log_of_ratio
from usdbrdf.material.verdict import NOTHING_KNOWN, SOME_EVIDENCE, LobeEstimate, averaged
from usdbrdf.material.view_model import ViewModel, ViewSamples

TEXELS, FRAMES = 50, 10
SAMPLES = TEXELS * FRAMES
LIGHT = np.array([1.0, 0.9, 0.8])
SEEDS = range(20)
# A roughness and its neighbours.
PHIS = (0.2, 0.25, 0.32)
# Relative standard deviations of what frames share: exposure, cells of space, white balance.
FRAME, CELL, COLOUR, OWN = 0.02, 0.04, 0.01, 0.015
Basis = Callable[[float], tuple[np.ndarray, np.ndarray]]


def _basis(mirrored: np.ndarray, *, footprint: float = 0.03) -> Basis:
    """base and slope for samples whose half vectors are tan(angle) = ``mirrored`` away from the
    normal, a lamp of radiance 20 and solid angle 0.03 being there: its GGX lobe, as wide as
    ``footprint`` at least, before surroundings of radiance 0.5."""

    def basis(phi: float) -> tuple[np.ndarray, np.ndarray]:
        square = phi**2 + footprint**2
        lobe = square / (np.pi * (square + mirrored**2) ** 2)
        light = (0.5 + 20 * 0.03 * np.minimum(lobe, 300) / 4)[:, None] * LIGHT
        return (0.002 * light).astype(np.float32), (0.08 * light).astype(np.float32)

    return basis


def _noisy(basis: Basis, seed: int, share: float, views: int = 1) -> Basis:
    """The same with relative noise, as ray tracing brings it, for every roughness alike; so many
    views of a texel after each other have the same."""
    random = np.random.default_rng([seed, 7]).standard_normal((SAMPLES // views, 1))
    noise = 1 + share * np.repeat(random, views, axis=0)

    def noisy(phi: float) -> tuple[np.ndarray, np.ndarray]:
        base, slope = basis(phi)
        return base * noise.astype(np.float32), slope * noise.astype(np.float32)

    return noisy


def _views(seed: int) -> tuple[ViewSamples, np.ndarray]:
    """Diffuse samples with errors, and how far from the mirror direction each sees the lamp."""
    rng = np.random.default_rng(seed)
    place = rng.random((TEXELS, 2))
    position = np.concatenate([place, np.zeros((TEXELS, 1))], axis=1)
    texel, frame = (a.ravel() for a in np.mgrid[0:TEXELS, 0:FRAMES])
    # Each frame shows the lamp's mirror image somewhere on the surface or beside it.
    seen_at = rng.uniform(-0.2, 1.2, (FRAMES, 2))
    mirrored = 0.6 * np.linalg.norm(place[texel] - seen_at[frame], axis=1)
    diffuse = rng.uniform(0.1, 0.5, (TEXELS, 3))[texel]
    cell = frame * 4 + (position[texel, :2] > 0.5) @ [1, 2]
    error = FRAME * rng.standard_normal((FRAMES, 1))[frame]
    error = error + COLOUR * rng.standard_normal((FRAMES, 3))[frame]
    error = error + CELL * rng.standard_normal((FRAMES * 4, 1))[cell]
    error = error + OWN * rng.standard_normal((SAMPLES, 3))
    samples = ViewSamples(
        texel=texel,
        frame=frame,
        position=position[texel].astype(np.float32),
        radiance=(diffuse * (1 + error)).astype(np.float32),
        noise=np.full((SAMPLES, 3), 1e-3, np.float32),
        cell=0.2,
    )
    return samples, mirrored


def _shone_on(samples: ViewSamples, basis: Basis, phi: float, psi: float) -> ViewSamples:
    base, slope = basis(phi)
    return replace(samples, radiance=samples.radiance + base + np.float32(psi) * slope)


def _fit(samples: ViewSamples, *bases: tuple[Basis, float]) -> LobeEstimate:
    """With candidates (basis, blur) that have the same basis twice, without noise."""
    candidates = []
    for basis, blur in bases:
        at = _side_by_side(basis)
        candidates.append(Candidate(first=at, second=at, third=at, blur=blur))
    return fit_lobe(samples, candidates).lobe


def _side_by_side(basis: Basis) -> Callable[[Sequence[float]], tuple[np.ndarray, np.ndarray]]:
    """The basis for many roughnesses, (P, 3, K) each."""

    def at(phis: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        bases, slopes = zip(*(basis(phi) for phi in phis), strict=True)
        return np.stack(bases, axis=2), np.stack(slopes, axis=2)

    return at


@pytest.mark.parametrize(("phi", "psi"), [(0.06, 0.4), (0.16, 0.7), (0.35, 0.9)])
def test_the_lobe_comes_back_within_its_errors(phi: float, psi: float):
    found = []
    for seed in SEEDS:
        samples, mirrored = _views(seed)
        basis = _basis(mirrored)
        found.append(_fit(_shone_on(samples, basis, phi, psi), (basis, 0.0)))
    phis, psis, phi_errors, psi_errors = np.array(
        [(f.phi, f.psi, f.phi_error, f.psi_error) for f in found]
    ).T
    assert (np.abs(phis - phi) <= phi_errors).mean() >= 0.8
    assert (np.abs(psis - psi) <= psi_errors).mean() >= 0.8
    # The errors say something.
    assert np.median(phi_errors) < 0.1
    assert np.median(psi_errors) < 0.2


def test_light_that_is_badly_known_widens_the_errors():
    """What lobes mirror is off in each frame by a share of its own, which the model of the samples'
    errors, in units of diffuse radiance, does not know."""
    stated, off = [], []
    for seed in SEEDS:
        samples, mirrored = _views(seed)
        basis = _basis(mirrored)
        rng = np.random.default_rng([seed, 11])
        share = np.exp(0.4 * rng.standard_normal(FRAMES)).astype(np.float32)[samples.frame, None]
        errors = []
        for times in (np.ones_like(share), share):
            base, slope = basis(0.16)
            shone = samples.radiance + times * (base + np.float32(0.7) * slope)
            found = _fit(replace(samples, radiance=shone), (basis, 0.0))
            errors.append(found.psi_error)
        stated.append(errors)
        off.append((found.psi - 0.7) / found.psi_error)
    right, wrong = np.median(stated, axis=0)
    assert wrong > 1.5 * right
    assert 0.8 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_what_a_texel_sends_to_all_views_does_not_change_the_errors():
    """It is the diffuse part's, which is free: frames do not pull phi and psi by it."""
    samples, mirrored = _views(1)
    basis, even = _basis(mirrored), np.linspace(0.2, 1.0, TEXELS, dtype=np.float32)

    def with_even(phi: float) -> tuple[np.ndarray, np.ndarray]:
        base, slope = basis(phi)
        return base, slope + even[samples.texel, None]

    model = ViewModel(samples)
    for _ in range(4):
        model.update(np.zeros_like(samples.radiance))
    scatter = []
    for one in (basis, with_even):
        base, slope = one(0.25)
        seen = samples.radiance + base + np.float32(0.5) * slope
        at = _side_by_side(one)(PHIS)
        linear = Linear.about(model, seen, (at, at), PHIS, 0.5)
        scatter.append(linear.scatter(model.groups))
    np.testing.assert_allclose(scatter[1], scatter[0], rtol=1e-3)
    assert max(scatter[0]) > 1


def test_errors_that_frames_share_are_no_lobe():
    evidence, phi_error = [], []
    for seed in SEEDS:
        samples, mirrored = _views(seed)
        found = _fit(samples, (_basis(mirrored), 0.0))
        evidence.append(found.evidence)
        phi_error.append(found.phi_error)
    assert np.median(evidence) < 0.02
    assert max(evidence) < SOME_EVIDENCE
    assert np.median(phi_error) > 0.9 * NOTHING_KNOWN


@pytest.mark.parametrize(("phi", "noise"), [(0.1, 0.1), (0.25, 0.2)])
def test_noise_of_the_rays_does_not_draw_psi_anywhere(phi: float, noise: float):
    psi = 0.6
    halves, twice = [], []
    for seed in SEEDS[:8]:
        samples, mirrored = _views(seed)
        basis = _basis(mirrored)
        samples = _shone_on(samples, basis, phi, psi)
        first, second, third = (_side_by_side(_noisy(basis, 3 * seed + k, noise)) for k in range(3))
        own = Candidate(first=first, second=second, third=third, blur=0)
        halves.append(fit_lobe(samples, [own]).lobe.psi)
        twice.append(fit_lobe(samples, [own._replace(second=first)]).lobe.psi)
    assert np.mean(halves) == pytest.approx(psi, abs=0.04)
    # Noise squared adds to the square of the slope, which psi is divided by.
    assert np.mean(twice) < 0.93 * psi


def test_whichever_kind_of_lobe_comes_first_the_true_one_explains_more():
    """Errors that were found with a kind of lobe take its side."""
    sums = np.zeros((2, 2))
    for seed in SEEDS[:8]:
        samples, mirrored = _views(seed)
        # The second has a wider skirt.
        kinds = [_basis(mirrored), _basis(np.sqrt(mirrored**2 + 0.05**2) - 0.05)]
        for true, basis in enumerate(kinds):
            shone = _shone_on(samples, basis, 0.15, 0.7)
            for order in (0, 1):
                fitted = None
                for kind in (kinds[order], kinds[1 - order]):
                    at = _side_by_side(kind)
                    fitted = fit_lobe(shone, [Candidate(at, at, at, 0.0)], before=fitted)
                # Over 0 where the first of the list explains more.
                sums[true, order] += fitted.log_ratio if order == 0 else -fitted.log_ratio
    assert (sums[0] > 0.1).all()
    assert (sums[1] < -0.1).all()
    np.testing.assert_allclose(sums[:, 0], sums[:, 1], rtol=0.5)


def test_a_cost_that_noise_makes_negative_tells_no_lobe_from_another():
    def terms(least: float) -> np.ndarray:  # of a psi of .5, where the cost is so much
        return np.array([[least + 1.0, 2.0, 4.0]])

    assert log_of_ratio([terms(1.0), terms(3.0)], [terms(2.0)]) == pytest.approx(-math.log(2))
    assert log_of_ratio([terms(1.0)], [terms(-0.1)]) == 0
    assert log_of_ratio([terms(-0.1)], [terms(1.0), terms(2.0)]) == 0


def _scatter_and_foretold(
    phi: float, psi: float, noise: float, views: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Of phi and psi over sixteen sets of rays: their scatter, and ``of_rays``."""
    samples, mirrored = _views(0)
    basis = _basis(mirrored)
    samples = _shone_on(samples, basis, phi, psi)
    found = []
    for seed in range(16):
        first, second, third = (
            _side_by_side(_noisy(basis, 3 * seed + k, noise, views)) for k in range(3)
        )
        own = Candidate(first=first, second=second, third=third, blur=0)
        found.append(fit_lobe(samples, [own]).lobe)
    scatter = np.std([(one.phi, one.psi) for one in found], axis=0, ddof=1)
    return scatter, np.sqrt(np.mean([np.square(one.of_rays) for one in found], axis=0))


@pytest.mark.parametrize(
    ("phi", "psi", "noise", "views"),
    [(0.1, 0.6, 0.05, 1), (0.1, 0.6, 0.2, 1), (0.25, 0.6, 0.05, 1), (0.1, 0.1, 0.05, 1),
     (0.1, 0.6, 0.1, FRAMES)],
)  # fmt: skip
def test_what_the_rays_do_is_foretold(phi: float, psi: float, noise: float, views: int):
    scatter, foretold = _scatter_and_foretold(phi, psi, noise, views)
    # Sixteen values tell their scatter to 18 %.
    assert np.all(scatter < 1.8 * foretold)
    assert np.all(foretold < 1.8 * scatter)


@pytest.mark.parametrize(("phi", "psi"), [(0.25, 0.6), (0.1, 0.1)])
def test_rays_too_few_for_a_lobe_are_not_taken_for_enough(phi: float, psi: float):
    scatter, foretold = _scatter_and_foretold(phi, psi, 0.2)
    assert np.all(foretold > scatter)


def test_without_noise_the_rays_do_nothing():
    samples, mirrored = _views(0)
    basis = _basis(mirrored)
    found = _fit(_shone_on(samples, basis, 0.1, 0.6), (basis, 0.0))
    assert found.of_rays == pytest.approx((0, 0), abs=1e-12)


def _left_open(phi: float, blur: float) -> float:
    return math.hypot(phi, 1.5 * blur) - phi


def test_the_footprint_that_fits_is_the_one_that_is_used():
    # The lobe was seen through the wider footprint: through the narrow one it looks rougher.
    phi, psi, blur = 0.05, 0.5, 0.06
    right = []
    for seed in SEEDS[:6]:
        plain, mirrored = _views(seed)
        narrow, wide = _basis(mirrored, footprint=0.03), _basis(mirrored, footprint=0.1)
        samples = _shone_on(plain, wide, phi, psi)
        alone = _fit(samples, (narrow, 0.01))
        both = _fit(samples, (narrow, 0.01), (wide, blur))
        assert abs(both.phi - phi) < abs(alone.phi - phi)
        # What the blur leaves open is between that of either.
        assert alone.unresolved < both.unresolved <= _left_open(both.phi, blur) + 1e-3
        right.append(both.phi)
        # A candidate that fits worse changes next to nothing.
        samples = _shone_on(plain, narrow, phi, psi)
        alone, both = _fit(samples, (narrow, 0.01)), _fit(samples, (narrow, 0.01), (wide, blur))
        assert both.phi == pytest.approx(alone.phi, abs=0.1 * alone.phi_error + 1e-3)
        assert both.psi == pytest.approx(alone.psi, abs=0.1 * alone.psi_error + 1e-3)
    assert np.mean(right) == pytest.approx(phi, abs=0.03)


def test_footprints_that_fit_alike_are_averaged():
    one = LobeEstimate(
        phi=0.2, psi=0.5, phi_error=0.03, psi_error=0.1, unresolved=0.01, cost=1.0, evidence=0.7
    )
    other = one._replace(phi=0.3, psi=0.7, unresolved=0.05)
    both = averaged([one, other], 1000, [1, 1])
    assert (both.phi, both.psi, both.unresolved) == pytest.approx((0.25, 0.6, 0.03))
    assert both.phi_error == pytest.approx(math.hypot(0.03, 0.05))
    assert both.psi_error == pytest.approx(math.hypot(0.1, 0.1))
    worse = other._replace(cost=1.5)
    assert averaged([one, worse], 1000, [1, 1]).phi == pytest.approx(0.2, abs=1e-6)
    assert averaged([one, other], 1000, [1, 3]).phi == pytest.approx((one.phi + 3 * other.phi) / 4)
    assert averaged([one], 1000, [1]) == one
