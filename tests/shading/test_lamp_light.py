"""Which texels tell how strong a lamp is, what each receives of it, and what is a lamp at all."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading import lamp_light, likely_lamps
from usdbrdf.shading.asked import asked_texels, first_of_segments, looked_around
from usdbrdf.shading.lamp_light import (
    Lamps,
    _evenly_lit,
    beside_lamps,
    beside_others,
    brought,
    looked_at_closely,
    shining,
    sources_of,
    without,
)
from usdbrdf.shading.likely_lamps import Beside, Likely, beside_daylight
from usdbrdf.shading.outside_light import Asked, Solution
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import TexturedScene

SIDE = 16
DARK = black_environment()


@pytest.fixture(scope="module")
def hall() -> World:
    """A floor of 2 m; a panel of 0.1 m above it and one above the side of it, which face down."""
    return world_of([
        quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), (SIDE, SIDE)),
        quad((-0.05, -0.05, 2), (0, 0.1, 0), (0.1, 0, 0), (4, 4)),
        quad((0.95, -0.05, 2), (0, 0.1, 0), (0.1, 0, 0), (4, 4)),
    ])  # fmt: skip


FLOOR = np.arange(SIDE * SIDE)


def _surface(world: World) -> TexturedScene:
    return TexturedScene(world.scene, world.texels, world.rays)


def _lamps(world: World, *numbers: int) -> Lamps:
    """Number of each object's, -1 for none."""
    count = max(numbers) + 1
    of = np.array(numbers, np.int32)[world.texels.object_index()]
    return Lamps(of, np.zeros((count, 3)), np.full(count, 3.0), np.zeros(count, np.bool_))


def _asked(texel: Any, *, segment: Any = None, clipped: Any = None, irradiance: Any = 0.0) -> Asked:
    count = len(texel)
    grey = np.ones((count, 3))
    return Asked(
        texel=texel,
        segment=np.zeros(count, np.int32) if segment is None else segment,
        owner=np.zeros(count, np.int32),
        reflected=grey,
        clipped=np.zeros(count, np.bool_) if clipped is None else clipped,
        irradiance=grey * np.asarray(irradiance).reshape(-1, 1),
        mirrored=0 * grey,
    )


def _form_factor(point: Any, centre: Any) -> Any:
    """To a panel of 0.01 m^2 that looks down: what of its radiance arrives, W/m^2."""
    way = np.array(centre) - point
    return 0.01 * way[:, 2] ** 2 / (way**2).sum(axis=1) ** 2


def test_each_lamp_brings_what_it_sends_alone(hall: World):
    texel = FLOOR[::7]
    found = brought(_surface(hall), _lamps(hall, -1, 1, 0), texel, 3)
    place = hall.texels.position[texel].astype(np.float64)
    wanted = np.array([_form_factor(place, (1, 0, 2)), _form_factor(place, (0, 0, 2))])
    np.testing.assert_allclose(found, wanted, rtol=0.03)


def test_what_lamps_bring_is_sampled_as_asked(hall: World, monkeypatch: pytest.MonkeyPatch):
    asked: list[Any] = []

    def brings(_: Any, __: Any, texel: Any, seed: int, sampling: Any) -> Any:
        asked.append((seed, sampling))
        return np.zeros(len(texel))

    monkeypatch.setattr(lamp_light, "_brought", brings)
    surface, lamps = _surface(hall), _lamps(hall, -1, 1, 0)
    brought(surface, lamps, FLOOR, 3)
    brought(surface, lamps, FLOOR, 3, lamp_light.ROUGHLY)
    closely, roughly = lamp_light.CLOSELY, lamp_light.ROUGHLY
    assert asked == [(3, closely), (4, closely), (3, roughly), (4, roughly)]


def test_without_lamps_all_else_stays(hall: World):
    lit = np.arange(3 * len(hall.texels), dtype=np.float32).reshape(-1, 3) + 1
    found = without(lit, _lamps(hall, -1, 0, -1))
    owner = hall.texels.object_index()
    np.testing.assert_array_equal(found[owner != 1], lit[owner != 1])
    np.testing.assert_array_equal(found[owner == 1], 0)


