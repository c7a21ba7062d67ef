"""Patterns as fine as pixels, from pictures whose pixels cover them differently."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.model.arrays import Array
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.footprints import SAMPLE_BLUR, blurred
from usdbrdf.texturing.passes import by_parts
from usdbrdf.texturing.pattern_pixels import Covering, PatternedSurface, pixels_of_frame
from usdbrdf.texturing.patterns import (
    Equations,
    _couple,
    add,
    half_of,
    share_that_is_no_noise,
    steps,
    steps_of,
    with_patterns,
)
from usdbrdf.texturing.samples import Picture

Float = npt.NDArray[np.float32]
SIDE, TEXEL, ERROR = 48, 0.02, 0.03
# 60 x 60 pixels, each about 1.5 texels wide from 1.2 m away.
LENS = (40.0, 40.0, 30.0, 30.0)


@pytest.fixture(scope="module")
def floor() -> World:
    """48 x 48 texels of 2 cm in the plane z = 0, around the origin."""
    side = SIDE * TEXEL
    return world_of([quad((-side / 2, -side / 2, 0), (side, 0, 0), (0, side, 0), (SIDE, SIDE))])


def _cameras(count: int) -> list[Camera]:
    """From all sides above the floor, none like another."""
    random = np.random.default_rng(4)
    found = []
    for turn in 2 * np.pi * np.arange(count) / count:
        eye = np.array([0.35 * np.cos(turn), 0.35 * np.sin(turn), 1.15 + 0.1 * random.random()])
        found.append(
            camera_at(look_at(eye, random.uniform(-0.1, 0.1, 3) * [1, 1, 0]), LENS, 60, 60)
        )
    return found


def _picture(camera: Camera, pattern: Float, noise: float, seed: int) -> Picture:
    """Means over 6 x 6 points of each pixel of a ``pattern`` (48, 48, 3) on the floor; its surface
    goes on beyond its border."""
    row, column = np.mgrid[: camera.height, : camera.width]
    sums = np.zeros((camera.height, camera.width, 3))
    for down, right in np.ndindex(6, 6):
        at = np.stack([column + (right + 0.5) / 6, row + (down + 0.5) / 6], axis=-1)
        origin, direction = (np.asarray(v, np.float64) for v in camera.rays(at.reshape(-1, 2)))
        point = origin - direction * (origin[:, 2:] / direction[:, 2:])
        x, y = point[:, 0] / TEXEL + SIDE / 2 - 0.5, SIDE / 2 - point[:, 1] / TEXEL - 0.5
        for c in range(3):
            read = map_coordinates(pattern[..., c], [y, x], order=1, mode="nearest")
            sums[..., c] += read.reshape(sums.shape[:2])
    shown = sums / 36 * (1 + noise * np.random.default_rng(seed).normal(size=sums.shape))
    valid = np.ones(sums.shape[:2], np.bool_)
    return Picture(shown.astype(np.float32), valid, ~valid, ~valid)


def _stripes(period: float = 3.4) -> Float:
    """Oblique ones, of half the floor's radiance, in three colours."""
    y, x = np.mgrid[:SIDE, :SIDE]
    wave = np.sin(2 * np.pi * (0.8 * x + 0.6 * y) / period)
    return np.asarray(1 + 0.5 * wave[..., None] * [1.0, 0.8, -0.6], np.float32)


def _surface(floor: World, values: Float) -> PatternedSurface:
    own = np.arange(SIDE * SIDE, dtype=np.int32)
    scatter = np.full(len(own), 0.2**2, np.float32) * values.mean() ** 2
    owner = floor.texels.object_index()
    return PatternedSurface(floor.scene, floor.rays, floor.texels, owner, values, own, scatter)


def _found(
    floor: World,
    surface: PatternedSurface,
    pictures: Sequence[tuple[Camera, Picture]],
    groups: Sequence[slice] = (slice(0, SIDE * SIDE),),
) -> Float:
    def pixels() -> list[Covering]:
        return [pixels_of_frame(surface, shown, camera, 1e-4, ERROR) for camera, shown in pictures]

    return _together(surface, pixels(), _footprint(floor), groups)


def _together(
    surface: PatternedSurface, pixels: Sequence[Covering], footprint: Float, groups: Sequence[slice]
) -> Float:
    def steps_by(level: Float) -> dict[str, Array]:
        return by_parts(groups, lambda part: steps_of(surface, enumerate(pixels), part, level, 1))

    return with_patterns(surface, footprint, steps_by)


