"""Which frame shows an object's highlights, and which of its pixels are fitted."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.material.fit_target import (
    FrameCounts,
    choose_target_frames,
    count_frame,
    frame_samples,
    mirror_hits_emitter,
    object_pixels,
    seen_in_frame,
)
from usdbrdf.transport.lit_scene import LitScene, View, visible_points

WIDTH, HEIGHT = 80, 60
LENS = np.array([60.0, 60.0, 40.0, 30.0])
EYE = np.array([0.0, -1.5, 1.0])
LAMP_LOW, LAMP_HIGH = np.array([-0.5, 0.8]), np.array([0.5, 1.8])


@pytest.fixture(scope="module")
def world() -> World:
    """A floor and a lamp two metres above it, looking down."""
    return world_of([
        quad((-3, -3, 0), (6, 0, 0), (0, 6, 0), size=(16, 16)),
        quad((*LAMP_LOW, 2), (0, 1, 0), (1, 0, 0), size=(16, 16)),
    ])  # fmt: skip


@pytest.fixture(scope="module")
def pose() -> np.ndarray:
    return look_at(EYE, np.array([0.0, 0.2, 0]))


def _lit(world: World) -> LitScene:
    """The lamp is the emitter."""
    emits = world.per_object([(0, 0, 0), (1, 1, 1)])
    return world.lit(emits, emission=emits)


def _mirrored(position: np.ndarray) -> np.ndarray:
    """Does the mirror image of the lamp, at z = -2, cover the floor point seen from the eye?

    The line from the eye through (x, y, 0) reaches z = -2 after (1 + 2) / 1 of the way.
    """
    xy = EYE[:2] + (position[:, :2] - EYE[:2]) * 3
    return ((xy > LAMP_LOW) & (xy < LAMP_HIGH)).all(axis=1)


def test_what_a_camera_sees(world: World, pose: np.ndarray):
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    points = visible_points(_lit(world), camera, camera.pixels())
    floor = points.face >= 0
    floor &= points.face < 2
    assert floor.sum() > 2000
    np.testing.assert_allclose(points.position[floor, 2], 0, atol=1e-5)
    np.testing.assert_allclose(points.normal[floor], np.tile([[0, 0, 1.0]], (floor.sum(), 1)))
    to_eye = EYE - points.position[floor]
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    np.testing.assert_allclose(points.to_camera[floor], to_eye, atol=1e-5)


def test_normals_are_turned_to_the_camera(world: World):
    # From below the floor: its normal points away and is turned round.
    below = look_at(np.array([0, -1.0, -1.0]), np.zeros(3))
    camera = camera_at(below, LENS, WIDTH, HEIGHT)
    points = visible_points(_lit(world), camera, np.array([[40.0, 30.0]]))
    assert points.face[0] in (0, 1)
    np.testing.assert_allclose(points.normal[0], [0, 0, -1], atol=1e-6)
    assert (points.normal * points.to_camera).sum() > 0


def test_the_mirror_image_of_the_lamp_is_where_geometry_says(world: World, pose: np.ndarray):
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    points = visible_points(_lit(world), camera, camera.pixels())
    found = mirror_hits_emitter(_lit(world), points)
    floor = (points.face >= 0) & (points.face < 2)
    expected = _mirrored(points.position)
    assert 50 < (expected & floor).sum() < 1000
    # Equal but for single pixels exactly at the lamp's outline.
    assert (found[floor] != expected[floor]).mean() < 0.002
    assert not found[points.face < 0].any()


def test_a_frame_counts_highlights_and_valid_pixels(world: World, pose: np.ndarray):
    valid = np.ones((HEIGHT, WIDTH), bool)
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    pixels = camera.pixels()
    points = visible_points(_lit(world), camera, pixels)
    floor = (points.face >= 0) & (points.face < 2)

    def count(valid: np.ndarray, stride: int = 1) -> FrameCounts:
        return count_frame(_lit(world), valid, camera, stride)

    whole = count(valid)
    assert whole.valid[0] == floor.sum()
    assert whole.mirrored[0] == pytest.approx((_mirrored(points.position) & floor).sum(), abs=8)
    # Invalid pixels count for neither; a stride counts a part.
    valid[:, : WIDTH // 2] = False
    half = count(valid)
    assert half.valid[0] == (floor & (pixels[:, 0] > WIDTH / 2)).sum()
    assert 0 < half.mirrored[0] < whole.mirrored[0]
    some = count(np.ones_like(valid), stride=3)
    assert some.valid[0] == pytest.approx(whole.valid[0] / 9, rel=0.1)


def test_the_frame_with_most_highlights_wins():
    frames = [
        FrameCounts(mirrored=np.array([3, 0, 0]), valid=np.array([90, 10, 0])),
        FrameCounts(mirrored=np.array([7, 0, 0]), valid=np.array([20, 50, 0])),
        FrameCounts(mirrored=np.array([5, 0, 0]), valid=np.array([99, 30, 0])),
    ]
    target, mirrored = choose_target_frames(frames)
    # Without highlights the frame with most valid pixels; without any pixel none.
    np.testing.assert_array_equal(target, [1, 1, -1])
    np.testing.assert_array_equal(mirrored, [7, 0, 0])


def _pixels(limit: int, highlight: np.ndarray | None = None):
    owner = np.zeros((HEIGHT, WIDTH), np.int32)
    owner[:, 40:] = 1
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:5] = False
    nowhere = np.zeros_like(valid)
    rng = np.random.default_rng(12345)
    return object_pixels(
        owner, valid, nowhere if highlight is None else highlight, 1, limit, rng.permutation
    )


def test_pixels_next_to_another_object_or_invalid_are_left_out():
    chosen, stands_for = _pixels(10**6)
    row, column = np.divmod(chosen, WIDTH)
    # One pixel off the other object and off the image border; five invalid rows.
    assert (column.min(), column.max()) == (41, WIDTH - 2)
    assert (row.min(), row.max()) == (5, HEIGHT - 2)
    assert len(chosen) == (WIDTH - 2 - 40) * (HEIGHT - 2 - 4)
    np.testing.assert_array_equal(stands_for, 1)


def test_half_of_a_limited_number_of_pixels_lies_by_the_highlight():
    highlight = np.zeros((HEIGHT, WIDTH), bool)
    highlight[55, 75] = True
    chosen, stands_for = _pixels(200, highlight)
    assert len(chosen) == len(np.unique(chosen)) == 200
    row, column = np.divmod(chosen, WIDTH)
    near = np.hypot(row - 55, column - 75) <= 30
    assert near.sum() == 100
    # What was left out is stood for by what was taken.
    whole, _ = _pixels(10**6)
    row, column = np.divmod(whole, WIDTH)
    number = (np.hypot(row - 55, column - 75) <= 30).sum()
    assert stands_for[near].sum() == pytest.approx(number, rel=1e-5)
    assert stands_for[~near].sum() == pytest.approx(len(whole) - number, rel=1e-5)


def test_a_pixel_is_the_mean_over_its_quarters(world: World, pose: np.ndarray):
    """Of a floor whose radiance rises evenly, as much as in the pixel's middle."""
    x, y, _ = world.texels.position.T.astype(np.float64)
    radiance = np.stack([4 + x, 4 - y, 5 + x + y], axis=-1).astype(np.float32)
    emits = world.per_object([(0, 0, 0), (1, 1, 1)])
    lit = world.lit(radiance, emission=emits)
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    shown = np.random.default_rng(2).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    view = View(camera=camera, radiance=shown, valid=np.ones((HEIGHT, WIDTH), bool))
    samples, number = frame_samples(lit, view, seen_in_frame(lit, view), 0, 300, 1)
    assert samples is not None
    assert number == len(samples.diffuse) == len(samples.stands_for) > 200
    # Which pixels these are is told by what they show.
    place = {tuple(rgb): k for k, rgb in enumerate(shown.reshape(-1, 3).tolist())}
    pixel = np.array([place[tuple(rgb)] for rgb in samples.observed.tolist()])
    middle = visible_points(lit, camera, camera.pixels()).position[pixel].astype(np.float64)
    inside = (np.abs(middle[:, :2]).max(axis=1) < 2.5) & (middle[:, 1] < 0.5)  # and near
    assert inside.sum() > 100
    x, y, _ = middle[inside].T
    wanted = np.stack([4 + x, 4 - y, 5 + x + y], axis=-1)
    # Perspective bends a few; a quarter of a pixel to one side would be 4e-3 on the mean.
    off = samples.diffuse[inside] - wanted
    np.testing.assert_allclose(off, 0, atol=4e-3)
    np.testing.assert_allclose(off.mean(axis=0), 0, atol=5e-4)
    level = samples.diffuse.mean(axis=1, keepdims=True)
    weight = (level + 0.1 * np.median(level)) ** -2
    np.testing.assert_allclose(samples.weight(), weight, rtol=1e-5)
    few, some = frame_samples(lit, view, seen_in_frame(lit, view), 0, 5, 1)
    assert few is None
    assert some <= 5
