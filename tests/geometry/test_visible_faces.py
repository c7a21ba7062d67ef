"""The triangles that drawing finds are those that rays find."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import camera_at, look_at, ring_of_poses, room_mesh
from usdbrdf import kernel
from usdbrdf.geometry import visible_faces as module
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.transport.rays import BOX_FACES, RayScene

SIZE = (160, 120)
LENS = np.array([90.0, 110.0, 77.3, 61.9])


def _traced(rays: RayScene, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    camera = camera_at(pose, LENS, *SIZE)
    origins, directions = camera.rays(camera.pixels())
    hits = rays.closest(origins, directions)
    met = hits.face >= 0
    point = np.where(met[:, None], origins + directions * hits.distance[:, None], 0)
    return hits.face.reshape(SIZE[::-1]), point.reshape(*SIZE[::-1], 3)


def _agree(rays: RayScene, pose: np.ndarray, atol: float = 1e-4) -> np.ndarray:
    face, point = visible_faces(rays, camera_at(pose, LENS, *SIZE))
    expected, where = _traced(rays, pose)
    np.testing.assert_array_equal(face, expected)
    np.testing.assert_allclose(point, where, atol=atol)
    return face


def _soup(count: int, spread: float, edge: float) -> RayScene:
    rng = np.random.default_rng(12345)
    corners = rng.uniform(-spread, spread, (count, 1, 3)) + rng.normal(0, edge, (count, 3, 3))
    return RayScene(
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
    )


@pytest.mark.parametrize(("count", "edge"), [(3000, 0.05), (300, 0.5), (40, 8.0)])
def test_triangles_anywhere_about_the_eye(count: int, edge: float):
    # The eye is among them: many lie behind it or reach from behind to before it.
    rays = _soup(count, 2.0, edge)
    rng = np.random.default_rng(1)
    for _ in range(4):
        pose = look_at(rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3, 3))
        face = _agree(rays, pose)
        assert len(np.unique(face)) >= 3


def test_the_furnished_room_from_within():
    points, triangles, _, _ = room_mesh(subdivisions=3)
    rays = RayScene(points, triangles)
    for pose in ring_of_poses(4):
        assert (_agree(rays, pose) >= 0).all()


def test_edges_through_pixel_centres_are_left_to_rays(monkeypatch):
    # A grid whose lines, seen straight on, run through the centres of pixels: rounding decides.
    x, y = np.meshgrid(np.arange(17) / 16 - 0.5, np.arange(17) / 16 - 0.5)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(16)[:, None] * 17 + np.arange(16)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + 18], 1), np.stack([a, a + 18, a + 17], 1)])
    rays = RayScene(points, triangles.astype(np.int32))
    pose = np.eye(4)
    pose[2, 3] = 1.0
    monkeypatch.setattr(f"{__name__}.LENS", np.array([128.0, 128.0, 80.5, 60.5]))
    asked = []
    trace = rays.closest
    monkeypatch.setattr(
        rays, "closest", lambda *arguments: asked.append(len(arguments[0])) or trace(*arguments)
    )
    face, _ = visible_faces(rays, camera_at(pose, LENS, *SIZE))
    np.testing.assert_array_equal(face, _traced(rays, pose)[0])
    assert (face >= 0).sum() > 10_000
    # Every eighth row and column, and the diagonals: a few thousand pixels, not all.
    assert 2000 < asked[0] < 8000


def test_one_surface_on_another_is_left_to_rays():
    rng = np.random.default_rng(3)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    double = np.concatenate([corners, corners + rng.normal(0, 1e-8, (3, 3))]).astype(np.float32)
    rays = RayScene(double, np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    _agree(rays, look_at(np.array([0.3, 0.4, 1.5]), np.zeros(3)))


def test_a_picture_that_is_small_beside_its_mesh_is_traced(monkeypatch):
    points, triangles, _, _ = room_mesh(subdivisions=24)
    rays = RayScene(points, triangles)
    monkeypatch.setattr(f"{__name__}.SIZE", (32, 24))
    monkeypatch.setattr(f"{__name__}.LENS", np.array([18.0, 22.0, 15.3, 12.9]))
    pose = ring_of_poses(1)[0]
    drawn = []
    draw = module._draw
    monkeypatch.setattr(module, "_draw", lambda *given: drawn.append(given) or draw(*given))
    traced = _agree(rays, pose)
    assert not drawn
    monkeypatch.setattr(module, "_CROWDED", 1000)
    np.testing.assert_array_equal(_agree(rays, pose), traced)
    assert drawn


def test_nothing_to_see():
    rays = RayScene(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    away = look_at(np.full(3, 4.0), np.full(3, 9.0))
    face, point = visible_faces(rays, camera_at(away, LENS, *SIZE))
    assert (face == -1).all()
    np.testing.assert_array_equal(point, 0)


def test_the_number_of_threads_changes_nothing(monkeypatch):
    # Without rays, whose own test says the same.
    monkeypatch.setattr(module, "_trace_doubtful", lambda *_: None)
    rays = _soup(3000, 2.0, 0.2)
    pose = look_at(np.zeros(3), np.array([1.0, 2, 0.5]))
    many = visible_faces(rays, camera_at(pose, LENS, *SIZE))
    monkeypatch.setattr(kernel, "num_threads", lambda: 13)
    one = visible_faces(rays, camera_at(pose, LENS, *SIZE))
    np.testing.assert_array_equal(one[0], many[0])
    np.testing.assert_array_equal(one[1], many[1])


def test_boxes_hold_their_triangles():
    rays = _soup(BOX_FACES + 7, 2.0, 0.3)
    corners = rays.points[rays.triangles]
    first, second = corners[:BOX_FACES].reshape(-1, 3), corners[BOX_FACES:].reshape(-1, 3)
    expected = [[part.min(axis=0), part.max(axis=0)] for part in (first, second)]
    np.testing.assert_array_equal(rays.boxes, expected)