def _footprint(floor: World) -> Float:
    return np.tile(np.float32([2.2, 0, 2.2]), (len(floor.texels), 1))


def _inner() -> npt.NDArray[np.bool_]:
    y, x = np.mgrid[:SIDE, :SIDE]
    return np.asarray((np.maximum(abs(x - SIDE / 2), abs(y - SIDE / 2)) < SIDE / 3).ravel())


def _off(values: Float, truth: Float) -> float:
    return float(np.sqrt(((values - truth)[_inner()] ** 2).mean()))


def _seen(pattern: Float, noise: float = 0.01, count: int = 8) -> list[tuple[Camera, Picture]]:
    cameras = _cameras(count)
    return [(camera, _picture(camera, pattern, noise, k)) for k, camera in enumerate(cameras)]


@pytest.mark.parametrize("period", range(2, 9))
def test_halves_of_the_frames_keep_no_rhythm_of_the_capture(period: int):
    half = np.array([half_of(frame) for frame in range(60)])
    assert half.sum() == 30
    for turn in range(period):
        assert 0.15 <= half[turn::period].mean() <= 0.85


def test_stripes_that_pixels_blur_come_back(floor: World):
    truth = _stripes().reshape(-1, 3)
    mean = blurred(floor.texels, truth, SAMPLE_BLUR**2 * _footprint(floor))
    found = _found(floor, _surface(floor, mean), _seen(_stripes()))
    assert _off(mean, truth) > 0.15
    assert _off(found, truth) < 0.35 * _off(mean, truth)


@pytest.mark.parametrize("spread", [0.0, 0.7, 1.2])
def test_a_plain_floor_stays_plain(floor: World, spread: float):
    # What was denoised or interpolated has noise that neighbours share.
    plain = np.ones((SIDE, SIDE, 3), np.float32)
    pictures = []
    for k, (camera, shown) in enumerate(_seen(plain, 0.0)):
        noise = np.random.default_rng(k).normal(size=shown.radiance.shape)
        noise = gaussian_filter(noise, (spread, spread, 0))
        noisy = shown.radiance + np.float32(0.03 / noise.std()) * noise.astype(np.float32)
        pictures.append((camera, shown._replace(radiance=noisy)))
    found = _found(floor, _surface(floor, plain.reshape(-1, 3)), pictures)
    assert _off(found, plain.reshape(-1, 3)) < 0.3 * 0.03


def test_what_is_there_already_is_not_exaggerated(floor: World):
    truth = _stripes().reshape(-1, 3)
    found = _found(floor, _surface(floor, truth), _seen(_stripes()))
    assert _off(found, truth) < 0.02


def test_highlights_of_single_frames_are_no_pattern(floor: World):
    plain = np.ones((SIDE, SIDE, 3), np.float32)
    pictures = []
    for k, (camera, shown) in enumerate(_seen(plain, 0.01)):
        row, column = np.mgrid[:60, :60]
        middle = np.random.default_rng(k).uniform(15, 45, 2)
        for size, strength in ((8, 0.5), (1.5, 20.0)):  # a wide one, and a lamp in a mirror
            away2 = (row - middle[0]) ** 2 + (column - middle[1]) ** 2
            shown.radiance[...] += (strength * np.exp(-away2 / (2 * size**2)))[..., None]
        pictures.append((camera, shown))
    found = _found(floor, _surface(floor, plain.reshape(-1, 3)), pictures)
    assert _off(found, plain.reshape(-1, 3)) < 0.02


def test_contradicting_frames_change_little(floor: World):
    # The poses are off: every frame shows the stripes elsewhere.
    shifted = [np.roll(_stripes(), 2 * k, axis=1) for k in range(8)]
    pictures = [_seen(own)[k] for k, own in enumerate(shifted)]
    mean = np.mean(shifted, axis=0).reshape(-1, 3).astype(np.float32)
    found = _found(floor, _surface(floor, mean), pictures)
    assert _off(found, mean) < 0.5 * _off(_stripes().reshape(-1, 3), mean)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_radiance_makes_no_difference(floor: World, scale: float):
    truth = _stripes().reshape(-1, 3)
    mean = blurred(floor.texels, truth, SAMPLE_BLUR**2 * _footprint(floor))
    pictures = _seen(_stripes())
    once = _found(floor, _surface(floor, mean), pictures)
    scaled = [
        (camera, shown._replace(radiance=shown.radiance * np.float32(scale)))
        for camera, shown in pictures
    ]
    surface = _surface(floor, mean * np.float32(scale))
    found = [
        pixels_of_frame(surface, shown, camera, 1e-4 * scale, ERROR) for camera, shown in scaled
    ]
    again = _together(surface, found, _footprint(floor), [slice(0, SIDE * SIDE)])
    np.testing.assert_allclose(again / np.float32(scale), once, rtol=2e-3, atol=2e-3)


