"""A room of known albedo whose lamps clip in every frame: the lamps, and S from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, quad, room, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.job.task import TaskRun
from usdbrdf.model.texels import CoverageMap
from usdbrdf.options import Sampling
from usdbrdf.shading import clipped_light, lamp_light
from usdbrdf.shading.clipped_emitters import UNTOLD, EstimatedRadiance, nothing_known
from usdbrdf.shading.clipped_groups import ClippedGroups
from usdbrdf.shading.clipped_light import ClippedLight, _with_estimates, estimate_clipped_light
from usdbrdf.shading.outside_light import doubt_by_views
from usdbrdf.shading.shaded import shade_surface
from usdbrdf.transport.environment import Environment, Sun, black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlight
from usdbrdf.transport.tile_draws import independent_tiles

NO_LIGHT = black_environment()
NOTHING_SAID: Mapping[int, bool] = MappingProxyType({})
ALBEDO = [(0.5, 0.4, 0.3), (0.8, 0.8, 0.8), (0.6, 0.6, 0.7), (0.7, 0.3, 0.2), (0.4, 0.5, 0.7)]
ALBEDO += [(0.6, 0.6, 0.6)]
LAMPS = [(12.0, 10.0, 7.0), (5.0, 5.5, 6.5)]
SATURATION = 3.0


@pytest.fixture(autouse=True)
def angles(monkeypatch) -> list[float]:
    """Degrees between directions from which spots clip; these frames have no pictures."""
    apart = [0.0]

    def of_glare(_surface, _frames, index, _seed):
        return np.full(len(index), apart[0])

    monkeypatch.setattr(clipped_light, "angles_of_glare", of_glare)
    return apart


def _shone(
    world: World,
    albedo: np.ndarray,
    emitted: np.ndarray,
    bounces: int,
    environment: Environment = NO_LIGHT,
) -> np.ndarray:
    """L_d (T, 3) after some bounces, with noise of each texel's own, as pictures have it."""
    order, _ = tiles_of_texels(world.texels)
    tile = independent_tiles(len(order))
    surface = TexturedScene(world.scene, world.texels, world.rays)
    lit = emitted
    for bounce in range(bounces):
        found = irradiance_at(
            world.rays, world.texture(lit), world.lights(lit), environment,
            world.texels.position[order], world.texels.normal[order], tile,
            Sampling(standard_error=0.01, max_rays=512, seed=bounce), world.size,
        )  # fmt: skip
        irradiance = np.empty_like(lit)
        irradiance[order] = found.mean + sunlight(surface, order, environment.sun, bounce)
        lit = (emitted + albedo * irradiance / np.pi).astype(np.float32)
    return lit


@pytest.fixture(scope="module")
def world() -> World:
    """A room with a lamp under the ceiling, object 6, and one before a wall, object 7."""
    lamps = (
        quad((1, 1, 2.3), (0, 0.4, 0), (0.4, 0, 0)),
        quad((3.9, 1, 1), (0, 0, 0.4), (0, 0.4, 0)),
    )
    return world_of([*room((0, 0, 0), (4, 3, 2.5), size=(20, 20)), *lamps])


@pytest.fixture(scope="module")
def truth(world: World) -> np.ndarray:
    emitted = world.per_object([(0, 0, 0)] * 6 + LAMPS)
    rng = np.random.default_rng(5)
    albedo = world.per_object(ALBEDO + [(0, 0, 0)] * 2)
    albedo *= np.exp(0.03 * rng.standard_normal((len(albedo), 1))).astype(np.float32)
    return _shone(world, albedo, emitted, bounces=5)


def _estimated(
    world: World,
    lit: np.ndarray,
    clipped: np.ndarray,
    folder: Path,
    environment: Environment = NO_LIGHT,
    said: Mapping[int, bool] = NOTHING_SAID,
    open_to_sky: tuple[int, ...] = (),
    seen: np.ndarray | None = None,
) -> ClippedLight:
    eyes = [np.array(eye) for eye in ((0.4, 0.4, 1.5), (3.6, 2.6, 1.5), (0.4, 2.6, 1.2))]
    frames = frames_at([look_at(eye, np.array([2.0, 1.5, 1.0])) for eye in eyes])
    surface = TexturedScene(world.scene, world.texels, world.rays, panes=open_to_sky)
    run = TaskRun(folder, "shade", folder / "work")
    coverage = CoverageMap.of(~clipped if seen is None else seen, clipped)
    return estimate_clipped_light(run, surface, lit, coverage, frames, environment, 0, said)


