"""The search for the sun's direction: what it tries, and what a direction costs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.shading import sun_direction
from usdbrdf.shading.sun_direction import (
    _around,
    _beside,
    _blurred_sunlight,
    _cost_of_each,
    _costs,
    _costs_of_texels,
    _is_better,
    _spread,
)

OUTLIER = sun_direction._OUTLIER
DIRECTIONS = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [-2 / 7, 3 / 7, 6 / 7]])


def test_directions_are_even_over_the_sphere():
    found = _spread(2000)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(found.T @ found / 2000, np.eye(3) / 3, atol=2e-3)
    # As far from each other as even ones can be, about.
    closest = np.sort(found @ found.T, axis=1)[:, -2]
    assert np.arccos(closest).min() > 0.7 * np.sqrt(4 * np.pi / 2000)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_what_is_tried_around_a_direction_is_a_square_of_even_steps(direction):
    reach = 0.1
    found = _around(direction, reach)
    assert found.shape == (81, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    # On the plane that touches the sphere there: nine by nine, a quarter of the reach apart.
    plane = found / (found @ direction)[:, None] - direction
    np.testing.assert_allclose(plane @ direction, 0, atol=1e-12)
    length = np.sort(np.linalg.norm(plane, axis=1))
    steps = np.linspace(-reach, reach, 9)
    wanted = np.sort(np.hypot(*np.meshgrid(steps, steps)).ravel())
    np.testing.assert_allclose(length, wanted, atol=1e-12)
    assert len(np.unique(plane.round(9), axis=0)) == 81
    np.testing.assert_allclose(plane.sum(axis=0), 0, atol=1e-9)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_eight_directions_lie_beside_one(direction):
    found = _beside(direction, 0.01)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    angle = np.sort(np.arccos(np.minimum(found @ direction, 1)))
    wanted = np.arctan([0.01] * 4 + [0.01 * np.sqrt(2)] * 4)
    np.testing.assert_allclose(angle, wanted, rtol=1e-6)
    across = found - (found @ direction)[:, None] * direction
    np.testing.assert_allclose(across.sum(axis=0), 0, atol=1e-12)


def test_a_texel_costs_its_distance_from_the_middle_and_no_more_than_an_outlier():
    rest = 5 + np.array([-0.2, 0.0, 0.1, -3 * OUTLIER, 3 * OUTLIER])
    cost = np.empty(5)
    _cost_of_each(rest, np.zeros(5, bool), cost)
    np.testing.assert_allclose(cost, [0.2, 0, 0.1, OUTLIER, OUTLIER], atol=1e-12)
    # What clips may be as much brighter as it likes.
    _cost_of_each(rest, np.ones(5, bool), cost)
    np.testing.assert_allclose(cost, [0, 0, 0.1, 0, OUTLIER], atol=1e-12)


def _lit_by(strength: float, seed: int = 1):
    """Two segments without any error in the light of a sun of a ``strength``, of which the third
    direction of four is true and two show nothing of it to the second segment."""
    random = np.random.default_rng(seed)
    share = random.choice([0.0, 0.5, 0.9], (4, 30))
    share[:2, 20:] = 0
    without = random.uniform(0.5, 2, 30)
    albedo = np.where(np.arange(30) < 20, 0.3, 0.6)
    reflected = np.log(albedo * (without + strength * share[2]))
    return reflected, without, share, np.array([0, 20, 30])


@pytest.mark.parametrize("strength", [1.0, 4.0])
def test_the_true_direction_costs_nothing_at_the_true_strength(strength):
    reflected, without, share, first = _lit_by(strength)
    none, strengths = np.zeros(30, bool), np.array([0.5, 1.0, 4.0, 20.0])
    found = _costs(reflected, without, share, none, first, strengths)
    assert found[2] == pytest.approx(0, abs=1e-12)
    assert (found[[0, 1, 3]] > 0.02).all()

    def cost(of: np.ndarray, strength: float) -> np.ndarray:
        rest, off = reflected - np.log(without + strength * of), np.empty(30)
        for low, high in ((0, 20), (20, 30)):
            off[low:high] = np.abs(rest[low:high] - np.median(rest[low:high]))
        return np.minimum(off, OUTLIER)

    for m in range(4):
        each = [cost(share[m], tried) for tried in strengths]
        best = min(each, key=np.mean)
        assert found[m] == pytest.approx(best.mean(), rel=1e-9, abs=1e-12)
        of_texels = _costs_of_texels(reflected, without, share[m], none, first, strengths)
        np.testing.assert_allclose(of_texels, best, atol=1e-12)
    # What clips and would be brighter costs nothing.
    below = np.flatnonzero(cost(share[1], 4.0) > 0)
    clipped = np.isin(np.arange(30), below)
    now = _costs(reflected, without, share, clipped, first, strengths)
    assert now[2] == pytest.approx(0, abs=1e-12)
    assert (now <= found + 1e-12).all()
    assert now[1] < found[1]


def test_only_what_is_more_than_chance_is_better():
    before = np.array([1.0, 2, 3, 4] * 25)
    gain = np.where(np.arange(100) % 2, 1.0, -0.4)  # mean 0.3, deviation 0.7
    assert _is_better(before - gain, before) == (sun_direction._SURE * 0.07 < 0.3)
    assert not _is_better(before - 0.5 * (gain - 0.1), before)
    assert _is_better(before - gain - 0.1, before)
    assert not _is_better(before + gain + 0.1, before)
    assert not _is_better(before, before)


def test_pixels_blur_sunlight_over_the_surface_beside_a_texel(monkeypatch):
    """A row of texels, of which the sun shines on the third: its light lies on the two beside it
    as well, and at the end of the row what is there counts alone."""

    def beside(index, right, down):
        there = (index + right >= 0) & (index + right < 6) & (down == 0)
        return np.where(there, index + right, index), there

    texels = SimpleNamespace(beside_on_surface=beside)
    shone = np.array([0, 0, 1.0, 0, 0, 1.0])
    asked = []

    def sunlit(surface, index, sun, seed):
        asked.append((sun, seed))
        return shone[index]

    monkeypatch.setattr(sun_direction, "sunlit", sunlit)
    found = _blurred_sunlight(SimpleNamespace(texels=texels), np.arange(6), "sun", 7)
    side = np.exp(-0.5 / sun_direction._BLUR**2)
    row = np.array([0, side, 1, side, side, 1]) / (1 + 2 * side)
    row[5] *= (1 + 2 * side) / (1 + side)
    np.testing.assert_allclose(found, row, rtol=1e-12)
    assert set(asked) == {("sun", 7)}