def test_pixels_on_some_texels_are_those_of_all(floor: World):
    surface = _surface(floor, np.ones((SIDE * SIDE, 3), np.float32))
    camera, shown = _seen(_stripes(), count=3)[1]
    whole = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
    part = slice(20 * SIDE, 30 * SIDE)
    found = pixels_of_frame(surface, shown, camera, 1e-4, ERROR, part)
    own = (whole.texel >= part.start) & (whole.texel < part.stop)
    assert 100 < own.sum() < 0.5 * len(own)
    for some, all_of_them in zip(found, whole.take(own), strict=True):
        np.testing.assert_array_equal(some, all_of_them)


@pytest.fixture(scope="module")
def strips() -> World:
    """Three strips side by side, with atlases of 20, 9 and 31 texels' width."""
    sizes = ((20, 320), (9, 240), (31, 160))
    return world_of([
        quad((k, 0, 0), (width * TEXEL, 0, 0), (0, height * TEXEL, 0), (width, height))
        for k, (width, height) in enumerate(sizes)
    ])  # fmt: skip


def _anywhere(world: World, count: int, own: npt.NDArray[np.int32]) -> Covering:
    """Pixels of one size anywhere on the texels that are asked for."""
    texels, random = world.texels, np.random.default_rng(3)
    texel = random.choice(own[own >= 0], count).astype(np.int32)
    owner = texels.object_index()[texel]
    local, width = texels.pixel[texel] - texels.first_pixel[owner], texels.resolution[owner, 0]
    where = np.stack([local % width, local // width], axis=-1) + random.random((count, 2))
    return Covering(
        texel=texel,
        where=where.astype(np.float32),
        step=np.tile(np.float32([[1.1, 0.3], [-0.2, 0.9]]), (count, 1, 1)),
        rest=random.normal(0, 0.2, (count, 3)).astype(np.float32),
        weight=random.uniform(10, 1000, count).astype(np.float32),
    )


def _bare(world: World) -> PatternedSurface:
    """All texels of 1, but for a tenth of them that nobody asks for."""
    texels, random = world.texels, np.random.default_rng(5)
    own = np.full(len(texels.nearest_texel), -1, np.int32)
    own[texels.pixel] = np.where(random.random(len(texels)) < 0.1, -1, np.arange(len(texels)))
    ones = np.ones((len(texels), 3), np.float32)
    return PatternedSurface(
        world.scene, world.rays, texels, texels.object_index(), ones, own, 0.04 * ones[:, 0]
    )


@pytest.mark.parametrize("inner", [[2000, 2007], [6400], [6395, 6405, 8560], [8563]])
def test_what_a_texel_gets_does_not_depend_on_its_group(strips: World, inner: list[int]):
    surface = _bare(strips)
    count = len(strips.texels)
    pixels = _anywhere(strips, 60_000, surface.own)
    footprint = np.tile(np.float32([1, 0, 1]), (count, 1))

    def found(ends: list[int]) -> Float:
        return _together(surface, [pixels], footprint, [slice(a, b) for a, b in pairwise(ends)])

    whole = found([0, count])
    assert (whole != surface.values).any()
    np.testing.assert_array_equal(found([0, *inner, count]), whole)


def test_couplings_are_those_of_least_squares_and_of_one_object_alone(strips: World):
    surface, texels = _bare(strips), strips.texels
    pixels = _anywhere(strips, 200, surface.own)
    equations = Equations.empty(len(texels))
    add(equations, 0, surface, pixels, 0)
    matrix, pull = np.zeros((len(texels), len(texels))), np.zeros((len(texels), 3))
    for m in range(len(pixels.texel)):
        # By many points in each pixel, and texels' bilinear hats.
        o = surface.object[pixels.texel[m]]
        width, height = texels.resolution[o]
        inside = (np.stack(np.meshgrid(*[np.arange(64) + 0.5] * 2), axis=-1) / 64 - 0.5).reshape(
            -1, 2
        )
        at = pixels.where[m] + inside @ pixels.step[m] - 0.5
        at = np.clip(at, 0, [width - 1, height - 1])
        low = np.minimum(at.astype(int), [width - 2, height - 2])
        covers = np.zeros(len(texels))
        for right, down in np.ndindex(2, 2):
            corner = low + np.array([right, down])
            share = np.prod(1 - np.abs(at - corner), axis=1) / len(at)
            first = texels.first_texel[o]
            np.add.at(covers, first + corner[:, 1] * width + corner[:, 0], share)
        if (covers[surface.own[texels.pixel] < 0] > 0).any():
            continue  # covers a texel that nobody asks for: not among a frame's
        some = np.flatnonzero(covers)
        matrix[np.ix_(some, some)] += pixels.weight[m] * np.outer(covers[some], covers[some])
        pull[some] += pixels.weight[m] * np.outer(covers[some], pixels.rest[m])
    asked = matrix.diagonal() > 0
    assert asked.sum() > 200
    unasked = surface.own[texels.pixel] < 0
    touched = np.zeros(len(texels), bool)
    ones = np.zeros((len(texels), 4), np.float32)
    for k, texel in enumerate(np.flatnonzero(asked & ~unasked)[:: asked.sum() // 4][:4]):
        ones[texel, k] = 1
        touched[texel] = True
    found = np.empty_like(ones)
    owner = surface.object
    _couple(
        len(texels), equations.coupling[0], texels.pixel, texels.first_pixel[owner],
        texels.resolution[owner, 0].astype(np.int64), surface.own, ones, found,
    )  # fmt: skip
    wanted = matrix @ ones
    np.testing.assert_allclose(found, wanted, atol=0.05 * wanted.max())
    # Pixels that cover a texel nobody asks for are in the equations alone.
    assert np.abs(equations.pull[0] - pull).max() < 5 * np.abs(pull).max()


def test_equations_are_those_of_least_squares(floor: World):
    values = np.ones((SIDE * SIDE, 3), np.float32)
    surface = _surface(floor, values)
    [(camera, shown)] = _seen(_stripes(), 0.0, count=1)
    pixels = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
    equations = Equations.empty(len(values))
    add(equations, 0, surface, pixels, 0)
    # What pixels cover adds up to one, and all of it lies on the floor.
    assert equations.pixels.sum() == pytest.approx(len(pixels.texel), rel=1e-5)
    squares = (pixels.weight[:, None] * pixels.rest**2).sum() / 3
    assert equations.squares.sum() == pytest.approx(squares, rel=1e-4)
    pull = (pixels.weight[:, None] * pixels.rest).sum(axis=0)
    np.testing.assert_allclose(
        equations.pull[0].sum(axis=0), pull, rtol=1e-3, atol=abs(pull).max() * 1e-3
    )
    # 1^T B^T W B 1 = sum of the weights; half of the couplings are kept.
    coupling = equations.coupling[0]
    total = 2 * coupling.sum(dtype=np.float64) - coupling[:, 0].sum()
    assert total == pytest.approx(pixels.weight.sum(dtype=np.float64), rel=1e-4)


def test_steps_solve_their_equations(floor: World):
    truth = _stripes().reshape(-1, 3)
    values = np.ones_like(truth)
    surface = _surface(floor, values)
    equations = Equations.empty(len(values))
    for frame, (camera, shown) in enumerate(_seen(_stripes())):
        pixels = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
        add(equations, 0, surface, pixels, frame % 2)
    part = slice(0, len(values))
    level = np.ones(len(values), np.float32)
    found = steps(equations, part, surface, level, 1)
    assert _off(values + found["step"], truth) < 0.3 * _off(values, truth)
    share = share_that_is_no_noise(floor.texels, found["told"], _footprint(floor))
    assert share[_inner()].min() > 0.8


def test_halves_of_the_frames_agree_on_patterns_and_not_on_noise(floor: World):
    values = np.ones((SIDE * SIDE, 3), np.float32)
    surface = _surface(floor, values)

    def told(pattern: Float, noise: float) -> tuple[float, float]:
        equations = Equations.empty(len(values))
        for frame, (camera, shown) in enumerate(_seen(pattern, noise)):
            pixels = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
            add(equations, 0, surface, pixels, frame % 2)
        found = steps(equations, slice(0, len(values)), surface, np.ones(len(values)), 1)
        explained, apart = found["told"][_inner(), :2].sum(axis=0)
        return explained, apart

    explained, apart = told(_stripes(), 0.0)
    assert apart < 0.15 * explained
    explained, apart = told(np.ones((SIDE, SIDE, 3), np.float32), 0.03)
    assert 0.7 < apart / explained < 1.3


def test_what_pixels_leave_is_no_noise_where_halves_of_the_frames_agree(floor: World):
    def share(apart: float, compared: float) -> Float:
        """Of 1 that is explained by 0.5 numbers a pixel, where pixels leave 3."""
        told = np.tile(np.float32([1, apart, 0.5, 3, 1, compared]), (SIDE * SIDE, 1))
        return share_that_is_no_noise(floor.texels, told, _footprint(floor))

    # White noise that leaves so much would explain 3 / 0.5 * 0.5; of that 0.05 / 0.95 counts.
    np.testing.assert_allclose(share(0.05, 1), 1 - 1.1 * 0.05 / 0.95 * 3, rtol=1e-3)
    # What halves contradict each other on, and what they could not be asked, is noise.
    assert not share(1.0, 1).any()
    assert not share(0.05, 0).any()


def test_pixels_over_an_edge_are_left_out():
    # A floor in two colours and objects: pixels of the border show both.
    half = SIDE * TEXEL / 2
    parts = [
        quad((-half, -half, 0), (half, 0, 0), (0, 2 * half, 0), (SIDE // 2, SIDE)),
        quad((0, -half, 0), (half, 0, 0), (0, 2 * half, 0), (SIDE // 2, SIDE)),
    ]
    world = world_of(parts)
    pattern = np.ones((SIDE, SIDE, 3), np.float32)
    pattern[:, SIDE // 2 :] = 5
    values = np.where(world.texels.position[:, :1] < 0, 1, 5) * np.ones(3, np.float32)
    own = np.arange(len(world.texels), dtype=np.int32)
    scatter = np.full(len(own), 1, np.float32)
    surface = PatternedSurface(
        world.scene, world.rays, world.texels, world.texels.object_index(),
        values.astype(np.float32), own, scatter,
    )  # fmt: skip
    for camera, shown in _seen(pattern, 0.0):
        pixels = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
        assert len(pixels.texel) > 500
        assert np.abs(pixels.rest).max() < 0.02


def test_frames_that_show_nothing_of_it_tell_nothing(floor: World):
    surface = _surface(floor, np.ones((SIDE * SIDE, 3), np.float32))
    away = camera_at(look_at(np.array([0, 0.1, 1.0]), np.array([0, 5.0, 3.0])), LENS, 60, 60)
    small = camera_at(look_at(np.array([0, 0.1, 1.0]), np.zeros(3)), (1.0, 1.0, 1.0, 1.0), 2, 2)
    equations = Equations.empty(SIDE * SIDE)
    for camera in (away, small):
        shown = np.ones((camera.height, camera.width, 3), np.float32)
        valid = np.ones(shown.shape[:2], np.bool_)
        pixels = pixels_of_frame(surface, Picture(shown, valid, ~valid, ~valid), camera, 0, ERROR)
        assert not len(pixels.texel)
        add(equations, 0, surface, pixels, 0)
    assert not equations.coupling.any()


def test_pixels_on_texels_that_nobody_asks_for_are_left_out(floor: World):
    surface = _surface(floor, np.ones((SIDE * SIDE, 3), np.float32))
    [(camera, shown)] = _seen(np.ones((SIDE, SIDE, 3), np.float32), 0.01, count=1)
    unasked = np.zeros((SIDE, SIDE), bool)
    unasked[:, 20:28] = True
    surface.own[unasked.ravel()] = -1
    pixels = pixels_of_frame(surface, shown, camera, 1e-4, ERROR)
    equations = Equations.empty(SIDE * SIDE)
    add(equations, 0, surface, pixels, 0)
    assert not equations.pixels[unasked.ravel()].any()
    assert equations.pixels.sum() == pytest.approx(len(pixels.texel), rel=1e-5)
