"""What frames show at points of a wall, and its slope along steps of their cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.scenes import camera_at
from usdbrdf.files.frames import FramePixels
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.agreement import MIN_COSINE, MeshPoints
from usdbrdf.texturing.pose_samples import LookedUp, _smooth, halved, logarithms, look_up
from usdbrdf.transport.rays import RayScene

WIDTH, HEIGHT, PATCH = 60, 44, 8
LENS = np.array([50.0, 46.0, 29.0, 23.5])
NO_STEP = np.zeros(6)


def _pixels(radiance, valid) -> FramePixels:
    level = np.asarray(radiance, np.float32)
    none = np.zeros(level.shape, bool)
    return FramePixels(
        radiance=np.repeat(level[..., None], 3, axis=2) * np.float32([0.5, 1, 1.5]),
        valid=np.asarray(valid, bool), clipped=none, dark=none, unknown=none, transparent=none,
        num_clamped=0,
    )  # fmt: skip


def test_logarithms_are_of_the_mean_of_what_is_valid_and_shines():
    level = np.arange(1.0, 36).reshape(5, 7)
    valid = np.ones((5, 7), bool)
    valid[0, 0] = False  # three of four are enough
    valid[0, 2:4] = False  # two are not
    level[2, 0] = -1e6  # no light, nor a logarithm
    found = logarithms(_pixels(level, valid), 2)
    assert found.shape == (2, 3)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0, 0], np.log((2 + 8 + 9) / 3), rtol=1e-6)
    assert np.isnan(found[0, 1])
    np.testing.assert_allclose(found[1, 0], np.log((16 + 22 + 23) / 3), rtol=1e-6)
    np.testing.assert_allclose(found[1, 2], np.log((19 + 20 + 26 + 27) / 4), rtol=1e-6)
    whole = logarithms(_pixels(level, valid), 1)
    assert np.isnan(whole[0, 0])
    assert np.isnan(whole[2, 0])
    np.testing.assert_allclose(whole[4, 6], np.log(35), rtol=1e-6)


def test_half_the_size_needs_three_of_four():
    picture = np.arange(35.0, dtype=np.float32).reshape(5, 7)
    picture[0, 1] = picture[2, 2] = picture[3, 3] = np.nan
    found = halved(picture)
    wanted = [[(0 + 7 + 8) / 3, 6, 8], [18, np.nan, 22]]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def _wall(extent: float = 9.0) -> RayScene:
    """A square at z = 0 that faces +z, and before its right half, beyond x = 1.5, another."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * extent
    screen = np.array([[1.5, -9, 0.6], [9, -9, 0.6], [9, 9, 0.6], [1.5, 9, 0.6]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    return RayScene(np.concatenate([corners, screen]).astype(np.float32), triangles)


def _camera(steps=NO_STEP) -> Camera:
    """About 3 before the wall and askew, after ``steps``: turned and moved in its own axes."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (0.2, -0.15, 0.4)).as_matrix()
    pose[:3, 3] = (-0.3, 0.4, 3.0)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(steps[:3]).as_matrix()
    step[:3, 3] = steps[3:]
    return camera_at(pose @ step, LENS, WIDTH, HEIGHT)


def _points(camera: Camera, pixels) -> MeshPoints:
    """Where rays through ``pixels`` meet the wall."""
    origins, towards = camera.rays(np.asarray(pixels, float))
    towards = towards.astype(np.float64)
    point = origins - towards * (origins[:, 2:] / towards[:, 2:])
    normal = np.tile([0.0, 0.0, 1.0], (len(point), 1))
    return MeshPoints(point.astype(np.float64), normal, np.zeros(len(point), np.int32))


def _ramp() -> np.ndarray:
    """A picture that smoothing and interpolating leave as it is, away from its border."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    return (0.31 + 0.017 * column - 0.023 * row).astype(np.float32)


def _shown(surface: MeshPoints, camera: Camera, picture) -> LookedUp:
    return look_up(surface, _wall(), camera, np.asarray(picture, np.float32), PATCH)


INNER = [(12.3, 20.9), (20.1, 30.9), (8.25, 37.7), (24.9, 12.1)]


def test_value_and_patch_are_those_of_the_pixel_that_a_point_lies_on():
    camera = _camera()
    found = _shown(_points(camera, INNER), camera, _ramp())
    assert found.point.tolist() == [0, 1, 2, 3]
    x, y = np.array(INNER).T - 0.5
    np.testing.assert_allclose(found.value, 0.31 + 0.017 * x - 0.023 * y, atol=1e-4)
    wanted = (y.astype(int) // PATCH) * (WIDTH // PATCH + 1) + x.astype(int) // PATCH
    assert found.patch.tolist() == wanted.tolist()
    # The same picture of any size.
    double = np.repeat(np.repeat(_ramp(), 2, axis=0), 2, axis=1)
    again = _shown(_points(camera, INNER), camera, double)
    assert len(again.point)
    np.testing.assert_allclose(again.value, found.value[again.point], atol=0.02)


@pytest.mark.parametrize("towards", [0.0, 1.2])
def test_it_does_not_matter_where_in_its_pixel_a_point_lies(towards):
    """In its middle too, from which the farthest of its pixels are two away each way; also of a
    wall that is seen askew."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", -towards).as_matrix()
    pose[:3, 3] = 3 * pose[:3, 2]
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    at = [(12 + a, 20 + b) for a in (0.01, 0.5, 0.99) for b in (0.01, 0.5, 0.99)]
    assert _shown(_points(camera, at), camera, _ramp()).point.tolist() == [*range(9)]


def test_slopes_are_what_steps_of_the_camera_change():
    camera, step = _camera(), 1e-3
    surface = _points(camera, INNER)
    found = _shown(surface, camera, _ramp())
    for k in range(6):
        one = np.zeros(6)
        one[k] = step
        on, back = (_shown(surface, _camera(way), _ramp()) for way in (one, -one))
        change = (on.value - back.value) / (2 * step)
        np.testing.assert_allclose(found.slope[:, k], change, rtol=5e-3, atol=5e-3)
        assert np.abs(change).max() > 0.05


def test_points_at_the_border_of_a_picture_are_not_looked_up():
    camera = _camera()
    half = np.eye(4)
    half[:3, 3] = (0, 0, 3)
    camera = camera_at(half, LENS, WIDTH, HEIGHT)
    near = [
        ((2.6, 20.0), True), ((2.4, 20.0), False), ((10.0, 2.6), True), ((10.0, 2.4), False),
        ((10.0, HEIGHT - 2.6), True), ((10.0, HEIGHT - 2.4), False),
    ]  # fmt: skip
    surface = _points(camera, [pixel for pixel, _ in near])
    assert _shown(surface, camera, _ramp()).point.tolist() == [
        i for i, (_, seen) in enumerate(near) if seen
    ]
    # As far to the right, where no screen stands.
    moved = surface._replace(point=surface.point * [-1, 1, 1])
    mirrored = replace(camera, intrinsics=(LENS[0], LENS[1], WIDTH - LENS[2], LENS[3]))
    rays = RayScene(_wall().points * np.float32([-1, 1, 1]), _wall().triangles[:, ::-1])
    found = look_up(moved, rays, mirrored, _ramp(), PATCH)
    assert found.point.tolist() == [0, 2, 4]


def test_neither_what_is_hidden_nor_beside_an_edge_nor_behind_is_looked_up():
    camera = camera_at(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3.0], [0, 0, 0, 1]]),
                       LENS, WIDTH, HEIGHT)  # fmt: skip
    edge = LENS[2] + LENS[0] * 1.5 / (3 - 0.6)  # the column on which the screen begins: 60.25
    assert edge > WIDTH
    camera = replace(camera, intrinsics=(LENS[0], LENS[1], LENS[2] - 30, LENS[3]))
    edge -= 30
    pixels = [(edge - 4, 20), (edge - 0.6, 20), (edge + 4, 20)]
    surface = _points(camera, pixels)
    assert _shown(surface, camera, _ramp()).point.tolist() == [0]
    behind = surface._replace(point=surface.point * [1, 1, -1] + [0, 0, 6])
    turned = behind._replace(normal=-behind.normal)
    assert not len(_shown(turned, camera, _ramp()).point)
    # From behind, or along it.
    assert not len(_shown(surface._replace(normal=-surface.normal), camera, _ramp()).point)
    for cosine, seen in ((1.05 * MIN_COSINE, [0]), (0.95 * MIN_COSINE, [])):
        way = camera.eye - surface.point[0]
        way /= np.linalg.norm(way)
        across = np.cross(way, [0.5, 1.0, 0.2])
        across /= np.linalg.norm(across)
        normal = cosine * way + math.sqrt(1 - cosine**2) * across
        leaning = surface._replace(normal=np.tile(normal, (3, 1)))
        assert _shown(leaning, camera, _ramp()).point.tolist()[:1] == seen


@pytest.mark.parametrize("hole", [(1, 0), (0, -2), (-2, 1)])
def test_a_value_needs_all_pixels_that_it_is_made_of(hole):
    """Of a point between four pixels the twelve around: its own, and those of its slope."""
    camera = _camera()
    picture = _ramp()
    row, column = 20 + hole[0], 12 + hole[1]
    picture[row, column] = np.nan
    surface = _points(camera, [(13.0, 21.0), (40.9, 36.1), (24.0, 12.0)])
    found = _shown(surface, camera, picture).point.tolist()
    beside = -1 <= hole[0] <= 2 and -1 <= hole[1] <= 2
    assert (0 in found) == (not beside)
    assert 2 in found


def test_values_are_of_a_smoothed_picture_and_its_border_is_no_light():
    """Weights 1 2 1 each way, of what is known: a single bright pixel leaves a quarter."""
    picture = np.zeros((HEIGHT, WIDTH), np.float32)
    picture[20, 12] = 16
    smooth = np.empty_like(picture)
    _smooth(len(picture), picture, smooth)
    np.testing.assert_allclose(smooth[19:22, 11:14], [[1, 2, 1], [2, 4, 2], [1, 2, 1]])
    assert smooth.sum() == pytest.approx(16)
    picture = np.ones((6, 5), np.float32)
    picture[0, 0] = 2
    picture[3, 2] = np.nan
    smooth = np.empty_like(picture)
    _smooth(len(picture), picture, smooth)
    assert smooth[0, 0] == pytest.approx((2 * 4 + 2 + 2 + 1) / 9)
    assert np.isnan(smooth[3, 2])
    assert np.isfinite(smooth).sum() == 29
    np.testing.assert_allclose(smooth[2:, :][np.isfinite(smooth[2:])], 1)
