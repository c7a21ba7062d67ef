"""What hangs together of clipped texels, and what of it may be a lamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.physics.surfaces import Part, World, quad, room, world_of
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading import clipped_groups as groups_of_clipped
from usdbrdf.shading.clipped_emitters import EstimatedRadiance
from usdbrdf.shading.clipped_groups import clipped_groups, hardly_shown
from usdbrdf.shading.clipped_light import lamps_with_unseen

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


def _coverage(lit: np.ndarray, clipped: np.ndarray, unseen=()) -> CoverageMap:
    seen = np.ones(len(lit), bool)
    seen[clipped] = False
    seen[list(unseen)] = False
    over = np.zeros(len(lit), bool)
    over[clipped] = True
    return CoverageMap.of(seen, over)


def _groups(world: World, lit: np.ndarray, clipped: np.ndarray, unseen=()):
    return clipped_groups(world.texels, lit, _coverage(lit, clipped, unseen))


def _told(world: World, lit: np.ndarray, clipped: np.ndarray, unseen, times=9.0, determined=True):
    """The groups with what nobody saw of lamps that are so many times as bright as their bounds,
    and how many times they are then."""
    groups = _groups(world, lit, clipped, unseen)
    told = EstimatedRadiance(
        multiplier=np.tile(times * np.array([1, 0.5, 0.25]), (len(groups), 1)),
        standard_error=np.full((len(groups), 3), 0.1),
        determined=np.full(len(groups), determined),
    )
    coverage = _coverage(lit, clipped, unseen)
    area = world.texels.area * world.texels.interior
    groups, told = lamps_with_unseen(
        world.texels, coverage, groups, told, lambda shines: float(area[shines].sum())
    )
    return groups, told.multiplier


def test_walls_are_no_lamps_although_there_are_too_many_groups(world: World, own, monkeypatch):
    monkeypatch.setattr(groups_of_clipped, "_MAX_GROUPS", 1)
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


def test_a_lamp_of_which_few_texels_clip_is_one_where_no_other_is_seen(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 6 + [(0.1 * BOUND,) * 3])
    lamp = own(LAMP)
    found = _groups(world, lit, lamp[:15], unseen=lamp[15:])
    np.testing.assert_array_equal(found.lamp, [True])
    np.testing.assert_array_equal(np.flatnonzero(found.group == 0), lamp)


@pytest.mark.parametrize(("clipped", "measured"), [(3, 0), (15, 1)])
def test_a_glint_is_not_all_that_an_object_is_but_where_a_person_says_so(
    world: World, own, clipped: int, measured: int
):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 6 + [(0.1 * BOUND,) * 3])
    lamp = own(LAMP)
    coverage = _coverage(lit, lamp[:clipped], unseen=lamp[clipped + measured :])
    spots = hardly_shown(world.texels, coverage, {})
    assert spots.tolist() == ([] if measured else [LAMP])
    assert len(clipped_groups(world.texels, lit, coverage, {}, spots)) == len(spots)
    assert not len(hardly_shown(world.texels, coverage, {LAMP: False}))
    assert len(clipped_groups(world.texels, lit, coverage)) == 0
    assert len(clipped_groups(world.texels, lit, coverage, {LAMP: False})) == 0
    found = clipped_groups(world.texels, lit, coverage, {LAMP: True})
    assert found.lamp.tolist() == found.small.tolist() == [True]


def test_few_clipped_texels_of_what_else_is_measured_are_a_glint(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    assert len(_groups(world, lit, own(LAMP)[:3])) == 0


def test_of_too_many_groups_lamps_stay_since_they_may_be_brighter(world: World, own, monkeypatch):
    monkeypatch.setattr(groups_of_clipped, "_MAX_GROUPS", 1)
    lit = world.per_object([(0.9 * BOUND,) * 3] * 6 + [(0.5 * BOUND,) * 3])
    patch, lamp = own(WALL).reshape(32, 32)[4:24, 4:20].ravel(), own(LAMP)
    lit[patch] = BOUND
    found = _groups(world, lit, np.concatenate([patch, lamp]))
    assert 2 * world.texels.area[lamp].sum() < world.texels.area[patch].sum()
    np.testing.assert_array_equal(found.object, [LAMP])


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


def test_what_nobody_saw_beside_a_lamp_in_a_wall_is_part_of_it(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp, beside = wall[8:16, 8:16].ravel(), wall[4:20, 16:20]
    lit[lamp] = BOUND
    # Not what lies beside what was seen of the wall.
    far = wall[26:30, 8:16].ravel()
    found, times = _told(world, lit, lamp, [*beside.ravel(), *far])
    assert found.lamp.all()
    # Of these four columns two lie nearer to the wall behind them.
    assert (found.group[[*lamp, *beside[6:-6, :2].ravel()]] == 0).all()
    assert (found.group[beside[:, 2:]] == -1).all()
    assert (found.group[beside[[0, -1]]] == -1).all()
    assert set(np.flatnonzero(found.group == 0)) <= {*lamp, *beside.ravel()}
    # Its power stays.
    grown = np.count_nonzero(found.group == 0) / len(lamp)
    np.testing.assert_allclose(times[0] * grown, [9, 4.5, 2.25])


def test_what_texels_bring_tells_how_much_larger_a_lamp_is(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp, beside = wall[8:16, 24:30].ravel(), wall[8:16, 30:]
    lit[lamp] = BOUND
    interior = np.ones(len(lit), bool)
    interior[wall[:, 31]] = False
    edged = World(scene=world.scene, texels=replace(world.texels, interior=interior))
    found, times = _told(edged, lit, lamp, wall[:, 30:].ravel())
    grown = np.flatnonzero(found.group == 0)
    assert set(beside[2:-2].ravel()) <= set(grown)
    assert times[0, 0] == pytest.approx(9 * len(lamp) / interior[grown].sum())
    assert not interior[grown].all()


def test_only_lamps_that_are_determined_and_bright_enough_go_on_beside(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp, beside = wall[8:16, 8:16].ravel(), wall[4:20, 16:20].ravel()
    lit[lamp] = BOUND
    for given in ({"determined": False}, {"times": 1.05}):
        found, times = _told(world, lit, lamp, beside, **given)
        np.testing.assert_array_equal(np.flatnonzero(found.group == 0), np.sort(lamp))
        assert times[0, 0] == given.get("times", 9)


def test_a_lamp_reaches_no_farther_into_what_nobody_saw_than_it_is_wide(world: World, own):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp, unseen = wall[12:20, :8].ravel(), wall[:, 8:].ravel()
    lit[lamp] = BOUND
    found = np.flatnonzero(_told(world, lit, lamp, unseen)[0].group == 0)
    place = world.texels.position
    away = np.linalg.norm(place[found][:, None] - place[lamp], axis=2).min(axis=1)
    radius = np.sqrt(world.texels.area[lamp].sum() / np.pi)
    assert 0.8 * radius < away.max() < radius


def test_a_lamp_s_neighbourhood_alone_is_looked_at(world: World, own, monkeypatch):
    """Walls have millions of texels, and parts that clip by the hundred."""
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp = wall[12:16, 12:16].ravel()
    lit[lamp] = BOUND
    looked: list[int] = []

    class Tree(cKDTree):
        def __init__(self, points):
            looked.append(len(points))
            super().__init__(points)

        def query(self, points, *given, **more):
            found = super().query(points, *given, **more)
            looked.append(len(points) if self.m == 6 else 0)
            return found

    monkeypatch.setattr(groups_of_clipped, "cKDTree", Tree)
    unseen = [*wall[8:20, 16:20].ravel(), *wall[24:].ravel()]
    found, _ = _told(world, lit, lamp, unseen)
    assert np.count_nonzero(found.group == 0) > len(lamp)
    assert max(looked) < 150


@pytest.mark.parametrize("hidden", [True, False])
def test_a_part_without_area_or_with_all_around_it_seen_is_what_was_seen(world: World, own, hidden):
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    wall = own(WALL).reshape(32, 32)
    lamp, beside = wall[8:16, 8:16].ravel(), wall[8:16, 16:20].ravel()
    lit[lamp] = BOUND
    area = world.texels.area.copy()
    area[lamp] = 0 if hidden else area[lamp]
    texels = replace(world.texels, area=area)
    observed = np.setdiff1d(own(WALL), beside)
    part = groups_of_clipped.with_unseen(texels, lamp, observed, beside if hidden else beside[:0])
    np.testing.assert_array_equal(part, lamp)


def _two_faced(front: Part, back: Part) -> Part:
    """Both in one object, beside each other in its atlas."""
    left, right = front.uv * (0.5, 1), back.uv * (0.5, 1) + (0.5, 0)
    return Part(
        points=np.concatenate([front.points, back.points]),
        triangles=np.concatenate([front.triangles, back.triangles + len(front.points)]),
        uv=np.concatenate([left, right]),
        normals=np.concatenate([front.normals, back.normals]),
        size=(2 * front.size[0], front.size[1]),
    )


def test_the_back_of_a_lamp_that_is_seen_in_part_is_none():
    """One sheet of metal, its back black and seen, the lamp on its front seen but for a strip."""
    front = quad((1.5, 1, 2.4), (0, 1, 0), (1, 0, 0), size=(16, 16))
    back = quad((1.5, 1, 2.401), (1, 0, 0), (0, 1, 0), size=(16, 16))
    world = world_of([*room((0, 0, 0), (4, 3, 2.5)), _two_faced(front, back)])
    own = np.arange(*world.texels.of_object(LAMP).indices(len(world.texels)))
    down = world.texels.geometric_normal[own, 2] < 0
    assert 0 < down.sum() < len(own)
    strip = down & (world.texels.position[own, 0] > 2.3)
    lit = world.per_object([(0.2, 0.2, 0.2)] * 7)
    lamp = own[down & ~strip]
    lit[lamp] = BOUND
    found, _ = _told(world, lit, lamp, own[strip])
    assert found.lamp.all()
    np.testing.assert_array_equal(np.flatnonzero(found.group == 0), own[down])
