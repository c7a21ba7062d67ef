"""What shines by itself, and what only reflects a lot."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, room, world_of
from usdbrdf.shading.doubt import shines_evenly
from usdbrdf.shading.shaded import find_emitters

LAMP = 6
ALBEDO = 0.5
SHADING = 2.0


@pytest.fixture(scope="module")
def world() -> World:
    """A room of six walls and a lamp."""
    lamp = quad((1.5, 1, 2.4), (0, 1, 0), (1, 0, 0), size=(16, 16))
    return world_of([*room((0, 0, 0), (4, 3, 2.5), size=(16, 16)), lamp])


@pytest.fixture
def lit(world: World) -> np.ndarray:
    """L_d = rho S / pi everywhere but on the lamp, which shines with 8, 7, 6."""
    wall = (ALBEDO * SHADING / np.pi,) * 3
    return world.per_object([wall] * 6 + [(8, 7, 6)])


def _find(world: World, lit: np.ndarray, seen=None, clipped=None):
    shading = np.full_like(lit, SHADING)
    everywhere = np.ones(len(lit), bool)
    return find_emitters(
        world.texels,
        lit,
        shading,
        everywhere if seen is None else seen,
        ~everywhere if clipped is None else clipped,
    )


def test_the_lamp_is_found_and_nothing_else(world: World, lit: np.ndarray):
    found = _find(world, lit)
    np.testing.assert_array_equal(found.is_lamp, [False] * 6 + [True])
    np.testing.assert_array_equal(found.emissive, world.texels.object_index() == LAMP)
    np.testing.assert_allclose(found.radiance[LAMP], [8, 7, 6], rtol=1e-6)
    np.testing.assert_array_equal(found.radiance[:LAMP], 0)
    assert not found.lower_bound.any()


def test_a_glossy_surface_somewhat_over_one_is_no_emitter(world: World, lit: np.ndarray):
    # pi L_d / S = 1.1: ambient specular light kept in L_d on a whole wall.
    lit[world.texels.object_index() == 2] = 1.1 * SHADING / np.pi
    found = _find(world, lit)
    assert not found.is_lamp[2]
    assert not found.emissive[world.texels.object_index() == 2].any()
    # One at 1.5 is none that a reflector could reach.
    lit[world.texels.object_index() == 2] = 1.5 * SHADING / np.pi
    assert _find(world, lit).is_lamp[2]


def test_what_exceeds_light_that_is_known_badly_is_no_emitter(world: World, lit: np.ndarray):
    lit[world.texels.object_index() == 2] = 1.5 * SHADING / np.pi
    shading, everywhere = np.full_like(lit, SHADING), np.ones(len(lit), bool)

    def found(doubt: float):
        return find_emitters(world.texels, lit, shading, everywhere, ~everywhere, doubt=doubt)

    np.testing.assert_array_equal(found(0.3).is_lamp, [False] * 6 + [True])
    assert not found(0.3).emissive[world.texels.object_index() == 2].any()
    assert found(0.05).is_lamp[2]
    lit[world.texels.object_index() == 2] = 2.6 * SHADING / np.pi
    assert found(np.inf).is_lamp[2]


PANEL = 2


@pytest.fixture
def panel(world: World, lit: np.ndarray):
    """What is asked of a wall, half of which has twice as much light as the other half: whether it
    counts as even, and as a lamp where lamps are known badly."""
    own = np.flatnonzero(world.texels.object_index() == PANEL)
    shading = np.full_like(lit, SHADING)
    shading[own[: len(own) // 2]] *= 2
    everywhere = np.ones(len(lit), bool)

    def asked(shown, shading=shading, error=None, seen=everywhere):
        radiance = lit.copy()
        radiance[own] = shown
        measured = world.texels, radiance, shading
        even = shines_evenly(*measured, 0.05 * shading if error is None else error, seen)
        assert not even[[0, 1, 3, 4, 5, LAMP]].any()
        doubts = {"doubt": 0.6, "doubt_of_whole": np.where(even, 0, 0.6)}
        found = find_emitters(*measured, seen, ~everywhere, **doubts)
        return bool(even[PANEL]), bool(found.is_lamp[PANEL]), int(found.emissive[own].sum())

    return asked, own, shading


def test_what_does_not_follow_the_light_on_it_shines_however_badly_that_is_known(panel):
    asked, own, shading = panel
    bright = 1.5 * 2 * SHADING / np.pi
    assert asked(bright) == (True, True, len(own))
    assert asked(bright, seen=~np.isin(np.arange(len(shading)), own))[:2] == (False, False)
    # Noise of S as large makes a pattern like it of any wall.
    assert asked(bright, error=0.27 * shading)[:2] == (False, False)
    assert asked(bright, error=0.2 * shading)[:2] == (True, True)
    # What sends no more than it could reflect does not shine, in whole or in part.
    dim = np.full((len(own), 3), 0.8 * SHADING / np.pi)
    assert asked(dim) == (True, False, 0)


def test_a_reflector_follows_the_light_on_it(panel):
    asked, own, shading = panel
    shown = 1.5 * shading[own] / np.pi
    assert asked(shown) == (False, False, 0)
    # Paint of two kinds does not cancel it.
    shown[::3] *= 0.7
    assert asked(shown) == (False, False, 0)
    # Where an even lamp is told too weak, S varies more than what is seen of it, which follows.
    weakly = 1.5 * 2 * SHADING / np.pi * (shading[own] / shading[own].max()) ** 0.25
    assert asked(weakly)[:2] == (False, False)


@pytest.mark.parametrize(("share", "dark"), [(0.02, 1e-3), (0.04, 0.02)])
def test_a_rim_without_light_makes_no_lamp_of_a_wall(panel, share: float, dark: float):
    asked, own, usual = panel
    shading = np.full_like(usual, SHADING)
    shading[own[: round(share * len(own))]] *= dark
    assert asked(1.5 * SHADING / np.pi, shading)[:2] == (False, False)


def test_light_that_does_not_vary_tells_nothing(panel):
    asked, own, shading = panel
    level = np.full_like(shading, SHADING)
    level[own[0]] *= 1 + 1e-6
    assert asked(1.5 * SHADING / np.pi, level, 0 * level)[:2] == (False, False)


def test_the_inside_of_a_bulb_which_no_frame_shows_does_not_keep_it_from_being_a_lamp(
    world: World, lit: np.ndarray
):
    shading, everywhere = np.full_like(lit, SHADING), np.ones(len(lit), bool)
    own = np.flatnonzero(world.texels.object_index() == LAMP)
    shading[own[64:]] = np.pi * lit[own[0]]
    inside = np.isin(np.arange(len(lit)), own[64:])
    given = world.texels, lit, shading, everywhere, ~everywhere
    found = find_emitters(*given, observed=~inside)
    assert found.is_lamp[LAMP]
    assert found.emissive[own].all()
    assert not find_emitters(*given).is_lamp[LAMP]


def test_single_noisy_texels_are_no_lamps(world: World, lit: np.ndarray):
    wall = np.flatnonzero(world.texels.object_index() == 0)
    # Isolated in the atlas: every fourth texel of every fourth row.
    local = wall.reshape(16, 16)[::4, ::4].ravel()
    lit[local] = 50
    assert not _find(world, lit).emissive[wall].any()
    # 5 x 5 that hang together: a spot in the ceiling.
    tile = wall.reshape(16, 16)[4:9, 4:9].ravel()
    lit[tile] = 50
    found = _find(world, lit)
    np.testing.assert_array_equal(np.flatnonzero(found.emissive[wall]), np.sort(tile - wall[0]))
    assert not found.is_lamp[0]
    np.testing.assert_allclose(found.radiance[0], 50, rtol=1e-5)


@pytest.mark.parametrize("enough", [False, True])
def test_a_few_bright_texels_of_what_nobody_saw_make_no_lamp(
    world: World, lit: np.ndarray, enough: bool
):
    """As of a bar before a bright window, at whose rim frames show the window."""
    own = world.texels.object_index() == 2
    few = own & (np.cumsum(own) <= own.sum() // 20 + enough)
    lit[few] = 9
    found = _find(world, lit, seen=~own | few)
    assert found.is_lamp[2] == enough
    assert found.emissive[own].any() == enough


def test_dark_corners_are_no_lamps(world: World, lit: np.ndarray):
    # Where S is nearly 0 any L_d exceeds it; but it is dark.
    own = world.texels.object_index() == 3
    lit[own] = 1e-3
    shading = np.full_like(lit, SHADING)
    shading[own] = 1e-6
    everywhere = np.ones(len(lit), bool)
    found = find_emitters(world.texels, lit, shading, everywhere, ~everywhere)
    assert not found.emissive[own].any()


def test_a_clipped_lamp_is_a_lower_bound(world: World, lit: np.ndarray):
    own = world.texels.object_index() == LAMP
    found = _find(world, lit, seen=~own, clipped=own)
    assert found.is_lamp[LAMP]
    np.testing.assert_array_equal(found.lower_bound, [False] * 6 + [True])
    np.testing.assert_allclose(found.radiance[LAMP], [8, 7, 6], rtol=1e-6)
    # A twentieth of it is not worth a warning.
    few = own & (np.cumsum(own) <= 12)
    assert not _find(world, lit, seen=~few, clipped=few).lower_bound.any()


def test_the_dark_measured_half_of_a_lamp_says_nothing_of_how_bright_it_is(
    world: World, lit: np.ndarray
):
    """As a sheet of metal that is lit from behind a pane on one side, all of it clipped there."""
    own = np.flatnonzero(world.texels.object_index() == LAMP)
    dark, bright = own[: len(own) * 2 // 5], own[len(own) * 2 // 5 :]
    lit[dark] = 1e-3
    clipped = np.zeros(len(lit), bool)
    clipped[bright] = True
    found = _find(world, lit, seen=~clipped, clipped=clipped)
    assert found.is_lamp[LAMP]
    assert found.lower_bound[LAMP]
    np.testing.assert_allclose(found.radiance[LAMP], [8, 7, 6], rtol=1e-6)


def test_a_lamp_by_word_is_as_bright_as_what_was_seen_of_it_though_what_was_not_is_brighter(
    world: World, lit: np.ndarray
):
    """What nobody saw was filled in, and less light may come to it."""
    own = np.flatnonzero(world.texels.object_index() == LAMP)
    front, back = own[: len(own) // 2], own[len(own) // 2 :]
    lit[own] = 0.9 * SHADING / np.pi
    shading = np.full_like(lit, SHADING)
    shading[back] /= 4
    seen = np.ones(len(lit), bool)
    seen[back] = False
    found = find_emitters(world.texels, lit, shading, seen, ~seen & False, said={LAMP: True})
    assert found.is_lamp[LAMP]
    assert not found.lower_bound[LAMP]
    np.testing.assert_allclose(found.radiance[LAMP], lit[front[0]], rtol=1e-6)


def test_no_wall_shines_while_a_lamp_is_too_dark(world: World, lit: np.ndarray):
    # The lamp is known as 8 at least and is brighter: S is half of what it should be, and a wall of
    # albedo 0.75 looks like 1.5.
    own = world.texels.object_index() == LAMP
    lit[world.texels.object_index() == 2] *= 1.5
    shading = np.full_like(lit, SHADING / 2)
    assert find_emitters(world.texels, lit, shading, ~own, own).is_lamp[2]
    found = find_emitters(world.texels, lit, shading, ~own, own, unknown_lamp=8)
    np.testing.assert_array_equal(found.is_lamp, [False] * 6 + [True])
    # A measured lamp as bright as that still counts.
    lit[world.texels.object_index() == 2] = 9
    found = find_emitters(world.texels, lit, shading, ~own, own, unknown_lamp=8)
    np.testing.assert_array_equal(found.is_lamp, [False] * 2 + [True] + [False] * 3 + [True])


def test_the_unseen_back_of_a_lamp_shines_with_it(world: World, lit: np.ndarray):
    own = world.texels.object_index() == LAMP
    half = own & (np.cumsum(own) <= 128)
    lit[own & ~half] = 0
    found = _find(world, lit, seen=~(own & ~half))
    assert found.emissive[own].all()
    # Its radiance is that of what was seen.
    np.testing.assert_allclose(found.radiance[LAMP], [8, 7, 6], rtol=1e-6)


def test_who_says_so_decides_what_shines(world: World, lit: np.ndarray):
    everywhere, shading = np.ones(len(lit), bool), np.full_like(lit, SHADING)
    said = {2: True, LAMP: False}
    own = world.texels.object_index() == 2
    found = find_emitters(world.texels, lit, shading, everywhere, ~everywhere, said=said)
    np.testing.assert_array_equal(found.is_lamp, [i == 2 for i in range(7)])
    np.testing.assert_array_equal(found.emissive, own)
    np.testing.assert_allclose(found.radiance[2], lit[own][0], rtol=1e-5)
    # One that nobody saw shines with what it was filled in with, at least.
    found = find_emitters(world.texels, lit, shading, ~own, ~everywhere, said=said)
    assert found.lower_bound[2]
    np.testing.assert_allclose(found.radiance[2], lit[own][0], rtol=1e-5)


def test_an_object_that_nobody_saw_is_no_lamp(world: World, lit: np.ndarray):
    own = world.texels.object_index() == LAMP
    found = _find(world, lit, seen=~own)
    assert not found.is_lamp[LAMP]
    assert not found.emissive.any()
