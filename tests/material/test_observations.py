"""How many texels are followed through how many frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.material import observations
from usdbrdf.material.observations import SIDE, Follower
from usdbrdf.transport.lit_scene import LitScene, View

SIZE = 16
LENS = np.array([16.0, 16.0, 8.0, 8.0])


@pytest.fixture(scope="module")
def floor() -> World:
    return world_of([
        quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), size=(24, 24)),
        quad((3, -1, 0), (2, 0, 0), (0, 2, 0), size=(24, 24)),
    ])  # fmt: skip


def _lit(world: World, lamp: int | None = None, size: float | None = None) -> LitScene:
    lit = np.full((len(world.texels), 3), 0.5, np.float32)
    if lamp is not None:
        lit[world.texels.of_object(lamp)] = 50
    scene = world.lit(lit, emission=lit)
    vars(scene)["diagonal_m"] = size or world.size
    return scene


def _view(i: int) -> View:
    pose = look_at(np.array([0.1 * i, -0.5, 2.0]), np.zeros(3))
    camera = camera_at(pose, LENS, SIZE, SIZE)
    hit = camera.rays(camera.pixels())[1][:, 2] < 0
    return View(
        radiance=np.full((SIZE, SIZE, 3), 1 + i, np.float32), valid=hit.reshape(SIZE, SIZE),
        camera=camera,
    )  # fmt: skip


def _followed(world: World, frames: int, usable: np.ndarray) -> tuple[Follower, object]:
    follower = Follower(_lit(world), usable, frames, 0)
    for i in range(frames):
        follower.add(i, _view(i), np.zeros((SIZE, SIZE), bool), 0.25 * i)
    return follower, follower.chosen(0)


@pytest.mark.parametrize("frames", [0, 1, 12, 5000, 10**6, 10**12])
@pytest.mark.parametrize("objects", [0, 1, 12, 5000, 10**6, 10**12])
def test_the_table_is_bounded_whatever_is_asked_for(frames: int, objects: int):
    texels, rows = observations._table_size(frames, objects)
    assert texels * rows * objects <= observations._MAX_CELLS
    assert 0 <= rows <= frames
    if frames * objects <= 4000:
        assert (texels, rows) == (observations._FOLLOWED, frames)
    elif rows < frames and texels:
        assert rows >= observations._MIN_VIEWS


def test_all_frames_are_followed_where_there_is_room(floor: World):
    follower, found = _followed(floor, 6, np.ones(len(floor.texels), bool))
    assert follower._radiance.shape == (6, len(floor.texels), 3)
    assert set(found.frame) == set(range(6))
    np.testing.assert_array_equal(found.radiance, 1 + found.frame[:, None] * np.ones((1, 3)))
    np.testing.assert_array_equal(found.noise, 0.25 * found.frame)


def test_on_a_plane_a_sample_is_the_mean_over_a_square(floor: World):
    # Pixels and texels of 1/12 m: a square of four texels is as many pixels.
    pixels = 48
    view = View(
        radiance=np.random.default_rng(0).random((pixels, pixels, 3)).astype(np.float32),
        valid=np.ones((pixels, pixels), bool),
        camera=camera_at(
            look_at(np.array([0.0, -0.01, 2.0]), np.zeros(3)), (24.0,) * 4, pixels, pixels
        ),
    )
    hall = _lit(floor, size=20.0)
    follower = Follower(hall, np.ones(len(floor.texels), bool), 1, 0)
    follower.add(0, view, np.zeros((pixels, pixels), bool), 0.0)
    radiance = follower._radiance[0][follower._seen[0]]
    assert len(radiance) > 300
    # Sixteen pixels' means, read bilinearly: at most a sixteenth of the variance.
    np.testing.assert_allclose(radiance.mean(), view.radiance.mean(), atol=0.03)
    assert radiance.var() < view.radiance.var() / SIDE**2


def test_beyond_the_bound_frames_are_taken_evenly(floor: World, monkeypatch):
    monkeypatch.setattr(observations, "_MAX_CELLS", 2 * 40 * 5)
    follower, found = _followed(floor, 21, np.ones(len(floor.texels), bool))
    assert follower._radiance.shape == (5, 2 * 40, 3)
    assert set(found.frame) == {0, 5, 10, 15, 20}
    np.testing.assert_array_equal(found.radiance[:, 0], 1 + found.frame)
    np.testing.assert_array_equal(found.noise, 0.25 * found.frame)


@pytest.mark.parametrize("blur", [0.0, 1.5])
def test_the_frames_noise_tells_how_far_they_were_smoothed(floor: World, blur: float):
    # Both squares and the gap between them: tiles across it show no single object.
    width, height = 480, 192
    lens = np.array([160.0, 160.0, 240.0, 96.0])
    pose = look_at(np.array([2.0, -0.01, 2.0]), np.array([2.0, 0.0, 0.0]))
    follower = Follower(_lit(floor), np.ones(len(floor.texels), bool), 2, 0)
    for seed in range(2):
        noise = np.random.default_rng(seed).normal(size=(height, width))
        if blur:
            noise = gaussian_filter(noise, blur)
        shown = 0.5 * (1 + 0.02 * noise / noise.std())
        shown[:, width // 2 :] *= 3  # a bias of a whole object is no noise
        view = View(
            radiance=np.repeat(shown[..., None], 3, axis=2).astype(np.float32),
            valid=np.ones((height, width), bool), camera=camera_at(pose, lens, width, height),
        )  # fmt: skip
        follower.add(seed, view, np.zeros((height, width), bool), 0.0)
    assert follower.smoothing == pytest.approx(blur, rel=0.15)


@pytest.mark.parametrize("frames", [0, 4])
def test_nothing_to_follow_gives_no_observations(floor: World, frames: int):
    _, found = _followed(floor, frames, np.zeros(len(floor.texels), bool))
    assert len(found.texel) == len(found.frame) == len(found.noise) == 0
    assert found.radiance.shape == (0, 3)


def test_texels_that_no_frame_sees_give_no_observations(floor: World):
    # The second square lies out of every picture.
    _, found = _followed(floor, 4, floor.texels.object_index() == 1)
    assert len(found.texel) == 0


def test_the_target_frame_shows_the_highlight():
    """A floor, a wall that no camera sees, and a lamp above, which the floor mirrors only towards
    the fourth camera: from c to a lamp at 3, both 2 above the floor, light turns at (c + 3) / 2."""
    room = world_of([
        quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), size=(24, 24)),
        quad((-9, -1, 0), (0, 2, 0), (0, 0, 2), size=(8, 8)),
        quad((2.5, -0.5, 2), (0, 1, 0), (1, 0, 0), size=(8, 8)),
    ])  # fmt: skip
    usable = room.texels.object_index() != 2
    follower = Follower(_lit(room, lamp=2), usable, 6, 0)
    for i, x in enumerate((0.0, 1.0, 2.0, -2.5, 0.5, 1.5)):
        view = View(
            radiance=np.ones((SIZE, SIZE, 3), np.float32), valid=np.ones((SIZE, SIZE), bool),
            camera=camera_at(look_at(np.array([x, -0.1, 2.0]), np.zeros(3)), LENS, SIZE, SIZE),
        )  # fmt: skip
        follower.add(i, view, np.zeros((SIZE, SIZE), bool), 0.0)
    np.testing.assert_array_equal(follower.target_frames()[0], [3, -1, -1])
