"""Blur of pixels on a surface, and what can be restored of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.texturing.footprints import SAMPLE_BLUR, blurred, footprints, restored, widest

SIDE, TEXEL = 64, 0.02
LENS = np.array([100.0, 100.0, 40.0, 30.0])


@pytest.fixture(scope="module")
def floor() -> World:
    """64 x 64 texels of 2 cm in the plane z = 0, around the origin."""
    half = SIDE * TEXEL / 2
    side = 2 * half
    return world_of([quad((-half, -half, 0), (side, 0, 0), (0, side, 0), (SIDE, SIDE))])


def _middle(world: World, margin: float = 0.3) -> np.ndarray:
    return (np.abs(world.texels.position[:, :2]) < margin).all(axis=1)


def _footprint(world: World, xx: float, xy: float, yy: float) -> np.ndarray:
    return np.tile(np.float32([xx, xy, yy]), (len(world.texels), 1))


def _columns(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Texel coordinates right and down, (T,) each."""
    return world.texels.pixel % SIDE, world.texels.pixel // SIDE


def test_pixel_from_above_covers_what_a_pinhole_says(floor: World):
    which = np.flatnonzero(_middle(floor)).astype(np.int32)
    pose = look_at(np.array([0, 1e-6, 3.0]), np.zeros(3))
    found = footprints(floor.texels, which, camera_at(pose, LENS, 80, 60))
    # A pixel is 3 m / 100 wide, a texel 2 cm; the plane is parallel to the image.
    np.testing.assert_allclose(found[:, [0, 2]], 1.5**2, rtol=1e-3)
    np.testing.assert_allclose(found[:, 1], 0, atol=2e-3)
    np.testing.assert_allclose(widest(found), 1.5, rtol=1e-3)


def test_slanted_view_smears_along_the_line_of_sight(floor: World):
    centre = np.linalg.norm(floor.texels.position[:, :2], axis=1).argmin()
    angle = np.deg2rad(60)
    eye = 3 * np.array([np.sin(angle), 0, np.cos(angle)])
    point = floor.texels.position[centre].astype(np.float64)
    pose = look_at(eye + point, point)
    found = footprints(floor.texels, np.array([centre], np.int32), camera_at(pose, LENS, 80, 60))
    assert widest(found)[0] == pytest.approx(1.5 / np.cos(angle), rel=0.02)
    # Across it nothing is foreshortened.
    assert found[0, [0, 2]].sum() == pytest.approx(1.5**2 * (1 + 1 / np.cos(angle) ** 2), rel=0.03)


@pytest.mark.parametrize("covariance", [(9.0, 0.0, 4.0), (8.0, 5.0, 6.0), (4.0, -3.0, 9.0)])
def test_blur_has_the_covariance_that_is_asked_for(floor: World, covariance: tuple[float, ...]):
    x, y = (v - SIDE / 2 for v in _columns(floor))
    values = np.stack([x, x * x, x * y, y * y], axis=-1).astype(np.float32)
    found = blurred(floor.texels, values, _footprint(floor, *covariance)) - values
    inner = _middle(floor)
    np.testing.assert_allclose(found[inner, 0], 0, atol=1e-4)
    # A texel's own 1/12; reading squares between texels adds up to 1/4.
    for channel, expected in zip((1, 2, 3), covariance, strict=True):
        own = 0 if channel == 2 else 1 / 12
        found_here = found[inner, channel].mean()
        assert expected + own - 0.02 < found_here < expected + own + 0.26, channel


def test_noise_of_a_plain_wall_is_taken_off(floor: World):
    noise = np.random.default_rng(0).normal(0, 0.02, (len(floor.texels), 3)).astype(np.float32)
    error = np.full(len(noise), 0.02**2, np.float32)
    found = restored(
        floor.texels, 1 + noise, np.ones(len(noise), bool), error, _footprint(floor, 2, 0, 2)
    )
    inner = _middle(floor)
    assert found[inner].std() < 0.5 * noise[inner].std()
    assert found[inner].mean() == pytest.approx(1 + noise[inner].mean(), abs=5e-4)


@pytest.mark.parametrize("period", [8, 12])
def test_contrast_that_pixels_took_comes_back(floor: World, period: int):
    x, y = _columns(floor)
    wave = np.sin(2 * np.pi * x / period) * np.sin(2 * np.pi * y / period)
    truth = np.repeat(1 + 0.5 * wave[:, None], 3, axis=1).astype(np.float32)
    footprint = _footprint(floor, 2, 0.5, 3)
    seen = blurred(floor.texels, truth, SAMPLE_BLUR**2 * footprint)
    noise = np.random.default_rng(1).normal(0, 0.002, truth.shape).astype(np.float32)
    error = np.full(len(seen), 0.002**2, np.float32)
    found = restored(floor.texels, seen + noise, np.ones(len(seen), bool), error, footprint)
    inner = _middle(floor)

    def off(values: np.ndarray) -> float:
        return float(np.sqrt(((values - truth)[inner] ** 2).mean()))

    # Of a wave whose share a is lost the second order leaves a^3 lost, and some of the noise.
    lost = off(seen) / float(np.sqrt(((truth - 1)[inner] ** 2).mean()))
    left = lost**2 * off(seen)
    assert 0.8 * left < off(found) < 1.2 * np.hypot(left, 3 * 0.002)
    # Nothing is made up: where the wave was lost it is not larger than it was.
    assert np.abs(found[inner] - 1).max() < 0.5 + 5 * 0.02


