"""What rays meet of a lit scene: whose it is, where, and which way it faces."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at
from usdbrdf.transport.lit_scene import LitScene, points_of_rays, points_of_texels, sub_pixel_points

# Two squares in the plane z = 0, the second one turned away from z, with nothing between them.
LEFT, RIGHT = 0, 1


@pytest.fixture(scope="module")
def world() -> World:
    return world_of([
        quad((-1.5, -0.5, 0), (1, 0, 0), (0, 1, 0)), quad((0.5, -0.5, 0), (0, 1, 0), (1, 0, 0)),
    ])  # fmt: skip


@pytest.fixture(scope="module")
def lit(world: World) -> LitScene:
    shines = world.per_object([(1, 1, 1), (0, 0, 0)])
    return world.lit(world.per_object([(3, 2, 1), (0.5, 0.5, 0.5)]), emission=shines)


def test_every_face_has_its_object_and_what_met_none_has_none(lit: LitScene):
    assert lit.owner(np.array([0, -1, 1, 2, 3, -1])).tolist() == [0, -1, 0, 1, 1, -1]
    assert lit.diagonal_m == pytest.approx(np.hypot(3, 1))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_ray_s_point_lies_on_the_surface_and_faces_where_the_ray_comes_from(
    lit: LitScene, side: float
):
    at = np.array([[-1.2, 0.3], [-0.6, -0.4], [0.0, 0.0], [0.7, 0.1], [1.4, -0.3]])
    origin = np.array([[0.2, 0.1, 2 * side]] * len(at))
    towards = np.column_stack([at, np.zeros(len(at))]) - origin
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    found = points_of_rays(lit, origin, towards)
    met = [0, 1, 3, 4]
    assert lit.owner(found.face).tolist() == [LEFT, LEFT, -1, RIGHT, RIGHT]
    np.testing.assert_allclose(
        found.position[met], np.column_stack([at, 0 * at[:, 0]])[met], atol=1e-6
    )
    np.testing.assert_allclose(found.normal[met], np.tile([0, 0, side], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(found.to_camera, -towards)
    # A ray that meets nothing has nowhere to be but where it began.
    np.testing.assert_allclose(found.position[2], origin[2], rtol=1e-6)
    assert lit.emits(found).tolist() == [True, True, False, False, False]


def test_a_texel_s_point_is_seen_from_where_the_eye_is(world: World):
    eye, index = np.array([0.3, -0.2, 1.5]), np.array([0, 17, 70, 127])
    found = points_of_texels(world.texels, index, eye)
    np.testing.assert_allclose(found.position, world.texels.position[index])
    away = eye - world.texels.position[index]
    np.testing.assert_allclose(
        found.to_camera, away / np.linalg.norm(away, axis=1, keepdims=True), rtol=1e-6
    )
    assert found.normal[:, 2].tolist() == pytest.approx([1, 1, -1, -1])
    each = points_of_texels(world.texels, index, np.tile(eye, (4, 1)))
    np.testing.assert_array_equal(each.to_camera, found.to_camera)


def test_pixels_count_where_all_of_them_shows_the_object(lit: LitScene):
    """A camera 4 m above the plane, 20 pixels to a metre: the left square is 20 pixels wide."""
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = camera_at(pose, np.array([80.0, 80, 40, 30]), 80, 60)
    offsets = np.array([[0.0, 0], [-0.4, -0.4], [0.4, 0.4]])
    # The square's edges lie at 10 and 30 from the left, at 20 and 40 from the top.
    pixels = np.array(
        [[20.0, 30], [10.3, 30], [10.5, 30], [29.5, 30], [29.7, 30], [20, 20.3], [60, 30]]
    )
    whole, points = sub_pixel_points(lit, camera, pixels, LEFT, offsets)
    assert whole.tolist() == [True, False, True, True, False, False, False]
    wanted = (pixels[whole][:, None] + offsets).reshape(-1, 2)
    wanted = (wanted - [40, 30]) / [20, -20]
    np.testing.assert_allclose(points.position[:, :2], wanted, atol=1e-5)