@pytest.fixture(scope="module")
def beside_walls() -> tuple[World, np.ndarray, np.ndarray]:
    """A white room with a lamp in its corner, object 6, and L_d of photographs in which all that is
    brighter than most walls clips."""
    lamp = quad((0.15, 1.2, 2.3), (0, 0.6, 0), (0.25, 0, 0))
    corner = world_of([*room((0, 0, 0), (4, 3, 2.5), size=(48, 48)), lamp])
    albedo = corner.per_object([(0.8, 0.8, 0.8)] * 6 + [(0, 0, 0)])
    albedo *= np.exp(0.03 * np.random.default_rng(5).standard_normal((len(albedo), 1)))
    emitted = corner.per_object([(0, 0, 0)] * 6 + [(30, 25, 20)])
    light = _shone(corner, albedo.astype(np.float32), emitted, bounces=6)
    clipped = (light >= 0.5).any(axis=1)
    return corner, np.where(clipped[:, None], np.float32(0.5), light), clipped


def test_lamps_do_not_make_up_for_what_walls_that_clip_reflect_of_them(beside_walls, tmp_path):
    """0.5 instead of 1.5 to 2.7: 43, 36, 28 if they do."""
    corner, lit, clipped = beside_walls
    light = _estimated(corner, lit, clipped, tmp_path)
    assert light.groups.object[light.groups.lamp].tolist() == [6]
    found = light.lit[corner.texels.of_object(6)].mean(axis=0)
    np.testing.assert_allclose(found, (30, 25, 20), rtol=0.25)


def test_of_walls_of_unknown_albedo_nothing_is_reckoned(beside_walls, tmp_path, monkeypatch):
    corner, lit, clipped = beside_walls
    reckoned = []

    def hidden(surface, lit, *_):
        reckoned.append(1)
        return lit

    monkeypatch.setattr(clipped_light, "light_of_hidden", hidden)
    owner = corner.texels.object_index()
    walls = np.isin(owner, np.unique(owner[clipped]))
    _estimated(corner, np.where(walls[:, None], np.float32(0.5), lit), walls, tmp_path)
    assert not reckoned
    _estimated(corner, lit, clipped, tmp_path / "some")
    assert reckoned


def test_a_glint_takes_no_lamp_for_a_wall(tmp_path: Path):
    """A lamp that is measured, and a knob of which two texels clip."""
    lamp = quad((1, 1, 2.3), (0, 0.4, 0), (0.4, 0, 0))
    knob = quad((3.97, 1.5, 1.0), (0, 0, 0.03), (0, 0.03, 0), size=(3, 3))
    place = world_of([*room((0, 0, 0), (4, 3, 2.5), size=(20, 20)), lamp, knob])
    albedo = place.per_object([*ALBEDO, (0, 0, 0), (0.3, 0.3, 0.3)])
    emitted = place.per_object([(0, 0, 0)] * 6 + [(2.5, 2.5, 2.5), (0, 0, 0)])
    lit = _shone(place, albedo, emitted, bounces=4)
    own = np.flatnonzero(place.texels.object_index() == 7)
    lit[own], clipped, seen = SATURATION, np.zeros(len(lit), bool), np.ones(len(lit), bool)
    clipped[own[4:6]], seen[own] = True, False
    frames = frames_at([look_at(np.array([0.4, 0.4, 1.5]), np.array([2.0, 1.5, 1.0]))])
    surface = TexturedScene(place.scene, place.texels, place.rays)
    coverage, run = CoverageMap.of(seen, clipped), TaskRun(tmp_path, "shade", tmp_path / "work")
    sampling = Sampling(standard_error=0.03, max_rays=256)
    shaded = shade_surface(run, surface, lit, coverage, frames, None, sampling, "none")
    assert shaded.light.groups.object.tolist() == [7]
    assert shaded.emitters.is_lamp[6]


def test_a_night_sky_takes_no_lamp_for_what_reflects_it(
    world: World, truth: np.ndarray, tmp_path: Path, monkeypatch
):
    asked = []

    def reflects(surface, lit, coverage, frames, groups, *_):
        asked.append(len(groups))
        return np.zeros(len(groups), np.bool_)

    monkeypatch.setattr(clipped_light, "reflects_other_light", reflects)
    clipped = (truth >= SATURATION).any(axis=1)
    lit = np.where(clipped[:, None], np.float32(SATURATION), truth)
    for level, times in ((1e-4, 0), (1.0, 1)):
        sky = Environment(np.full((4, 8, 3), level, np.float32), True)
        _estimated(world, lit, clipped, tmp_path / str(times), sky, open_to_sky=(3,))
        assert len(asked) == times


