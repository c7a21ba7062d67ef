"""What hangs together of clipped texels, and what of it may be a lamp."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, room, world_of
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading import clipped_light
from usdbrdf.shading.clipped_light import clipped_groups

WALL, LAMP = 2, 6
BOUND = 3.0


@pytest.fixture(scope="module")
def world() -> World:
    """A room of six walls and a lamp."""
    lamp = quad((1.5, 1, 2.4), (0, 1, 0), (1, 0, 0), size=(16, 16))
    return world_of([*room((0, 0, 0), (4, 3, 2.5), size=(32, 32)), lamp])


@pytest.fixture
def own(world: World):
    return lambda i: np.arange(len(world.texels))[world.texels.of_object(i)]


def _groups(world: World, lit: np.ndarray, clipped: np.ndarray, unseen=()):
    seen = np.ones(len(lit), bool)
    seen[clipped] = False
    seen[list(unseen)] = False
    over = np.zeros(len(lit), bool)
    over[clipped] = True
    return clipped_groups(world.texels, lit, CoverageMap.of(seen, over))


def test_walls_are_no_lamps_although_there_are_too_many_groups(world: World, own, monkeypatch):
    monkeypatch.setattr(clipped_light, "_MAX_GROUPS", 1)
    lit = world.per_object([(0.9 * BOUND,) * 3] * 6 + [(0.1 * BOUND,) * 3])
    patch, lamp = own(WALL).reshape(32, 32)[8:16, 8:16].ravel(), own(LAMP)[:64]
    lit[patch] = lit[lamp] = BOUND
    found = _groups(world, lit, np.concatenate([patch, lamp]))
    assert len(found) == 1
    np.testing.assert_array_equal(np.flatnonzero(found.wall), patch)


def test_nothing_clipped_is_no_group(world: World):
    assert len(_groups(world, world.per_object([(0.2, 0.2, 0.2)] * 7), np.arange(0))) == 0


def test_a_clipped_lamp_is_one_group_with_what_nobody_saw_of_it(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 6 + [(BOUND, BOUND, BOUND)])
    lamp = own(LAMP)
    found = _groups(world, lit, lamp[:100], unseen=lamp[100:])
    assert len(found) == 1
    assert found.lamp[0]
    assert found.object[0] == LAMP
    assert found.bound[0] == BOUND
    np.testing.assert_array_equal(np.flatnonzero(found.group == 0), lamp)


def test_lamps_set_into_a_wall_are_groups_of_their_own(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    parts = [wall[2:8, 2:8].ravel(), wall[20:28, 18:26].ravel()]
    single = wall[16, 4:7]
    clipped = np.concatenate([*parts, single])
    lit[clipped] = BOUND
    found = _groups(world, lit, clipped)
    assert len(found) == 2
    assert found.lamp.all()
    np.testing.assert_array_equal(found.object, WALL)
    # The larger one first; three texels are none.
    for k, part in enumerate(reversed(parts)):
        np.testing.assert_array_equal(np.flatnonzero(found.group == k), np.sort(part))


def test_a_wall_that_clips_where_it_is_brightest_is_no_lamp(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    row, column = np.indices((32, 32))
    bright = 4 * np.exp(-((row - 15.5) ** 2 + (column - 15.5) ** 2) / 60)
    clipped = wall[bright > BOUND]
    lit[wall] = np.minimum(bright, BOUND)[..., None]
    found = _groups(world, lit, clipped)
    np.testing.assert_array_equal(found.lamp, [False])
