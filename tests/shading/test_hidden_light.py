"""What no frame shows sends on what it receives: the underside of a table does not shine like its
top."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, quad, room, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.job.task import TaskRun
from usdbrdf.model.texels import CoverageMap
from usdbrdf.options import Sampling
from usdbrdf.shading.clipped_groups import clipped_groups
from usdbrdf.shading.clipped_light import estimate_clipped_light, reflects_other_light
from usdbrdf.shading.hidden_light import KnownLamps, _albedo, light_of_hidden
from usdbrdf.transport.environment import NO_SUN, Environment, Sun, black_environment
from usdbrdf.transport.irradiance import irradiance_at
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlight
from usdbrdf.transport.tile_draws import independent_tiles

TABLE, LAMP = 6, 7
ALBEDO = [
    (0.5, 0.4, 0.3),
    (0.7, 0.7, 0.7),
    *[(0.6, 0.6, 0.7)] * 4,
    (0.6, 0.5, 0.2),
    (0.8, 0.8, 0.8),
]
SHINES = (30.0, 24.0, 16.0)
SUN = Sun(np.array([0.0, 0.0, 1.0]), np.array([12.0, 9.0, 5.0]))


def _two_sided(front: Part, back: Part) -> Part:
    """One object: the front in the upper half of its atlas, the back in the lower one."""
    low, high = back.uv * (1, 0.5), front.uv * (1, 0.5) + (0, 0.5)
    return Part(
        points=np.concatenate([front.points, back.points]),
        triangles=np.concatenate([front.triangles, back.triangles + 4]),
        uv=np.concatenate([high, low]),
        normals=np.concatenate([front.normals, back.normals]),
        size=(front.size[0], 2 * front.size[1]),
    )


def _world(over: float) -> World:
    """A room with a table, and over it a lamp of two sides; open ``over`` it."""
    table = _two_sided(
        quad((1, 1, 0.8), (1.5, 0, 0), (0, 1, 0), (16, 12)),
        quad((1, 1, 0.78), (0, 1, 0), (1.5, 0, 0), (16, 12)),
    )
    lamp = _two_sided(
        quad((1.5, 1.2, 2.0), (0, 0.5, 0), (0.5, 0, 0), (8, 8)),
        quad((1.5, 1.2, 2.01), (0.5, 0, 0), (0, 0.5, 0), (8, 8)),
    )
    parts = room((0, 0, 0), (4, 3, 2.5), size=(24, 20))
    if over:
        parts[1] = quad((0, 0, 2.5), (0, 3 - over, 0), (4, 0, 0), (24, 20))
    return world_of([*parts, table, lamp])


def _shone(world: World, emitted: np.ndarray, environment: Environment) -> np.ndarray:
    """L_d (T, 3) after five bounces."""
    surface, albedo = TexturedScene(world.scene, world.texels, world.rays), world.per_object(ALBEDO)
    every, lit = np.arange(len(world.texels)), emitted
    for bounce in range(5):
        arriving = irradiance_at(
            world.rays, world.texture(lit), world.lights(lit), environment, world.texels.position,
            world.texels.normal, independent_tiles(len(lit)),
            Sampling(standard_error=0.02, max_rays=512, seed=bounce), world.size,
        ).mean + sunlight(surface, every, environment.sun, bounce)  # fmt: skip
        lit = np.where(emitted > 0, emitted, albedo * arriving / np.pi).astype(np.float32)
    return lit


def _hidden(world: World) -> np.ndarray:
    """(T,): undersides of the table, and what of the lamp faces the ceiling."""
    owner, down = world.texels.object_index(), world.texels.normal[:, 2] < 0
    return ((owner == TABLE) & down) | ((owner == LAMP) & ~down)


@pytest.fixture(scope="module")
def by_lamp():
    """The room, its true L_d by the lamp alone, and what was filled in: as bright as the front."""
    world = _world(0.0)
    owner, hidden = world.texels.object_index(), _hidden(world)
    true = _shone(
        world,
        np.where((owner == LAMP)[:, None], np.float32(SHINES), np.float32(0)),
        black_environment(),
    )
    filled = true.copy()
    for i in (TABLE, LAMP):
        own = owner == i
        filled[own & hidden] = np.median(true[own & ~hidden], axis=0)
    return world, true, filled, hidden


def _estimated(
    world: World, lit: np.ndarray, hidden: np.ndarray, lamps=None, said=()
) -> np.ndarray:
    surface, none = (
        TexturedScene(world.scene, world.texels, world.rays),
        np.zeros(len(hidden), bool),
    )
    known = KnownLamps(none if lamps is None else lamps, dict(said))
    coverage = CoverageMap.of(~hidden, none)
    return light_of_hidden(surface, lit, coverage, black_environment(), 3, known)


def test_an_underside_reflects_what_it_receives(by_lamp):
    world, true, filled, hidden = by_lamp
    under = hidden & (world.texels.object_index() == TABLE)
    found = _estimated(world, filled, hidden)
    assert filled[under].mean() > 5 * true[under].mean()
    np.testing.assert_allclose(found[under].mean(axis=0), true[under].mean(axis=0), rtol=0.1)
    # In its middle it is darker than at its rim, as the floor below it is.
    assert np.corrcoef(found[under, 1], true[under, 1])[0, 1] > 0.6


def test_what_was_seen_and_what_shines_stay_as_they_were(by_lamp):
    world, _, filled, hidden = by_lamp
    found = _estimated(world, filled, hidden)
    np.testing.assert_array_equal(found[~hidden], filled[~hidden])
    back = hidden & (world.texels.object_index() == LAMP)
    np.testing.assert_array_equal(found[back], filled[back])


def test_what_is_only_glimpsed_tells_what_the_rest_of_it_reflects(by_lamp):
    """The table is seen in no pixels of its own: without them it would be grey underneath."""
    world, true, filled, hidden = by_lamp
    owner = world.texels.object_index()
    table, none = owner == TABLE, np.zeros(len(hidden), bool)
    coverage = CoverageMap.of(~hidden & ~table, none, ~hidden & table)
    surface = TexturedScene(world.scene, world.texels, world.rays)
    lamps = KnownLamps(owner == LAMP, {})
    found = light_of_hidden(surface, filled, coverage, black_environment(), 3, lamps)
    under = hidden & table
    np.testing.assert_array_equal(found[~hidden], filled[~hidden])
    np.testing.assert_allclose(found[under].mean(axis=0), true[under].mean(axis=0), rtol=0.1)
    unseen = CoverageMap.of(~hidden & ~table, none)
    grey = light_of_hidden(surface, filled, unseen, black_environment(), 3, lamps)
    off = np.abs(grey[under].mean(axis=0) / true[under].mean(axis=0) - 1)
    assert off.max() > 0.2


def test_what_clips_reflects_what_it_receives_and_no_less_than_it_shows(by_lamp):
    world, true, filled, hidden = by_lamp
    owner, top = world.texels.object_index(), (world.texels.normal[:, 2] > 0.9) & ~hidden
    # Half of the table's top clips, of which a half shows more than it would reflect.
    half = np.flatnonzero(top & (owner == TABLE))[::2]
    shown, clipped = filled.copy(), np.zeros(len(hidden), np.bool_)
    clipped[half] = True
    shown[half] *= 0.25
    shown[half[::2]] *= 8
    surface = TexturedScene(world.scene, world.texels, world.rays)
    coverage = CoverageMap.of(~hidden & ~clipped, clipped)
    lamps = KnownLamps(owner == LAMP, {})
    found = light_of_hidden(surface, shown, coverage, black_environment(), 3, lamps)
    np.testing.assert_allclose(
        found[half[1::2]].mean(axis=0), true[half[1::2]].mean(axis=0), rtol=0.1
    )
    np.testing.assert_array_equal(found[half[::2]], shown[half[::2]])
    # Until it is known whether they shine they keep their bounds.
    lamps = KnownLamps((owner == LAMP) | clipped, {})
    found = light_of_hidden(surface, shown, coverage, black_environment(), 3, lamps)
    np.testing.assert_array_equal(found[half], shown[half])


def test_a_lamp_of_unknown_strength_makes_no_underside_bright(by_lamp):
    """All but the lamp is measured, which counts a tenth of what it is: what it shines on seems to
    reflect several times what it receives."""
    world, true, filled, hidden = by_lamp
    owner = world.texels.object_index()
    dim = filled.copy()
    dim[owner == LAMP] /= 10
    under = hidden & (owner == TABLE)
    found = _estimated(world, dim, hidden, lamps=owner == LAMP)
    assert 0.5 < found[under].mean() / true[under].mean() < 2


def test_what_a_person_says_of_lamps_holds(by_lamp):
    world, _, filled, hidden = by_lamp
    owner = world.texels.object_index()
    under, back = (hidden & (owner == i) for i in (TABLE, LAMP))
    found = _estimated(world, filled, hidden, said={TABLE: True, LAMP: False})
    np.testing.assert_array_equal(found[under], filled[under])
    assert found[back].max() < 0.5 * filled[back].min()


def test_what_stands_in_a_sun_that_is_not_known_yet_is_no_lamp():
    """Most of what is seen of the table is its top in the sun, and some of it in the shade."""
    world = _world(1.6)
    owner, hidden = world.texels.object_index(), _hidden(world)
    hidden |= owner == LAMP
    sky = Environment(np.full((8, 16, 3), 0.3, np.float32), True)
    true = _shone(world, np.zeros((len(hidden), 3), np.float32), sky.under(SUN))
    filled, top = true.copy(), (owner == TABLE) & ~hidden
    filled[(owner == TABLE) & hidden] = np.median(true[top], axis=0)
    surface, none = (
        TexturedScene(world.scene, world.texels, world.rays),
        np.zeros(len(hidden), bool),
    )
    found = light_of_hidden(
        surface, filled, CoverageMap.of(~hidden, none), sky, 3, KnownLamps.unknown(none)
    )
    under = (owner == TABLE) & hidden
    assert filled[under].mean() > 2.5 * true[under].mean()
    assert found[under].mean() < 1.5 * true[under].mean()


def test_nothing_hidden_or_nothing_seen_changes_nothing(by_lamp):
    world, _, filled, hidden = by_lamp
    for none in (np.zeros_like(hidden), np.ones_like(hidden)):
        np.testing.assert_array_equal(_estimated(world, filled, none), filled)


def test_a_patch_in_the_sun_that_clips_is_no_lamp():
    """A part of the table lies in the sun and clips; the panel over the floor shines as brightly,
    in the shadow, and is one."""
    world = _world(1.25)
    texels, owner = world.texels, world.texels.object_index()
    sky = Environment(np.full((8, 16, 3), 0.3, np.float32), True).under(SUN)
    lamp = owner == LAMP
    emitted = np.where(lamp[:, None], np.float32(3.0), np.float32(0))
    true = _shone(world, emitted, sky)
    clips = (true.max(axis=1) > 2.0) & ((owner == TABLE) | lamp)
    lit = np.where(clips[:, None], np.minimum(true, 2.0), true).astype(np.float32)
    coverage = CoverageMap.of(~clips, clips)
    frames = frames_at([look_at(np.array([0.5, 0.5, 1.9]), np.array([2, 1.5, 0.8]))])
    surface = TexturedScene(world.scene, texels, world.rays)
    groups = clipped_groups(texels, lit, coverage)
    assert set(groups.object[groups.lamp]) == {TABLE, LAMP}
    given, once = (surface, lit, coverage, frames, groups), np.ones(len(groups))
    found = reflects_other_light(*given, once, sky, 0)
    assert {int(i) for i in groups.object[found]} == {TABLE}
    walls = groups.with_walls(found)
    assert set(walls.object[walls.lamp]) == {LAMP}
    np.testing.assert_array_equal(walls.wall, clips & (owner == TABLE))
    # Without the sun nothing explains it.
    assert not reflects_other_light(*given, once, sky.under(NO_SUN), 0).any()
    # Nor does it what is much brighter, by the light that it casts.
    assert not reflects_other_light(*given, 5 * once, sky, 0).any()


def test_a_lamp_that_faces_the_sky_stays_one(tmp_path):
    """It is as bright as frames can show, where a white thing would be half of that; what it casts
    tells that it is ten times as bright."""
    world = _world(2.0)
    owner = world.texels.object_index()
    sky, shines = Environment(np.full((8, 16, 3), 1.0, np.float32), True), 20.0
    emitted = np.where((owner == LAMP)[:, None], np.float32(shines), np.float32(0))
    true = _shone(world, emitted, sky)
    clips, bound = owner == LAMP, np.float32(1.5)
    lit = np.where(clips[:, None], bound, true).astype(np.float32)
    lit *= np.exp(0.03 * np.random.default_rng(2).standard_normal((len(lit), 1))) ** ~clips[:, None]
    frames = frames_at([look_at(np.array([0.5, 0.5, 1.9]), np.array([2, 1.5, 0.8]))])
    surface = TexturedScene(world.scene, world.texels, world.rays)
    coverage, run = CoverageMap.of(~clips, clips), TaskRun(tmp_path, "shade", tmp_path / "work")
    found = estimate_clipped_light(run, surface, lit.astype(np.float32), coverage, frames, sky, 0)
    assert found.groups.lamp.all()
    assert found.estimate.determined.all()
    np.testing.assert_allclose(found.lit[clips].mean(), shines, rtol=0.2)


def test_what_stands_in_stripes_of_sunlight_is_no_lamp():
    # Pixels blur the stripes that S has sharp: most texels exceed S, all together do not.
    world = world_of([quad((k, 0, 0), (1, 0, 0), (0, 1, 0), (10, 10)) for k in (0, 2, 4, 6)])
    texels = world.texels
    every, owner = np.arange(len(texels)), texels.object_index()
    striped = (owner == 0) & (every % 5 < 2)
    irradiance = np.where(striped, 10.0, 1.0)
    sent = np.select([striped, owner == 0, owner == 1], [3.0, 1.3, 1.3], 0.5) / np.pi

    def shines(level: float) -> list[bool]:
        """Which objects do, where this much more is sent by the first."""
        light = np.where(owner == 0, level, 1) * sent
        rows = [np.repeat(a[:, None], 3, axis=1).astype(np.float32) for a in (light, irradiance)]
        lamps = KnownLamps(np.zeros(len(texels), bool), {})
        lamp = _albedo(texels, every, *rows, every, lamps)[1]
        return [bool(lamp[owner == k].all()) for k in range(4)]

    # The median of all texels is what is usual, and no more than 1.
    assert shines(1) == [False, True, False, False]
    assert shines(7) == [True, True, False, False]
