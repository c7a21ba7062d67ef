"""How fine the texels of a capture are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import look_at
from usdbrdf.files.frames import FramePixels
from usdbrdf.geometry.unwrap import TexelSizes
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.texel_density import (
    at_most,
    finer_where_patterned,
    frames_for_patterns,
    points_of_patterns,
    texel_sizes_from_frames,
)

WIDTH, HEIGHT = 80, 60
LENS = np.array([80.0, 80, 40, 30])
Shade = Callable[[Double, int], Double]


def _frames(poses: list[Double]) -> Frames:
    count = len(poses)
    return Frames(
        image_paths=(Path("none"),) * count,
        world_from_camera=np.array(poses),
        intrinsics=np.tile(LENS, (count, 1)),
        resolution=np.tile(np.array([WIDTH, HEIGHT], np.int32), (count, 1)),
        exposure_time=np.ones(count),
        saturation_radiance=np.full(count, 4.0),
        noise_floor_radiance=np.full(count, 1e-3),
    )


def test_the_texel_size_is_the_pixel_on_the_surface():
    # A camera 2 m over a large floor, looking straight down, focal length 80 pixels: the distance
    # along a ray is 2 / cos, the pixel there 2 / cos / 80 wide, stretched by 1 / cos once. The
    # median over the image is 2 / 80 m times the median of cos^-1.5.
    floor = world_of([quad((-50, -50, 0), (100, 0, 0), (0, 100, 0))])
    frames = _frames([look_at(np.array([0, -1e-6, 2.0]), np.zeros(3))])
    x, y = np.meshgrid((np.arange(80) - 39.5) / 80, (np.arange(60) - 29.5) / 80)
    expected = 2 / 80 * np.exp(np.log((1 + x**2 + y**2) ** 0.75).mean())
    found = texel_sizes_from_frames(floor.scene, floor.rays, frames)
    assert found.pixels.sum() == 80 * 60
    assert found.of_objects(floor.scene)[0] == pytest.approx(expected, rel=1e-3)
    # 10^4 m^2 in at most 10^4 texels, of which an atlas uses 70 %: sqrt(1 / 0.7) m.
    limited = at_most(found, floor.scene, 10**4)
    assert at_most(found, floor.scene, 10**9).side == pytest.approx(found.side)
    area = 100.0**2 / len(floor.scene.triangles)
    assert (area / limited.side**2).sum() / 0.7 == pytest.approx(10**4, rel=1e-4)


def test_what_no_frame_shows_gets_coarse_texels():
    # The second sheet lies behind the camera.
    sheets = world_of(
        [quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)), quad((-1, -1, 4), (2, 0, 0), (0, 2, 0))]
    )
    frames = _frames([look_at(np.array([0, -1e-6, 2.0]), np.zeros(3))])
    sizes = texel_sizes_from_frames(sheets.scene, sheets.rays, frames)
    seen, unseen = sizes.of_objects(sheets.scene)
    assert seen == pytest.approx(2 / 80, rel=0.2)
    assert unseen == pytest.approx(4 * seen, rel=0.1)


def _above(count: int) -> Frames:
    """Cameras 2 m over the floor that look down beside each other: their pixels cover 25 mm."""
    places = [np.array([0.37 * i % 0.5, 0.23 * i % 0.5 - 1e-6, 2.0]) for i in range(count)]
    return _frames([look_at(eye, eye * [1, 1, 0] + [0, 1e-6, 0]) for eye in places])


def _shown(radiance: Float, *, valid: bool, dark: bool = False) -> FramePixels:
    def everywhere(true: bool) -> Bool:
        return np.full(radiance.shape[:2], true, np.bool_)

    return FramePixels(
        radiance=radiance,
        valid=everywhere(valid),
        clipped=everywhere(False),
        dark=everywhere(dark),
        unknown=everywhere(not (valid or dark)),
        transparent=everywhere(False),
        num_clamped=0,
    )


def _pictures(
    world: World, frames: Frames, looked_at: list[int], shade: Shade
) -> Iterator[tuple[Camera, FramePixels]]:
    """What the frames show of a floor whose radiance ``shade`` tells at (M, 2) places, by frame."""
    grid = (np.stack(np.meshgrid(*[np.arange(4)] * 2), axis=-1).reshape(-1, 2) + 0.5) / 4 - 0.5
    for i in looked_at:
        camera = frames.camera(i)
        origins, directions = camera.rays((camera.pixels()[:, None] + grid).reshape(-1, 2))
        hits = world.rays.closest(origins, directions)
        place = (origins + hits.distance[:, None] * directions)[:, :2]
        level = shade(place, i).reshape(HEIGHT, WIDTH, -1).mean(axis=2)
        radiance = np.repeat(level[..., None], 3, axis=2).astype(np.float32)
        yield camera, _shown(radiance, valid=True)


def _narrower(shade: Shade, count: int, **otherwise: Frames) -> float:
    """What the texels of a floor become, in parts of what they were."""
    floor = world_of([quad((-4, -4, 0), (8, 0, 0), (0, 8, 0))])
    frames = otherwise.get("frames", _above(count))
    sizes = texel_sizes_from_frames(floor.scene, floor.rays, frames)
    looked_at = frames_for_patterns(frames)
    points = points_of_patterns(floor.scene, floor.rays, frames, looked_at)
    pictures = _pictures(floor, frames, looked_at, shade)
    found = finer_where_patterned(sizes, floor.scene, floor.rays, points, pictures, len(frames))
    ratio = found.side / sizes.side
    assert (ratio == ratio[0]).all()
    return float(ratio[0])


def _pattern(place: Double, frame: int) -> Double:
    """Squares of 60 mm, in two greys."""
    return 1 + 0.3 * np.sign(np.sin(place * math.pi / 0.06)).prod(axis=1)


def _noise(place: Double, frame: int) -> Double:
    return np.repeat(np.random.default_rng(frame).normal(1, 0.05, len(place) // 16), 16)


def _shadow(place: Double, frame: int) -> Double:
    return np.where(place[:, 0] + 0.3 * place[:, 1] < 0.4, 1.0, 0.2)


def _highlight(place: Double, frame: int) -> Double:
    """Small, and somewhere else for every frame."""
    off = place - np.random.default_rng(frame).uniform(-0.3, 0.3, 2)
    return 1 + 2 * np.exp(-(off**2).sum(axis=1) / 0.03**2)


@pytest.mark.parametrize("shade", [_noise, _shadow, _highlight])
def test_texels_stay_as_wide_as_pixels_where_there_is_no_pattern(shade: Shade):
    assert _narrower(shade, 12) == 1


def test_a_pattern_gets_as_many_texels_as_pixels_tell(monkeypatch: pytest.MonkeyPatch):
    # Four frames whose pixels are as wide as texels: 4 pixels a texel, of which 1.5 are needed.
    # Points at the rim are seen by fewer; most lie where all four see them.
    assert _narrower(_pattern, 4) == pytest.approx(math.sqrt(1.5 / 4), rel=0.05)
    # Never finer than half of what a pixel covers, however many there are.
    assert _narrower(_pattern, 12) == 0.5
    # Where not all frames are looked at the others count as these do.
    whole = _narrower(_pattern, 8, frames=_frames(list(_above(4).world_from_camera) * 2))
    monkeypatch.setattr("usdbrdf.texturing.texel_density._FRAMES", 4)
    some = _narrower(_pattern, 8, frames=_frames(list(_above(4).world_from_camera) * 2))
    assert some == pytest.approx(whole, rel=0.05)


def test_too_few_frames_tell_no_pattern_from_noise():
    assert _narrower(_pattern, 2) == 1


def test_only_objects_with_patterns_get_finer_texels():
    world = world_of(
        [quad((-4, -4, 0), (4, 0, 0), (0, 8, 0)), quad((0, -4, 0), (4, 0, 0), (0, 8, 0))]
    )
    frames = _above(12)
    sizes = TexelSizes.even(world.scene, 0.025)
    looked_at = frames_for_patterns(frames)
    points = points_of_patterns(world.scene, world.rays, frames, looked_at)

    def shade(place: Double, frame: int) -> Double:
        # The border of the two is an edge in every frame, and no pattern of either.
        return np.where(place[:, 0] < 0, 5.0, _pattern(place, frame))

    pictures = _pictures(world, frames, looked_at, shade)
    found = finer_where_patterned(sizes, world.scene, world.rays, points, pictures, 12)
    plain = world.scene.face_object == 0
    assert found.side[plain] == pytest.approx(0.025)
    assert found.side[~plain] == pytest.approx(0.0125)
    assert (found.pixels == sizes.pixels).all()


def test_frames_that_see_nothing_or_nothing_valid_tell_no_pattern():
    world = world_of([quad((-4, -4, 0), (8, 0, 0), (0, 8, 0))])
    away = look_at(np.array([0, -1e-6, 2.0]), np.array([0, 0, 4.0]))
    frames = _frames([*_above(4).world_from_camera, away])
    sizes = TexelSizes.even(world.scene, 0.025)
    points = points_of_patterns(world.scene, world.rays, frames, [0, 1, 2, 3, 4])
    black = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    unknown = _shown(np.full_like(black, np.nan), valid=False)
    dark = _shown(black, valid=False, dark=True)
    for shown in (unknown, dark):
        pictures = [(frames.camera(i), shown) for i in range(5)]
        found = finer_where_patterned(sizes, world.scene, world.rays, points, pictures, 5)
        assert (found.side == sizes.side).all()