def test_texels_are_asked_with_the_light_of_all_but_the_lamps(hall: World):
    """Of the second panel's alone; and no less than a ten thousandth of what they reflect."""
    lit = np.zeros((len(hall.texels), 3), np.float32)
    owner = hall.texels.object_index()
    lit[owner == 1], lit[owner == 2] = (1000, 1000, 1000), (2, 4, 6)
    asked, lamps = _asked(FLOOR[::9])._replace(clipped=FLOOR[::9] > 99), _lamps(hall, -1, 0, -1)
    found = beside_lamps(_surface(hall), lit, DARK, asked, lamps, 1)
    place = hall.texels.position[asked.texel].astype(np.float64)
    wanted = _form_factor(place, (1, 0, 2))[:, None] * [2, 4, 6]
    np.testing.assert_allclose(found.irradiance, wanted, rtol=0.03)
    assert found.irradiance.dtype == np.float64
    for name in ("texel", "clipped", "reflected", "mirrored"):
        np.testing.assert_array_equal(getattr(found, name), getattr(asked, name))
    bright = asked._replace(reflected=asked.reflected * 100)
    found = beside_lamps(_surface(hall), lit, DARK, bright, lamps, 1)
    np.testing.assert_allclose(found.irradiance, np.maximum(wanted, 0.01), rtol=0.03)
    assert (found.irradiance == 0.01).any()


def test_lamps_are_sources_of_one_family_without_neighbours(hall: World):
    lamps, share = _lamps(hall, -1, 0, 1), np.arange(10.0).reshape(2, 5)
    found = sources_of(lamps, share)
    assert found.share is share
    assert found.mean is lamps.mean
    assert found.deviation is lamps.deviation
    assert found.family.tolist() == [1, 1]
    assert (found.pairs.shape, found.apart.shape) == ((0, 2), (0,))
    assert found.gloss == (0, 0)


def test_a_source_s_part_is_of_what_reaches_the_texels_that_it_lights(hall: World):
    """Three texels, each as much as it is lit: by source 0 the first and the second, three times
    as much; by source 1 the last one."""
    share = np.array([[1.0, 3.0, 0.0], [0.0, 0.0, 2.0]])
    sources = sources_of(_lamps(hall, -1, 0, 1), share)
    radiance = np.array([[1.0, 2.0, 3.0], [4.0, 4.0, 4.0]])
    solution = Solution(np.log(radiance), np.zeros((1, 3)), np.zeros(3), np.zeros((1, 3)))
    asked = _asked(np.arange(3), irradiance=[2.0, 4.0, 24.0])
    near, part = beside_others(asked, sources, solution)
    # Light is 2 + 2, 4 + 6 and 24 + 8.
    np.testing.assert_allclose(near, [(1 * 4 + 3 * 10) / 4, 32])
    np.testing.assert_allclose(part, [2 * (1 / 4 + 9 / 10) / 4, 4 * 4 / 32 / 2])
    dark = sources._replace(share=np.zeros((2, 3)))
    near, part = beside_others(asked, dark, solution)
    np.testing.assert_array_equal([near, part], 0)


def test_a_lamp_is_thrice_as_bright_as_a_white_wall_and_a_tenth_of_the_light():
    near, part = np.array([1.0, 1, 1, 1, 2, 2]), np.array([0.5, 0.5, 0.11, 0.1, 0.5, 0.5])
    level = np.array([3.01, 2.99, 3.01, 9, 6.01, 5.99])
    radiance = np.repeat(level[:, None], 3, axis=1) / np.pi
    found = shining(radiance, near, part)
    assert found.tolist() == [True, False, True, False, True, False]
    # Of the channels' mean.
    one = np.array([[9.1, 0, 0]]) / np.pi
    assert shining(one, near[:1], part[:1]).tolist() == [True]


