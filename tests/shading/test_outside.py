"""The light from outside of a yard whose sun and sky are known, from what its surfaces reflect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import Sampling, box, quad, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading import outside, sky_patches
from usdbrdf.shading.asked import Shining, asked_texels, irradiance_of_texels
from usdbrdf.shading.outside import Outside, _sun_shines, _Told, light_from_outside
from usdbrdf.shading.outside_light import Asked, Solution, Sources
from usdbrdf.shading.sun_direction import with_disc
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings
from usdbrdf.shading.unseen_lamps import lamps_that_explain
from usdbrdf.texturing.footprints import blurred
from usdbrdf.transport.environment import (
    NO_SUN,
    Environment,
    Sun,
    directions_of_pixels,
    solid_angles,
)
from usdbrdf.transport.irradiance import independent_tiles, irradiance_at
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlight

TOWARDS = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])
SUN = Sun(TOWARDS, np.array([12.0, 9.0, 5.0]))
# Brighter at the horizon.
_UP = directions_of_pixels(HEIGHT, WIDTH, True)[..., 2]
SKY = (np.float32([0.6, 0.8, 1.0]) * (1.5 - np.clip(_UP, 0, 1))[..., None]).astype(np.float32)
SKY[_UP < 0] = 0.2

FRAMES = frames_at(
    [
        look_at(np.array([4.0, -3.0, 2.5]), np.array([x, y, 0.5]))
        for x, y in ((1, 6), (4, 6), (7, 6), (4, 2))
    ]
)


@pytest.fixture(scope="module")
def yard():
    """A yard of 8 m with walls on three sides and two blocks in it."""
    return _yard([])


# A panel of a square metre over the yard that looks down, and two boards beside it.
PANEL = 14
HUNG = [
    quad((x, y, 3.5), (0, 1, 0), (1, 0, 0), (6, 6)) for x, y in ((2.0, 5.0), (6.0, 5.5), (5.0, 1.0))
]


def _yard(hung: list):
    return world_of([
        quad((0, 0, 0), (8, 0, 0), (0, 8, 0), (80, 80)),
        quad((0, 8, 0), (8, 0, 0), (0, 0, 3), (60, 24)),
        quad((0, 0, 0), (0, 8, 0), (0, 0, 3), (60, 24)),
        quad((8, 0, 0), (0, 0, 3), (0, 8, 0), (24, 60)),
        *box((3, 3, 0.01), (4, 4.5, 1.5), (24, 24)),
        *box((5.5, 1.5, 0.01), (6.3, 2.3, 2.2), (24, 24)),
        *hung,
    ])  # fmt: skip


def _lit(world, environment: Environment, texture: float = 0.25, panel: float = 0.0):
    """L_d (T, 3) with light going to and fro three times, and the albedo (T, 3). panel: radiance of
    the object of this number."""
    surface, texels = TexturedScene(world.scene, world.texels, world.rays), world.texels
    random = np.random.default_rng(1)
    usual = random.uniform(0.15, 0.7, (len(texels.resolution), 3))[texels.object_index()]
    albedo = usual * np.exp(texture * random.standard_normal((len(texels), 1)))
    albedo = np.minimum(albedo, 0.95)
    every, lit = np.arange(len(texels)), np.zeros((len(texels), 3), np.float32)
    direct = sunlight(surface, every, environment.sun, 5)
    shines = (texels.object_index() == PANEL) & (panel > 0)
    for _ in range(3):
        lit[shines] = panel
        arriving = irradiance_at(
            surface.rays, surface.texture(lit), lights_from_radiance(world.scene, texels, lit),
            environment, texels.position, texels.normal, independent_tiles(len(texels)),
            Sampling(standard_error=0.02, max_rays=512), surface.diagonal_m,
        ).mean  # fmt: skip
        lit = (albedo / np.pi * (arriving + direct)).astype(np.float32)
    lit[shines] = panel
    return surface, lit, albedo


@pytest.fixture(scope="module")
def sunny(yard):
    """What ``_lit`` gives of the yard under sun and sky."""
    return _lit(yard, Environment(SKY, True).under(SUN))


def _seen(which) -> Surroundings:
    """The directions ``which`` (H, W) of SKY."""
    radiance = np.where(which[..., None], SKY, 0).reshape(-1, 3)
    none = 0 * which.ravel() > 0
    return Surroundings(radiance=radiance, coverage=CoverageMap.of(which.ravel(), none), dark=none)


def _of_upper_half(image) -> np.ndarray:
    """(3,) what the sky brings to the ground, W/m^2."""
    weight = solid_angles(HEIGHT, WIDTH)[:, None] * np.maximum(_UP, 0)
    return (image * weight[..., None]).sum(axis=(0, 1))


@pytest.mark.parametrize("clips", [False, True])
def test_sun_and_sky_are_found_by_the_light_that_they_cast(sunny, clips: bool):
    surface, lit, _ = sunny
    saturation = float(np.quantile(lit.max(axis=1), 0.85)) if clips else np.inf
    clipped = lit.max(axis=1) > saturation
    shown = np.where(clipped[:, None], saturation, lit).astype(np.float32)
    # A camera that looked north, not up.
    directions = directions_of_pixels(HEIGHT, WIDTH, True)
    seen = _seen((directions[..., 1] > 0.5) & (np.abs(directions[..., 2]) < 0.3))
    found = light_from_outside(
        surface, shown, CoverageMap.of(~clipped, clipped), seen, True, seed=3
    )
    assert found is not None
    sun = found.environment.sun
    assert np.degrees(np.arccos(sun.direction @ TOWARDS)) < 1
    # Of the channels that do not clip first the sunlit texels say little: there sun and sky mix.
    told = slice(0, 1) if clips else slice(0, 3)
    np.testing.assert_allclose(sun.irradiance[told], SUN.irradiance[told], rtol=0.25)
    assert found.sun_error < 0.4
    sky, true_sky = _of_upper_half(found.environment.image), _of_upper_half(SKY)
    np.testing.assert_allclose(sky[told], true_sky[told], rtol=0.5 if clips else 0.35)
    # What was seen stays what it was.
    known = seen.coverage.measured.reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(found.environment.image[known], SKY[known])
    np.testing.assert_array_equal(found.confidence, known.astype(np.float32))
    assert 0.2 < found.open_share < 0.7


@pytest.mark.parametrize(
    ("strength", "error", "shines"),
    [(10.0, 0.9, True), (10.0, 1.5, False), (0.5, 0.9, False), (0.5, 0.45, True)],
)
def test_a_strong_sun_need_not_be_known_as_well_as_a_weak_one(strength, error, shines):
    # On a half of the texels, beside light of 1 from elsewhere.
    number, ones = 80, np.ones((80, 3))
    asked = Asked(
        texel=np.arange(number),
        segment=np.zeros(number, np.int32),
        owner=np.zeros(number, np.int32),
        reflected=ones,
        clipped=np.zeros(number, np.bool_),
        irradiance=ones,
        mirrored=0 * ones,
    )
    share = np.repeat([0.0, 1.0], number // 2)[None]
    sources = Sources(
        share=share,
        mean=np.zeros((1, 3)),
        deviation=np.ones(1),
        family=np.zeros(1, np.int64),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
    )
    found = Solution(
        np.full((1, 3), np.log(strength)), np.zeros((1, 3)), np.zeros(3), np.zeros((1, 3))
    )
    in_shade = sources._replace(share=share[:0], mean=np.zeros((0, 3)))
    told = _Told(asked, in_shade, SUN, (asked, sources), found)
    assert _sun_shines(told, np.full((1, 3), error)) == shines


def test_what_surfaces_mirror_is_not_taken_for_light_in_their_shadows(sunny):
    surface, lit, albedo = sunny
    # From everywhere the same light, next to which what shadows scatter is little.
    sheen = 0.04 * np.median(lit, axis=0)
    owner = surface.texels.object_index()
    usual = np.bincount(owner, albedo.mean(axis=1)) / np.bincount(owner)
    sheen = np.pi * np.where(usual < 0.45, 1.0, 0.5)[owner, None] * 8 * sheen
    every = np.ones(len(lit), np.bool_)
    shown = lit + (sheen / np.pi).astype(np.float32)
    seen = _seen(np.abs(_UP) < 0.3)

    def off(mirrored=None) -> float:
        found = light_from_outside(
            surface, shown, CoverageMap.of(every, ~every), seen, True, 3, mirrored
        )
        assert found is not None
        sun = found.environment.sun.irradiance / SUN.irradiance
        sky = _of_upper_half(found.environment.image) / _of_upper_half(SKY)
        return float(np.abs(sun / sky - 1).mean())  # next to nothing tells the level

    asked_about = []

    def mirrored(outside: Environment, index: np.ndarray) -> np.ndarray:
        asked_about.append(outside)
        return sheen[index]

    assert off(mirrored) < 0.6 * off()
    # It follows from the light that was found before, sun and all.
    assert len(asked_about) >= 2
    assert all(outside.sun.irradiance.min() > 1 for outside in asked_about)
    assert np.abs(asked_about[1].sun.irradiance - asked_about[0].sun.irradiance).max() > 0


@pytest.fixture(scope="module")
def evening():
    """The yard with a panel and two boards hung over it, in a weak sky without sun; the panel
    shines or does not."""
    found = {}
    for panel in (15.0, 0.0):
        world = _yard(HUNG)
        found[panel] = _lit(world, Environment(SKY / 4, True), texture=0.1, panel=panel)[:2]
    return found


def _without_hung(surface: TexturedScene, lit):
    """What frames show of ``lit``: not what hangs there; and some of the sky."""
    hung = surface.texels.object_index() >= PANEL
    shown = np.where(hung[:, None], np.median(lit[~hung], axis=0), lit).astype(np.float32)
    north = directions_of_pixels(HEIGHT, WIDTH, True)[..., 1] > 0.5
    seen = _seen(north & (_UP > 0) & (_UP < 0.5))
    coverage = CoverageMap.of(~hung, 0 * hung > 0)
    return shown, coverage, replace(seen, radiance=seen.radiance / 4)


@pytest.mark.parametrize("panel", [15.0, 0.0])
def test_a_lamp_that_no_frame_shows_is_told_from_the_sky_beside_it(evening, panel: float):
    surface, lit = evening[panel]
    shown, coverage, seen = _without_hung(surface, lit)
    found = light_from_outside(surface, shown, coverage, seen, True, 0)
    assert found is not None
    assert found.lamps.tolist() == [PANEL] * (panel > 0)
    sky, true_sky = _of_upper_half(found.environment.image), _of_upper_half(SKY / 4)
    np.testing.assert_allclose(sky, true_sky, rtol=0.35)
    lamps = lamps_that_explain(
        surface, shown, coverage, FRAMES, found.environment, 0, dict.fromkeys(found.lamps, True)
    )
    assert lamps.object.tolist() == found.lamps.tolist()
    np.testing.assert_allclose(lamps.radiance, panel, rtol=0.25)


def test_a_lamp_beside_daylight_of_which_hardly_the_order_is_known_is_none(evening, monkeypatch):
    surface, lit = evening[15.0]
    given = surface, *_without_hung(surface, lit), True, 0
    monkeypatch.setattr("usdbrdf.shading.outside.MOST_OF_CERTAIN", 0.0)
    found = light_from_outside(*given)
    assert found is not None
    assert not len(found.lamps)


def test_no_sun_is_found_where_none_shines(yard):
    surface, lit, _ = _lit(yard, Environment(SKY, True))
    every = np.ones(len(lit), np.bool_)
    found = light_from_outside(
        surface, lit, CoverageMap.of(every, ~every), _seen(_UP > 0.9), True, seed=3
    )
    assert found is not None
    sun = _of_upper_half(found.environment.image)
    assert (
        not found.environment.sun.shines
        or (found.environment.sun.irradiance * TOWARDS[2] < 0.1 * sun).all()
    )
    np.testing.assert_allclose(sun, _of_upper_half(SKY), rtol=0.35)


@pytest.fixture(scope="module")
def sun_alone(yard):
    """The yard under a black sky."""
    return _lit(yard, Environment(0 * SKY, True).under(SUN))


@pytest.mark.parametrize(("stars", "night"), [(0.0, True), (0.005, True), (0.03, False)])
def test_where_next_to_nothing_shines_the_rest_is_dark_too(sun_alone, stars: float, night: bool):
    surface, lit, _ = sun_alone
    looked_at = _seen(_UP < 0.3)
    shines = np.random.default_rng(1).random(looked_at.dark.shape) < stars
    dark = looked_at.coverage.measured & ~shines
    radiance = np.where(dark[:, None], np.float32(1e-3), looked_at.radiance)
    seen = replace(looked_at, radiance=radiance, dark=dark)
    every = np.ones(len(lit), np.bool_)
    found = light_from_outside(surface, lit, CoverageMap.of(every, ~every), seen, True, seed=3)
    assert found is not None
    unseen = ~looked_at.coverage.measured.reshape(HEIGHT, WIDTH)
    assert (found.environment.image[unseen].max() < 0.01) == night
    known = found.environment.image[~unseen]
    np.testing.assert_array_equal(known, radiance.reshape(HEIGHT, WIDTH, 3)[~unseen])


def test_a_closed_room_has_no_light_from_outside(yard):
    roof = quad((0, 0, 3), (0, 8, 0), (8, 0, 0))
    south = quad((0, 0, 0), (0, 0, 3), (8, 0, 0))
    closed = world_of([quad((0, 0, 0), (8, 0, 0), (0, 8, 0), (40, 40)), roof, south,
                       quad((0, 8, 0), (8, 0, 0), (0, 0, 3)), quad((0, 0, 0), (0, 8, 0), (0, 0, 3)),
                       quad((8, 0, 0), (0, 0, 3), (0, 8, 0))])  # fmt: skip
    lit = np.ones((len(closed.texels), 3), np.float32)
    every = np.ones(len(lit), np.bool_)
    surface = TexturedScene(closed.scene, closed.texels, closed.rays)
    found = light_from_outside(
        surface, lit, CoverageMap.of(every, ~every), Surroundings.unseen(), True, seed=3
    )
    assert found is None


def test_what_is_found_is_kept_as_it_is():
    given = Outside(
        environment=Environment(SKY, True).under(SUN),
        confidence=_UP.astype(np.float32),
        open_share=0.5,
    )
    same = Outside.restored(given.arrays())
    assert same.environment.sun.half_angle == SUN.half_angle
    assert same.environment.z_up
    np.testing.assert_array_equal(same.environment.sun.irradiance, SUN.irradiance)
    np.testing.assert_array_equal(same.environment.image, SKY)
    assert same.open_share == 0.5
    assert np.isnan(same.sun_error)
    assert not Outside.given(Environment(SKY, True).under(NO_SUN)).environment.sun.shines
    # Of what is inferred the worse is doubted, and no more than all of it.
    assert (given.doubt, replace(given, sky_error=0.2).doubt) == (0, 0.2)
    assert replace(given, sky_error=0.2, sun_error=0.4).doubt == 0.4


def test_a_lone_object_in_the_open_gets_light_that_lets_nothing_reflect_too_much():
    lone = world_of(box((0, 0, 0), (1, 1, 1), (16, 16)))
    surface, lit, _ = _lit(lone, Environment(SKY, True))
    every = np.ones(len(lit), np.bool_)
    coverage = CoverageMap.of(every, ~every)
    found = light_from_outside(surface, lit, coverage, Surroundings.unseen(), True, seed=3)
    assert found is not None
    arriving = irradiance_at(
        surface.rays, surface.texture(lit), lights_from_radiance(lone.scene, lone.texels, lit),
        found.environment, lone.texels.position, lone.texels.normal,
        independent_tiles(len(lit)), Sampling(standard_error=0.02, max_rays=512),
        surface.diagonal_m,
    ).mean  # fmt: skip
    albedo = np.pi * lit / np.maximum(arriving, 1e-6)
    assert (albedo > 1).any(axis=1).mean() < 0.03
    # Not black either.
    assert 0.1 < np.median(albedo) < 0.7


@pytest.mark.nightly
@pytest.mark.parametrize("daylight", [0.0, 40.0])
def test_a_sky_behind_a_slit_is_believed_in_where_its_light_is_seen(daylight: float):
    # A hall with a lamp, and a slit under its ceiling that no frame looks through.
    lamp = 9
    hall = world_of([
        quad((0, 0, 0), (6, 0, 0), (0, 5, 0), (60, 50)),
        quad((0, 5, 0), (6, 0, 0), (0, 0, 3), (48, 24)),
        quad((0, 0, 0), (0, 5, 0), (0, 0, 3), (40, 24)),
        quad((6, 0, 0), (0, 0, 3), (0, 5, 0), (24, 40)),
        quad((0, 0, 0), (0, 0, 3), (6, 0, 0), (24, 48)),
        quad((0, 0, 3), (0, 4.5, 0), (6, 0, 0), (30, 36)),
        quad((0, 4.9, 3), (0, 0.1, 0), (6, 0, 0), (2, 36)),
        *box((1, 1, 0.01), (2, 2, 1.2), (20, 20))[:2],
        quad((4, 1, 2.9), (0, 1, 0), (1, 0, 0), (8, 8)),
    ])  # fmt: skip
    sky = np.full((HEIGHT, WIDTH, 3), daylight, np.float32)
    surface, texels = TexturedScene(hall.scene, hall.texels, hall.rays), hall.texels
    owner = texels.object_index()
    albedo = np.random.default_rng(7).uniform(0.2, 0.7, (len(texels.resolution), 3))[owner]
    lit = np.zeros((len(texels), 3), np.float32)
    for _ in range(4):
        lit[owner == lamp] = 20.0
        arriving = irradiance_at(
            surface.rays, surface.texture(lit), lights_from_radiance(hall.scene, texels, lit),
            Environment(sky, True), texels.position, texels.normal, independent_tiles(len(texels)),
            Sampling(standard_error=0.05, max_rays=128), surface.diagonal_m,
        ).mean  # fmt: skip
        lit = (albedo / np.pi * arriving).astype(np.float32)
    lit[owner == lamp] = 20.0
    nothing = np.zeros((HEIGHT, WIDTH), np.bool_)
    every = np.ones(len(lit), np.bool_)
    found = light_from_outside(surface, lit, CoverageMap.of(every, ~every), _seen(nothing), True, 0)
    if found is None:
        assert daylight == 0
        return
    brought = irradiance_at(
        surface.rays, surface.texture(np.zeros_like(lit)),
        lights_from_radiance(hall.scene, texels, np.zeros_like(lit)), found.environment,
        texels.position, texels.normal, independent_tiles(len(texels)),
        Sampling(standard_error=0.05, max_rays=256), surface.diagonal_m,
    ).mean  # fmt: skip
    share = float(brought.sum() / arriving.sum())
    assert share < 0.02 if daylight == 0 else share > 0.1


def test_the_ground_beyond_may_be_darker_than_the_sky_over_it(yard, monkeypatch):
    """Frames show some of the sky; of the ground before the open side there is only its light."""
    dark = np.array(SKY)
    dark[_UP < 0] = 0.005
    surface, lit, _ = _lit(yard, Environment(dark, True), texture=0.05)
    every = CoverageMap.of(np.ones(len(lit), bool), np.zeros(len(lit), bool))
    before = directions_of_pixels(HEIGHT, WIDTH, True)[..., 1] < -0.7

    def of_sky() -> float:
        """How bright the ground is found."""
        found = light_from_outside(surface, lit, every, _seen(_UP > 0.4), True, 0)
        assert found is not None
        image = found.environment.image
        ground, sky = (
            np.median(image[part & before])
            for part in ((_UP < 0) & (_UP > -0.3), (_UP > 0) & (_UP < 0.2))
        )
        return float(ground / sky)

    found = of_sky()
    monkeypatch.setattr(sky_patches, "_ALIKE_OVER_HORIZON", sky_patches._ALIKE)
    assert found < 0.25
    assert found < 0.5 * of_sky()


def _pergola(slat: float):
    """A yard of 6 m with walls on two sides, and slats above it, as wide as the gaps between."""
    slats = [quad((0, y, 2.2), (6, 0, 0), (0, slat, 0), (24, 2)) for y in np.arange(0, 6, 2 * slat)]
    return world_of([
        quad((0, 0, 0), (6, 0, 0), (0, 6, 0), (72, 72)),
        quad((0, 6, 0), (6, 0, 0), (0, 0, 2), (60, 20)),
        quad((0, 0, 0), (0, 6, 0), (0, 0, 2), (60, 20)),
        *box((3, 3, 0.01), (4, 4.5, 1.0), (24, 24)),
        *slats,
    ])  # fmt: skip


def _under_stripes(slat: float) -> tuple[Outside, np.ndarray]:
    """What is found where pixels blur the shadows of such slats, and how many times as bright as it
    is the sky becomes around the sun, (3,)."""
    world = _pergola(slat)
    surface, lit, _ = _lit(world, Environment(SKY, True).under(SUN), texture=0.05)
    texels = surface.texels
    pixels = np.tile(np.float32([0.7, 0, 0.7]), (len(texels), 1))
    shown = blurred(texels, lit, pixels)
    every = np.ones(len(lit), np.bool_)
    # All of the sky but what lies within 25 degrees of the sun.
    seen = _seen(directions_of_pixels(HEIGHT, WIDTH, True) @ TOWARDS < np.cos(np.radians(25)))
    found = light_from_outside(surface, shown, CoverageMap.of(every, ~every), seen, True, seed=3)
    assert found is not None
    unseen = ~seen.coverage.measured.reshape(HEIGHT, WIDTH) & (_UP > 0)
    around = found.environment.image[unseen].mean(axis=0) / SKY[unseen].mean(axis=0)
    return found, around


def test_stripes_of_shadow_that_pixels_blur_are_not_taken_for_light_around_the_sun():
    found, around = _under_stripes(0.42)
    assert (around < 2.5).all()
    np.testing.assert_allclose(found.environment.sun.irradiance, SUN.irradiance, rtol=0.15)


def test_where_pixels_mix_all_stripes_of_shadow_their_means_tell_the_sun(monkeypatch):
    monkeypatch.setattr(outside, "_clear_of_shadows", lambda *_: None)
    found, _ = _under_stripes(0.21)
    np.testing.assert_allclose(found.environment.sun.irradiance, SUN.irradiance, rtol=0.15)
    # All texels by themselves tell half of it.
    monkeypatch.setattr(outside, "_as_pixels_mix", lambda *_: None)
    found, _ = _under_stripes(0.21)
    assert (found.environment.sun.irradiance < 0.6 * SUN.irradiance).all()


@pytest.mark.parametrize("half_angle", [0.00465, 0.035])
def test_half_shadows_tell_how_wide_the_sun_is(half_angle: float):
    """And where it stands, from a direction that is off by more than its disc."""
    surface, lit, _ = _lit(
        _pergola(0.3), Environment(SKY, True).under(SUN._replace(half_angle=half_angle)), 0.05
    )
    texels = surface.texels
    lit = blurred(texels, lit, np.tile(np.float32([0.5, 0, 0.5]), (len(texels), 1)))
    every = np.ones(len(lit), np.bool_)
    asked = asked_texels(texels, lit, CoverageMap.of(every, ~every), 1)
    assert asked is not None
    in_shadow = irradiance_of_texels(
        surface, Shining.of(surface, lit, Environment(SKY, True)), Environment(SKY, True),
        asked.texel, 2,
    )  # fmt: skip
    off = SUN._replace(direction=_turned(TOWARDS, 0.01), irradiance=0.7 * SUN.irradiance)
    found = with_disc(surface, asked, in_shadow.astype(np.float64), off, 3)
    assert found.direction @ TOWARDS > np.cos(np.radians(0.3))
    assert 0.6 < found.half_angle / half_angle < 1.6


def _turned(direction: np.ndarray, angle: float) -> np.ndarray:
    across = np.cross(direction, [0, 0, 1])
    turned = direction + angle * across / np.linalg.norm(across)
    return turned / np.linalg.norm(turned)


def test_means_keep_to_the_wall_where_another_lies_beside_it_in_the_atlas():
    """Own UVs may have two charts so near that means reach over the gap."""
    one, other = quad((0, 0, 0), (2, 0, 0), (0, 2, 0)), quad((9, 0, 3), (2, 0, 0), (0, 2, 0))
    both = replace(
        one,
        points=np.concatenate([one.points, other.points]),
        triangles=np.concatenate([one.triangles, other.triangles + len(one.points)]),
        uv=np.concatenate([one.uv * (18 / 40, 1), (22 / 40, 0) + other.uv * (18 / 40, 1)]),
        normals=np.concatenate([one.normals, other.normals]),
        size=(40, 20),
    )
    texels = world_of([both]).texels
    every = np.arange(len(texels))
    left = texels.position[:, 0] < 5
    for right in (-4, -2, 2, 4):
        beside, there = texels.beside_on_surface(every, right, 0)
        np.testing.assert_array_equal(left[beside[there]], left[there])
        # All but the columns at the end of each.
        assert there.sum() == 2 * 20 * (19 - abs(right))
