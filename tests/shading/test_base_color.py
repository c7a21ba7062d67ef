"""One base colour out of several lightings, against a known one: L_d = rho S / pi."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.shading.base_color import NEUTRAL, Reflection, base_color_of


@pytest.fixture(scope="module")
def pair() -> World:
    """A wall and a lamp."""
    return world_of([
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(40, 40)),
        quad((2, 0, 0), (1, 0, 0), (0, 1, 0), size=(16, 16)),
    ])  # fmt: skip


RHO = np.array([0.7, 0.4, 0.2], np.float32)


def _lighting(
    world: World, irradiance: float, error: float, *, seed: int = 0, lamp: bool = False
) -> Reflection:
    """Of texels with the base colour RHO, the lamp's being half of it, their L_d wrong by a
    relative ``error``; ``lamp``: it shines."""
    count, own = len(world.texels), world.texels.object_index()
    rho = np.where(own[:, None] == 1, RHO / 2, RHO)
    noise = 1 + error * np.random.default_rng(seed).standard_normal((count, 1))
    shines = lamp & (own == 1)
    reflected = (rho * np.float32(irradiance / np.pi) * noise).astype(np.float32)
    return Reflection(
        radiance=np.where(shines[:, None], np.float32(30), reflected),
        irradiance=np.full((count, 3), irradiance, np.float32),
        error=np.full(count, error, np.float32),
        known=np.ones(count, bool),
        emissive=shines,
        bound=np.zeros(count, np.float32),
    )


def _rms(found: np.ndarray, rho: np.ndarray) -> float:
    return float(np.sqrt(((found / rho - 1) ** 2).mean()))


def test_errors_of_lightings_average_out_by_their_variances(pair: World):
    wall = pair.texels.of_object(0)
    sure, unsure = _lighting(pair, 5, 0.05, seed=1), _lighting(pair, 0.7, 0.15, seed=2)
    alone = [_rms(base_color_of(pair.texels, [one])[wall], RHO) for one in (sure, unsure)]
    both = _rms(base_color_of(pair.texels, [sure, unsure])[wall], RHO)
    assert alone == pytest.approx([0.05, 0.15], rel=0.1)
    # Weights by the inverse variance, that of any lighting being a little more than its noise.
    assert both == pytest.approx((0.05**-2 + 0.15**-2) ** -0.5, rel=0.1)


def test_what_shines_in_one_lighting_the_other_tells(pair: World):
    lamp = pair.texels.of_object(1)
    lit, dark = _lighting(pair, 5, 0, lamp=True), _lighting(pair, 0.7, 0)
    found = base_color_of(pair.texels, [lit, dark])
    np.testing.assert_allclose(found[lamp], np.broadcast_to(RHO / 2, found[lamp].shape), rtol=1e-5)
    np.testing.assert_array_equal(found, base_color_of(pair.texels, [dark, lit]))
    assert not base_color_of(pair.texels, [lit, lit])[lamp].any()


def _clipped(given: Reflection, which: np.ndarray, bound: float) -> Reflection:
    """Some texels are as bright as ``bound``, W/(m^2 sr), at least, in whatever channel."""
    return given._replace(
        radiance=np.where(which[:, None], np.float32(bound), given.radiance),
        error=np.where(which, np.inf, given.error).astype(np.float32),
        bound=np.where(which, np.float32(bound), 0),
    )


def test_what_clips_has_the_hue_of_its_object_and_is_as_bright_as_it_must_be(pair: World):
    wall = pair.texels.of_object(0)
    half = np.zeros(len(pair.texels), bool)
    half[wall] = pair.texels.position[wall, 0] > 0.5
    sure = _lighting(pair, 5, 0)
    # The brightest channel shows 5 / pi times 0.7.
    for share, brighter in ((0.5, 1.0), (1.0, 1.0), (1.2, 1.2), (9.0, 1 / 0.7)):
        found = base_color_of(pair.texels, [_clipped(sure, half, share * 0.7 * 5 / np.pi)])
        np.testing.assert_allclose(found[half], found[half][:1] * np.ones((half.sum(), 1)))
        np.testing.assert_allclose(found[half][0], brighter * RHO, rtol=1e-3)
        np.testing.assert_allclose(
            found[wall][~half[wall]], RHO[None] + 0 * found[wall][~half[wall]], rtol=1e-5
        )


def test_what_clips_and_nothing_shines_on_has_a_colour_too(pair: World):
    lamp = np.zeros(len(pair.texels), bool)
    lamp[pair.texels.of_object(1)] = True
    given = _lighting(pair, 5, 0)
    dark = given._replace(irradiance=np.where(lamp[:, None], 0, given.irradiance))
    found = base_color_of(pair.texels, [_clipped(dark, lamp, 4.0)])
    np.testing.assert_allclose(found[lamp], 1)


def test_a_thing_that_clips_all_over_is_grey(pair: World):
    lamp = np.zeros(len(pair.texels), bool)
    lamp[pair.texels.of_object(1)] = True
    for share, wanted in ((0.5, NEUTRAL), (1.6 / NEUTRAL * 0.5, 0.8), (9.0, 1.0)):
        given = _clipped(_lighting(pair, 5, 0), lamp, share * NEUTRAL * 5 / np.pi)
        np.testing.assert_allclose(base_color_of(pair.texels, [given])[lamp], wanted, rtol=1e-5)


def test_what_is_only_bounded_counts_nothing_beside_what_is_measured(pair: World):
    sure = _lighting(pair, 5, 0)
    bounded = _clipped(sure, np.ones(len(pair.texels), bool), 9.0)
    found = base_color_of(pair.texels, [bounded, sure])
    assert _rms(found[pair.texels.of_object(0)], RHO) < 1e-3
    np.testing.assert_array_equal(found, base_color_of(pair.texels, [sure, bounded]))


def test_what_no_lighting_shows_is_filled_in_or_neutral(pair: World):
    wall, lamp = pair.texels.of_object(0), pair.texels.of_object(1)
    left = pair.texels.position[:, 0] < 0.5
    right = ~left & (pair.texels.object_index() == 0) & (pair.texels.position[:, 0] < 0.8)
    one = _lighting(pair, 5, 0)._replace(known=left & (pair.texels.object_index() == 0))
    other = _lighting(pair, 2, 0)._replace(known=right)
    found = base_color_of(pair.texels, [one, other])
    np.testing.assert_allclose(found[wall], np.broadcast_to(RHO, found[wall].shape), rtol=1e-5)
    np.testing.assert_array_equal(found[lamp], np.float32(NEUTRAL))