def _lit_by(hall: World, monkeypatch: pytest.MonkeyPatch, bring: Any, **of_asked: Any) -> Any:
    """Which of the floor's texels lie evenly in the light that ``bring`` says each lamp brings them
    at a row and column, (texels) each."""
    asked = _asked(FLOOR, **of_asked)
    lamps = _lamps(hall, -1, 0, 1)
    surface = _surface(hall)

    def brings(_: Any, light: Any, texel: Any, seed: int, sampling: Any) -> Any:
        assert (seed, sampling) == (7, lamp_light.ROUGHLY)
        return np.asarray(bring(light, texel // SIDE, texel % SIDE), np.float64)

    monkeypatch.setattr(lamp_light.Shining, "of", lambda _, alone: int(alone[-1, 0]))
    monkeypatch.setattr(lamp_light, "_brought", brings)
    even = _evenly_lit(surface, asked, lamps, np.array([1.0, 2.0]), 7)
    return even.reshape(SIDE, SIDE)


def test_texels_within_two_of_a_shadow_s_edge_are_not_asked(
    hall: World, monkeypatch: pytest.MonkeyPatch
):
    column = np.arange(SIDE)

    def edge(light: int, _: Any, column: Any) -> Any:
        return np.where(column < 8, 1.0, 0.0) if light == 0 else 0 * column

    even = _lit_by(hall, monkeypatch, edge)
    assert (even == ((column < 6) | (column >= 10))).all()
    # A tenth of the lamps' light, of both together, is even.
    for step, passes in ((0.29, True), (0.31, False)):

        def other(light: int, row: Any, column: Any, step: float = step) -> Any:
            return np.where(column < 8, 1.0, 1 - (0, step / 2)[light])

        even = _lit_by(hall, monkeypatch, other)
        assert even[:, 7].all() == passes
        assert even[:, 5].all()
    # And a twentieth of other light: in the shadow of all there is, in the light of what is left.
    for known, passes in ((17.9, [False, False]), (18.1, [True, False]), (20.1, [True, True])):
        even = _lit_by(hall, monkeypatch, edge, irradiance=[known])
        assert even[:, 7:9].all(axis=0).tolist() == even[:, 7:9].any(axis=0).tolist() == passes


def test_segments_of_which_few_lie_evenly_leave_unless_too_few_stay(
    hall: World, monkeypatch: pytest.MonkeyPatch
):
    def edge(light: int, _: Any, column: Any) -> Any:
        return np.where(column < 8, 1.0, 0.0) if light == 0 else 0 * column

    # Of 15 texels in columns 0 to 5 and 10 to 15 a segment of its own.
    alone = np.isin(FLOOR, FLOOR[FLOOR % SIDE < 6][:15])
    for clips, stays in ((0, True), (1, False)):
        clipped = np.isin(FLOOR, FLOOR[alone][:clips])
        even = _lit_by(hall, monkeypatch, edge, segment=alone.astype(np.int32), clipped=clipped)
        assert even.ravel()[alone].all() == stays
        assert even.ravel()[alone].any() == stays
        assert even[:, 10:].all()

    # One of which all lie at the edge, after which none is counted.
    at_edge = (FLOOR % SIDE >= 6) & (FLOOR % SIDE < 10)
    even = _lit_by(hall, monkeypatch, edge, segment=at_edge.astype(np.int32))
    assert (even.ravel() == ~at_edge).all()

    def stripes(share: int) -> Any:
        return lambda light, _, column: np.where(column < share, 1.0, column * 5.0 * (1 - light))

    # Columns 0 and 1 of 16 are less than a fifth, 0 to 3 are more.
    assert _lit_by(hall, monkeypatch, stripes(4)).all()
    found = _lit_by(hall, monkeypatch, stripes(6))
    assert found.any(axis=0).tolist() == [True] * 4 + [False] * 12


def test_the_first_of_segments_are_the_first_in_rank():
    rank, segment = np.array([5, 3, 0, 1, 4, 2]), np.array([0, 1, 0, 2, 1, 0], np.int32)
    assert first_of_segments(rank, segment, np.array([0, 1]), 2).tolist() == [5, 0, 1, 4]
    assert first_of_segments(rank, segment, np.array([2, 0]), 1).tolist() == [5, 3]
    assert first_of_segments(rank, segment, np.array([7]), 2).tolist() == []


def test_of_large_segments_that_frames_measured_some_texels_are_asked(hall: World):
    """The floor, but not panels of sixteen texels; nor where it is dark, unseen or at a rim."""
    texels, count = hall.texels, len(hall.texels)
    lit = np.tile(np.float32([0.1, 0.2, 0.3]), (count, 1))
    lit[5, 1] = 0
    clipped, observed = np.zeros(count, np.bool_), np.ones(count, np.bool_)
    observed[7], clipped[10:40] = False, True
    found = asked_texels(texels, lit, CoverageMap.of(observed & ~clipped, clipped), 1, most=1000)
    assert found is not None
    usable = texels.interior[: SIDE * SIDE].copy()
    usable[[5, 7]] = False
    assert sorted(found.texel.tolist()) == np.flatnonzero(usable).tolist()
    assert set(found.segment.tolist()) == set(found.owner.tolist()) == {0}
    np.testing.assert_allclose(found.reflected, np.tile(np.pi * lit[:1], (len(found.texel), 1)))
    np.testing.assert_array_equal(found.clipped, (found.texel >= 10) & (found.texel < 40))
    assert not found.irradiance.any()
    assert not found.mirrored.any()
    few = asked_texels(texels, lit, CoverageMap.of(observed, ~observed), 1, most=50)
    assert few is not None
    assert len(few.texel) == 50
    other = asked_texels(texels, lit, CoverageMap.of(observed, ~observed), 2, most=50)
    assert other is not None
    assert set(other.texel) != set(few.texel)
    # Fewer than thirty, or less than half of a segment, tell nothing.
    for measured, known in ((29, False), (30, True)):
        seen = np.zeros(count, np.bool_)
        seen[np.flatnonzero(texels.interior)[:measured]] = True
        told = asked_texels(texels, lit + 0.1, CoverageMap.of(seen, ~seen & False), 1)
        assert (told is not None) == known
    inside = np.flatnonzero(texels.interior[: SIDE * SIDE])
    for share, known in ((0.45, False), (0.55, True)):
        seen = np.isin(np.arange(count), inside[: int(share * len(inside))])
        clips = np.isin(np.arange(count), inside) & ~seen
        told = asked_texels(texels, lit + 0.1, CoverageMap.of(seen, clips), 1)
        assert (told is not None) == known


def test_rays_from_a_floor_meet_what_is_above_it(hall: World):
    index = FLOOR[:40]
    towards, face = looked_around(_surface(hall), index, 5, 50)
    assert towards.shape == (2000, 3)
    # Of a cosine distribution the mean cosine is 2 / 3, its deviation the root of 1 / 18.
    assert abs(towards[:, 2].mean() - 2 / 3) < 4 / np.sqrt(18 * 2000)
    assert set(np.unique(face)) <= {-1, 2, 3, 4, 5}
    # One of each after the other.
    origin = np.tile(hall.texels.position[index], (50, 1)) + 1e-3 * towards
    np.testing.assert_array_equal(hall.rays.closest(origin, towards).face, face)


def test_what_lights_a_scan_beside_daylight_is_asked_of_texels_that_do_not_clip_for_a_lamp(
    hall: World, monkeypatch: pytest.MonkeyPatch
):
    """Of three parts that clip the first and the last may be lamps."""
    surface, count = _surface(hall), len(hall.texels)
    lit = np.ones((count, 3), np.float32)
    seen = hall.texels.object_index() != 2
    coverage, said = CoverageMap.of(seen, ~seen & False), {1: True}
    part = np.where(np.arange(count) < 30, np.arange(count) // 10, -1)

    def texels_of(which: Any) -> Any:
        return (part >= 0) & np.asarray(which)[part]

    groups = SimpleNamespace(lamp=np.array([True, False, True]), texels_of=texels_of)
    given: list[Any] = []
    found = Likely(np.array([2]), np.zeros((1, 3)), np.array([0, 2]))
    monkeypatch.setattr(likely_lamps, "clipped_groups", lambda *of: given.append(of) or groups)
    monkeypatch.setattr(likely_lamps, "likely_lamps", lambda *of: given.append(of) or found)
    asked = _asked(FLOOR[5:100])
    beside = beside_daylight(surface, lit, coverage, DARK, asked, 9, said)
    assert given[0] == (hall.texels, lit, coverage, said)
    its_surface, its_lit, environment, its_asked, unseen, its_groups, its_said, seed = given[1]
    assert (its_surface, its_lit, environment) == (surface, lit, DARK)
    assert its_asked.texel.tolist() == [*range(10, 20), *range(30, 100)]
    assert unseen.tolist() == [2]
    assert (its_groups, its_said, seed) == (groups, said, 9)
    assert beside == Beside(found, groups, said)  # type: ignore[arg-type]
    assert beside.count == 3
    told = []
    monkeypatch.setattr(Likely, "as_lamps", lambda *of: told.append(of))
    beside.lamps(hall.texels)
    assert told == [(found, hall.texels, groups, said)]
    none = beside.of(np.array([False]))
    assert (none.likely.object.tolist(), none.likely.clipped.tolist()) == ([], [0, 2])
    assert none.count == 2


def test_lamps_are_looked_at_closely_where_they_light_evenly(
    hall: World, monkeypatch: pytest.MonkeyPatch
):
    """Every other texel, with what is mirrored to frames of all but the lamps, and of each lamp
    alone from surface to surface."""
    surface, lamps = _surface(hall), _lamps(hall, -1, 0, 1)
    lit = np.ones((len(hall.texels), 3), np.float32)
    asked, even = _asked(FLOOR[:40]), np.arange(40) % 2 == 0
    told: dict[str, Any] = {}
    monkeypatch.setattr(lamp_light, "beside_lamps", lambda *of: told.update(beside=of) or asked)
    monkeypatch.setattr(lamp_light, "_evenly_lit", lambda *of: told.update(even=of) or even)
    share = np.ones((2, 20))
    monkeypatch.setattr(lamp_light, "brought", lambda *of: told.update(brought=of) or share)

    def to_frames(*of: Any) -> Any:
        told["frames"] = of
        return np.full((20, 3), 0.25)

    def sent_on(of: Any, light: Any, texel: Any, seed: int) -> Any:
        told.setdefault("sent", []).append((light, seed))
        assert of is surface
        return np.repeat(texel[:, None], 3, axis=1) * (1.0 + light[-1, 0])

    monkeypatch.setattr(lamp_light, "mirrored_to_frames", to_frames)
    monkeypatch.setattr(lamp_light, "mirrored_irradiance", sent_on)
    monkeypatch.setattr(lamp_light, "gloss_of_scene", lambda *of: told.update(gloss=of) or "glossy")
    monkeypatch.setattr(lamp_light, "strengths", lambda *of: of)
    frames: Any = object()
    strength = np.array([1.0, 2.0])
    found = looked_at_closely(surface, lit, DARK, frames, asked, lamps, strength, 5)
    assert told["beside"] == (surface, lit, DARK, asked, lamps, 5)
    assert told["even"] == (surface, asked, lamps, strength, 5)
    its_asked, its_sources, certain, start = found
    np.testing.assert_allclose(start, np.log([[1.0] * 3, [2.0] * 3]))
    texel = FLOOR[:40:2]
    np.testing.assert_array_equal(its_asked.texel, texel)
    np.testing.assert_allclose(its_asked.mirrored, np.pi / 4)
    assert (its_sources, certain is lamps.certain) == ("glossy", True)
    gloss_asked, sources, through, also = told["gloss"]
    assert also is start
    assert gloss_asked is its_asked
    assert sources.share is share
    np.testing.assert_array_equal(through, np.stack([texel, 2 * texel]))
    # Other rays than those that told which lie evenly, and others for each lamp.
    rest = told["frames"]
    assert (rest[0], rest[2], rest[3]) == (surface, DARK, frames)
    np.testing.assert_array_equal(rest[1], without(lit, lamps))
    own = rest[5]
    assert own == told["brought"][3] == 5 ^ 0x1A3
    assert [seed for _, seed in told["sent"]] == [own, own + 1]


def test_strengths_are_those_that_explain_most_and_their_errors_the_largest_channel_s(
    hall: World, monkeypatch: pytest.MonkeyPatch
):
    solution = Solution(
        np.log([[2.0, 3, 4], [5, 6, 7]]), np.zeros((1, 3)), np.zeros(3), np.zeros((1, 3))
    )
    monkeypatch.setattr(lamp_light, "likeliest", lambda *_: solution)
    monkeypatch.setattr(lamp_light, "jackknife", lambda *_: np.array([[0.3, 0, 0], [0, 0, 0.5]]))
    monkeypatch.setattr(lamp_light, "pull_of_prior", lambda *_: np.array([[0.4, 0, 0], [0.0] * 3]))
    lamps = _lamps(hall, -1, 0, 1)
    sources = sources_of(lamps, np.ones((2, 4)))
    found = lamp_light.strengths(_asked(np.arange(4), irradiance=[1.0]), sources, lamps.certain)
    np.testing.assert_allclose(found.radiance, [[2, 3, 4], [5, 6, 7]])
    np.testing.assert_allclose(found.error, [0.5, 0.5])
    np.testing.assert_allclose(found.near, 1 + 3 + 6)
    np.testing.assert_allclose(found.part, [3 / 10, 6 / 10])
