"""Pinhole rays: pixel centres, axes, and the way back into the pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes import look_at
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames

LENS = (120.0, 100.0, 31.5, 24.25)


def _camera(pose: np.ndarray, width: int = 60, height: int = 50) -> Camera:
    return Camera(world_from_camera=pose, intrinsics=LENS, width=width, height=height)


def test_the_first_pixel_is_centred_at_one_half():
    pixels = _camera(np.eye(4), 4, 3).pixels()
    assert pixels.shape == (12, 2)
    np.testing.assert_array_equal(pixels[0], [0.5, 0.5])
    np.testing.assert_array_equal(pixels[1], [1.5, 0.5])  # row by row
    np.testing.assert_array_equal(pixels[-1], [3.5, 2.5])


def test_a_stride_keeps_every_nth_pixel():
    camera = _camera(np.eye(4), 7, 5)
    whole = camera.pixels().reshape(5, 7, 2)
    np.testing.assert_array_equal(camera.pixels(3), whole[::3, ::3].reshape(-1, 2))


def test_the_axes_are_right_up_and_backwards():
    # Identity pose: right of the image is +x, its top is +y, and the camera looks along -z.
    middle, right, above = np.array([31.5, 24.25]), np.array([40, 24.25]), np.array([31.5, 10])
    _, w = _camera(np.eye(4)).rays(np.array([middle, right, above]))
    np.testing.assert_allclose(w[0], [0, 0, -1], atol=1e-7)
    assert w[1][0] > 0
    assert abs(w[1][1]) < 1e-7
    assert w[2][1] > 0
    assert abs(w[2][0]) < 1e-7
    # tan of the angle = pixels / focal length.
    assert w[1][0] / -w[1][2] == pytest.approx(8.5 / 120, rel=1e-6)
    assert w[2][1] / -w[2][2] == pytest.approx(14.25 / 100, rel=1e-6)


def test_rays_project_back_into_their_pixels():
    pose = look_at(np.array([1.0, -2, 3]), np.array([0.2, 0.1, 0.5]))
    camera = _camera(pose)
    pixels = camera.pixels()
    origins, directions = camera.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(origins, np.tile([[1, -2, 3]], (len(pixels), 1)))
    camera_from_world = np.linalg.inv(pose)
    points = origins + 2.5 * directions
    np.testing.assert_allclose(camera.project(points), pixels, atol=1e-4)
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    column = LENS[2] + LENS[0] * local[:, 0] / -local[:, 2]
    row = LENS[3] - LENS[1] * local[:, 1] / -local[:, 2]
    np.testing.assert_allclose(np.stack([column, row], axis=-1), pixels, atol=1e-4)


def test_another_number_of_pixels_shows_the_same_picture():
    camera = _camera(look_at(np.array([1.0, -2, 3]), np.zeros(3)))
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.2
    where = camera.project(points) / (60, 50)
    for other in (camera.at_size(90, 200), camera.at_width(7)):
        np.testing.assert_allclose(other.project(points) / (other.width, other.height), where)
    assert (camera.at_width(30).width, camera.at_width(30).height) == (30, 25)


def test_a_frame_has_its_camera():
    frames = Frames(
        image_paths=(Path("a/0.exr"), Path("a/1.exr")),
        world_from_camera=np.stack([np.eye(4), 2 * np.eye(4)]),
        intrinsics=np.array([LENS, LENS[::-1]]),
        resolution=np.array([[60, 50], [40, 30]], np.int32),
        exposure_time=np.ones(2),
        saturation_radiance=np.ones(2),
        noise_floor_radiance=np.zeros(2),
    )
    camera = frames.camera(1)
    np.testing.assert_array_equal(camera.world_from_camera, 2 * np.eye(4))
    assert camera.intrinsics == LENS[::-1]
    assert (camera.width, camera.height, camera.name) == (40, 30, "1.exr")