def test_the_lamps_are_as_bright_as_their_light_says(
    world: World, truth: np.ndarray, tmp_path: Path
):
    clipped = (truth >= SATURATION).any(axis=1)
    assert 128 <= clipped.sum() < 300
    lit = np.where(clipped[:, None], np.float32(SATURATION), truth)
    before = lit.copy()
    light = _estimated(world, lit, clipped, tmp_path)
    np.testing.assert_array_equal(lit, before)
    np.testing.assert_array_equal(light.lit[~clipped], lit[~clipped])
    assert light.estimate.determined.all()
    assert light.least_of_lamps(np.zeros(len(lit))) == 0
    for lamp, expected in zip((6, 7), LAMPS, strict=True):
        found = light.lit[world.texels.of_object(lamp)].mean(axis=0)
        error = light.error_of_object(lamp)
        assert UNTOLD < error < 1.3 * UNTOLD
        assert np.abs(np.log(found / expected)).max() < error


def _with_thing_of_which_three_texels_clip(
    world: World,
    albedo: list[tuple[float, float, float]],
    emitted: list[tuple[float, float, float]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L_d, what clips in it and what is seen, where nothing else is seen of the last object."""
    noise = np.exp(0.03 * np.random.default_rng(5).standard_normal((len(world.texels), 1)))
    lit = _shone(
        world, (world.per_object(albedo) * noise).astype(np.float32), world.per_object(emitted), 4
    )
    own = np.flatnonzero(world.texels.object_index() == len(albedo) - 1)
    lit[own] = SATURATION
    clipped = (lit >= SATURATION).any(axis=1)
    seen = ~clipped
    clipped[own[3:]] = False
    return np.where(clipped[:, None], np.float32(SATURATION), lit), clipped, seen


def test_a_spot_is_as_bright_as_its_light_says_where_next_to_nothing_of_it_is_seen(
    world: World, tmp_path: Path, angles: list[float]
):
    """Three texels, as from the side."""
    angles[0] = 60.0
    shines = (60.0, 50.0, 40.0)
    given = [*ALBEDO, (0, 0, 0), (0, 0, 0)], [(0, 0, 0)] * 6 + [LAMPS[1], shines]
    lit, clipped, seen = _with_thing_of_which_three_texels_clip(world, *given)
    light = _estimated(world, lit, clipped, tmp_path, seen=seen)
    assert light.groups.small[light.groups.object == 7].tolist() == [True]
    found = light.lit[world.texels.of_object(7)].mean(axis=0)
    assert np.abs(np.log(found / shines)).max() < 0.25


@pytest.mark.parametrize(
    ("place", "size"), [((1.2, 1.2, 2.0), 0.1), ((2.0, 1.5, 0.8), 0.2)], ids=["below", "far"]
)
def test_a_glint_is_no_spot(place: tuple[float, float, float], size: float, tmp_path: Path):
    """On a thing that is grey, below a lamp or amid the room: it clips from one side alone."""
    lamp = quad((1, 1, 2.3), (0, 0.4, 0), (0.4, 0, 0))
    knob = quad(place, (0, 0, size), (0, size, 0), size=(10, 10))
    here = world_of([*room((0, 0, 0), (4, 3, 2.5), size=(20, 20)), lamp, knob])
    given = [*ALBEDO, (0, 0, 0), (0.7, 0.7, 0.7)], [(0, 0, 0)] * 6 + [LAMPS[0], (0, 0, 0)]
    lit, clipped, seen = _with_thing_of_which_three_texels_clip(here, *given)
    light = _estimated(here, lit, clipped, tmp_path, seen=seen)
    assert light.groups.object.tolist() == [6]
    assert light.estimate.determined.tolist() == [True]


def test_light_that_did_not_clip_stays_as_it_is(world: World, truth: np.ndarray, tmp_path: Path):
    nothing = np.zeros(len(truth), bool)
    light = _estimated(world, truth, nothing, tmp_path)
    assert light.lit is truth
    assert light.least_of_lamps(np.zeros(len(truth))) == 0
    assert np.isnan(light.error_of_object(6))
    assert not light.may_shine(nothing).any()


def test_an_undetermined_lamp_stands_below_its_estimate_or_at_what_was_measured():
    # Two lamps, and a wall that may be lit so; each of two texels, brighter than the bound or not.
    group = np.repeat(np.arange(-1, 3, dtype=np.int32), 2)
    groups = ClippedGroups(
        group=group,
        object=np.arange(3, dtype=np.int32),
        bound=np.full((3, 3), 4.0, np.float32),
        lamp=np.array([True, True, False]),
        small=np.zeros(3, np.bool_),
        wall=group == 2,
    )
    estimate = EstimatedRadiance(
        multiplier=np.array([[60.0] * 3, [3.0] * 3, [60.0] * 3]),
        standard_error=np.array([[0.9] * 3, [0.9] * 3, [0.9] * 3]),
        determined=np.zeros(3, np.bool_),
    )
    # What a reflector might show too is no lamp that others are held against.
    one = replace(groups, bound=np.array([4.0, 6.0, 1.0], np.float32))
    light = ClippedLight(lit=np.zeros((8, 3), np.float32), groups=one, estimate=estimate)
    for reflected, dimmest in ((0, 4), (4, 6), (7, 0)):
        assert light.least_of_lamps(np.full(8, float(reflected))) == dimmest
    glint = replace(light, groups=replace(one, small=np.array([True, False, False])))
    assert glint.least_of_lamps(np.zeros(8)) == 6
    lit = np.tile(np.float32([[4.0] * 3, [4.5] * 3]), (4, 1))
    found = _with_estimates(lit, groups, estimate)
    expected = lit.copy()
    expected[2:4] = 4 * 60 * np.exp(-1.8)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_what_nobody_saw_of_a_lamp_shines_only_if_the_lamp_is_determined():
    groups = ClippedGroups(
        group=np.array([-1, 0, 0, 1, 1], np.int32),
        object=np.arange(2, dtype=np.int32),
        bound=np.full(2, 4.0, np.float32),
        lamp=np.ones(2, np.bool_),
        small=np.zeros(2, np.bool_),
        wall=np.zeros(5, np.bool_),
    )
    estimate = EstimatedRadiance(
        multiplier=np.full((2, 3), 9.0),
        standard_error=np.array([[0.1] * 3, [0.9] * 3]),
        determined=np.array([True, False]),
    )
    light = ClippedLight(lit=np.ones((5, 3), np.float32), groups=groups, estimate=estimate)
    clipped = np.array([False, True, False, True, False])
    np.testing.assert_array_equal(light.may_shine(clipped), [False, True, True, True, False])


class InTheSun(NamedTuple):
    """Through a hole in the ceiling the sun falls on what is below it, which clips at a tenth of
    what it sends; a lamp, the last object, that clips too and sends little. What is shown, and
    which of it clips."""

    world: World
    lit: np.ndarray
    clipped: np.ndarray
    noon: Environment

    @classmethod
    def of(cls, things: list[Part], size: tuple[int, int]) -> InTheSun:
        """A room with things that are nearly white."""
        around = [
            quad((0, 0, 2.5), (0, 3, 0), (1.7, 0, 0), size=(16, 16)),
            quad((2.3, 0, 2.5), (0, 3, 0), (1.7, 0, 0), size=(16, 16)),
            quad((1.7, 0, 2.5), (0, 1.2, 0), (0.6, 0, 0), size=(8, 8)),
            quad((1.7, 1.8, 2.5), (0, 1.2, 0), (0.6, 0, 0), size=(8, 8)),
        ]
        parts = room((0, 0, 0), (4, 3, 2.5), size=size)
        walls = [part for part in parts if not (part.points[:, 2] > 2.4).all()]
        assert len(walls) == 5
        lamp = quad((2.7, 1.1, 0.9), (0.8, 0, 0), (0, 0.8, 0))
        world = world_of([*walls, *around, *things, lamp])
        sun = Sun(np.array([0.0, 0.0, 1.0]), np.full(3, 100.0))
        noon = Environment(np.zeros((1, 1, 3), np.float32), True).under(sun)
        dark, count = [(0.0, 0.0, 0.0)], len(things)
        colours = [*ALBEDO[:5], *[(0.8, 0.8, 0.8)] * 4, *[(0.9, 0.9, 0.9)] * count, *dark]
        rng = np.random.default_rng(5)
        noise = np.exp(0.03 * rng.standard_normal((len(world.texels), 1)))
        albedo = (world.per_object(colours) * noise).astype(np.float32)
        emitted = world.per_object([*dark * (9 + count), (8.0, 8.0, 8.0)])
        true = _shone(world, albedo, emitted, 4, noon)
        clipped = (true >= SATURATION).any(axis=1)
        return cls(world, np.where(clipped[:, None], np.float32(SATURATION), true), clipped, noon)

    def estimated(self, folder: Path, said: Mapping[int, bool] = NOTHING_SAID) -> ClippedLight:
        return _estimated(self.world, self.lit, self.clipped, folder, self.noon, said)


@pytest.fixture(scope="module")
def beside_table() -> InTheSun:
    """The table is object 9, the lamp 10."""
    return InTheSun.of([quad((1.5, 1.0, 0.9), (1.0, 0, 0), (0, 1.0, 0), size=(12, 12))], (16, 16))


@pytest.mark.parametrize("said", [NOTHING_SAID, {9: False}])
def test_what_stands_in_the_sun_is_not_the_light_of_the_lamp_beside_it(
    said, beside_table: InTheSun, tmp_path: Path
):
    owner = beside_table.world.texels.object_index()
    assert set(owner[beside_table.clipped].tolist()) == {9, 10}
    light = beside_table.estimated(tmp_path, said)
    assert light.groups.object[light.groups.lamp].tolist() == [10]
    assert light.estimate.determined[light.groups.lamp].all()
    np.testing.assert_allclose(light.lit[owner == 10].mean(axis=0), 8, rtol=0.25)
    # What stands in the sun is at least as bright as where it clips, and no more is told of it.
    assert light.estimate.determined.tolist() == [True, False]
    np.testing.assert_array_equal(light.lit[owner == 9], beside_table.lit[owner == 9])


def test_where_the_sun_falls_on_a_floor_it_is_asked_with_its_bound(tmp_path: Path, monkeypatch):
    """What it reflects of the sun is reckoned, and no evidence of the lamp."""
    asked = []

    def looked_at_closely(*given):
        asked.append(given[4])
        return lamp_light.looked_at_closely(*given)

    monkeypatch.setattr(clipped_light, "looked_at_closely", looked_at_closely)
    found = InTheSun.of([], (32, 32))
    owner = found.world.texels.object_index()
    assert len(set(owner[found.clipped].tolist())) == 2
    light = found.estimated(tmp_path)
    assert light.groups.object[light.groups.lamp].tolist() == [9]
    assert asked[-1].clipped.any()
    np.testing.assert_allclose(asked[-1].reflected[asked[-1].clipped], np.pi * SATURATION)


def test_what_a_second_look_refutes_is_not_kept_and_what_it_does_not_tell_is():
    def told(multiplier, error, determined):
        return EstimatedRadiance(
            multiplier=np.repeat([multiplier], 3, axis=0).T,
            standard_error=np.repeat([error], 3, axis=0).T,
            determined=np.array(determined),
        )

    first = told([3.0, 3.0, 3.0], [0.4, 0.4, 0.4], [True, True, True])
    # Darker than its bound for sure; told by too little; told anew.
    second = told([1.0, 0.2, 5.0], [0.2, 2.0, 0.3], [False, False, True])
    both = second.else_of(first)
    assert both.determined.tolist() == [False, True, True]
    assert both.multiplier[:, 0].tolist() == [1.0, 3.0, 5.0]
    assert both.standard_error[:, 0].tolist() == [0.2, 0.4, 0.3]


def test_a_lamp_that_only_the_first_round_tells_stays_as_that_tells_it(
    beside_table: InTheSun, tmp_path: Path, monkeypatch
):
    """With what it shines on as bright as it makes that, no texel may lie evenly enough in its
    light."""
    rounds = []
    by = clipped_light._Weighing._by

    def told(self, light, groups):
        rounds.append(by(self, light, groups))
        # Of the first two the one is asked with the table as a lamp, and the other without.
        return rounds[-1] if len(rounds) < 3 else (nothing_known(len(groups)), rounds[-1][1])

    monkeypatch.setattr(clipped_light._Weighing, "_by", told)
    light = beside_table.estimated(tmp_path)
    assert len(rounds) == 3
    lamp = light.groups.lamp
    assert light.estimate.determined[lamp].all()
    np.testing.assert_array_equal(light.estimate.multiplier[lamp], rounds[1][0].multiplier[lamp])


def test_what_looks_another_way_from_each_side_is_doubted():
    plain = np.full(9, 0.05)
    np.testing.assert_allclose(doubt_by_views(np.append(plain, [0.04, 0.4])), [1] * 10 + [8])
    # Of most it may not be known, and views that hardly differ at all are as usual.
    differing = np.array([np.nan, np.nan, np.nan, 0.001, 0.02, 0.09])
    np.testing.assert_allclose(doubt_by_views(differing), [1, 1, 1, 1, 1, 3])
    assert (doubt_by_views(np.full(3, np.nan)) == 1).all()