def test_what_nobody_measured_stays_and_is_not_taken_for_detail(floor: World):
    x, _ = _columns(floor)
    measured = x < SIDE // 2
    # A fill as rough as can be beside a plain wall with noise.
    random = np.random.default_rng(2)
    values = np.where(measured, 1 + random.normal(0, 0.02, len(x)), random.uniform(0, 2, len(x)))
    values = np.repeat(values[:, None], 3, axis=1).astype(np.float32)
    error = np.full(len(x), 0.02**2, np.float32)
    found = restored(floor.texels, values, measured, error, _footprint(floor, 1, 0, 1))
    np.testing.assert_array_equal(found[~measured], values[~measured])
    away = measured & (x < SIDE // 2 - 8)
    assert found[away].std() < 0.7 * values[away].std()


def test_the_rim_beside_a_lamp_is_not_made_brighter_still(floor: World):
    x, _ = _columns(floor)
    measured = x < SIDE // 2
    # The last column before the lamp caught some of its light.
    values = np.where(x == SIDE // 2 - 1, 2.0, 1.0)[:, None] * np.ones(3)
    found = restored(
        floor.texels, values.astype(np.float32), measured, np.zeros(len(x), np.float32),
        _footprint(floor, 2, 0, 2),
    )  # fmt: skip
    assert found.max() <= 2


def test_another_chart_of_the_atlas_is_no_detail():
    # Charts of 1.0 and 0.1 side by side; a quad of the same object leaves 4 empty columns between.
    left, right, gap = 28, 32, 4
    whole = left + gap + right
    parts = quad((0, 0, 0), (left * TEXEL, 0, 0), (0, 0.4, 0), (whole, 20))
    other = quad((5, 0, 0), (right * TEXEL, 0, 0), (0, 0.4, 0), (whole, 20))
    uv = np.concatenate(
        [parts.uv * [left / whole, 1], other.uv * [right / whole, 1] + [(left + gap) / whole, 0]]
    )
    both = replace(
        parts,
        points=np.concatenate([parts.points, other.points]),
        triangles=np.concatenate([parts.triangles, other.triangles + 4]),
        uv=uv,
        normals=np.concatenate([parts.normals, other.normals]),
    )
    world = world_of([both])
    values = np.where(world.texels.position[:, 0] < 4, 1.0, 0.1)[:, None] * np.ones(3)
    count = len(values)
    found = restored(
        world.texels, values.astype(np.float32), np.ones(count, bool),
        np.full(count, 1e-8, np.float32), _footprint(world, 30, 0, 30),
    )  # fmt: skip
    np.testing.assert_allclose(found, values, rtol=1e-5)


def test_a_view_along_the_surface_has_a_finite_footprint(floor: World):
    # The eye lies in the plane: both steps of a texel project onto one line.
    pose = look_at(np.array([-3.0, 0.001, 0.0]), np.zeros(3))
    which = np.arange(len(floor.texels), dtype=np.int32)
    found = footprints(floor.texels, which, camera_at(pose, LENS, 80, 60))
    assert np.isfinite(found).all()
    assert np.isfinite(widest(found)).all()


@pytest.fixture(scope="module")
def halves() -> World:
    """A square in two charts with the diagonal between them, no texel wide."""
    made = quad((0, 0, 0), (1, 0, 0), (0, 1, 0), (24, 24))
    apart = made.uv.copy()
    apart[0] = apart[0] * 0.86 + [0.11, 0.02]
    apart[1] = apart[1] * 0.86 + [0.02, 0.11]
    return world_of([replace(made, uv=apart)])


@pytest.mark.parametrize("covariance", [(2.0, 0, 2.0), (6.0, 4.0, 3.0), (0.5, -0.3, 9.0)])
def test_nothing_of_another_chart_is_blurred_into_one(halves: World, covariance):
    texels = halves.texels
    values = np.where(texels.face == 0, 1.0, 5.0).astype(np.float32)[:, None]
    found = blurred(texels, values, _footprint(halves, *covariance))
    assert len(np.unique(texels.face)) == 2
    np.testing.assert_allclose(found, values, rtol=1e-6)


def test_what_lies_off_a_chart_counts_as_the_texel_itself(halves: World):
    """So means are no less than its share on the chart, and no more of a rim than of the middle."""
    texels = halves.texels
    x, y = (texels.pixel % 24).astype(np.float32), (texels.pixel // 24).astype(np.float32)
    values = np.stack([x, y], axis=-1)
    found = blurred(texels, values, _footprint(halves, 1.0, 0, 1.0))
    off = np.abs(found - values).max(axis=1)
    # A slope stays a slope inside; at a rim means are drawn inwards, by less than a ring's radius.
    assert (off < 1.3 * np.sqrt(1 + 1 / 12)).all()
    assert np.median(off) < 1e-4
    assert off.max() > 0.2


@pytest.mark.parametrize("size", [(1, 12), (12, 1), (1, 1)])
def test_rows_and_columns_of_texels_are_blurred_along_themselves(size: tuple[int, int]):
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size)])
    place = np.arange(len(world.texels), dtype=np.float32)[:, None]
    plain = blurred(world.texels, np.ones_like(place), _footprint(world, 4.0, 1.0, 4.0))
    np.testing.assert_allclose(plain, 1, rtol=1e-6)
    found = blurred(world.texels, place, _footprint(world, 1.0, 0, 1.0))
    np.testing.assert_allclose(found[4:-4], place[4:-4], atol=1e-4)
