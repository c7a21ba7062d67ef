"""Corner normals: smooth on smooth surfaces, flat at creases, the same every time."""

from __future__ import annotations

import time

import numpy as np
import pytest
import trimesh

from usdbrdf.geometry.normals import corner_normals
from usdbrdf.model import mesh
from usdbrdf.model.mesh import doubled_areas, face_normals_and_angles, welded_ids


def _soup(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Every triangle with vertices of its own, as exporters with seams write it."""
    points = np.asarray(mesh.vertices, np.float32)[mesh.faces].reshape(-1, 3)
    return points, np.arange(len(points), dtype=np.int32).reshape(-1, 3)


def test_normals_of_a_sphere_are_radial_although_no_vertex_is_shared():
    points, triangles = _soup(trimesh.creation.icosphere(subdivisions=3))
    normals = corner_normals(points, triangles, 40)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert normals.dtype == np.float32
    # Triangles of 5 degrees, the largest twice the smallest.
    assert (normals.reshape(-1, 3) * radial).sum(axis=1).min() > np.cos(np.radians(0.7))


def test_faces_of_a_box_stay_flat_and_its_diagonals_do_not_matter():
    points, triangles = _soup(trimesh.creation.box())
    normals = corner_normals(points, triangles, 40)
    expected = np.repeat(face_normals_and_angles(points, triangles)[0][:, None], 3, axis=1)
    np.testing.assert_allclose(normals, expected, atol=1e-7)


def test_a_narrow_bevel_does_not_turn_the_wide_faces_beside_it():
    # A board of 1 m with a bevel of 5 mm all around, 30 degrees down from its front.
    outer, down = 0.505, 0.005 * np.tan(np.radians(30))
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    front = np.c_[0.5 * square, np.zeros(4)]
    rim = np.c_[outer * square, np.full(4, -down)]
    points = np.concatenate([front, rim]).astype(np.float32)
    around = [[4 + k, 4 + (k + 1) % 4, (k + 1) % 4] for k in range(4)]
    inner = [[4 + k, (k + 1) % 4, k] for k in range(4)]
    triangles = np.array([[0, 1, 2], [0, 2, 3], *around, *inner], np.int32)
    normals = corner_normals(points, triangles, 40)
    lean = np.degrees(np.arccos(np.clip(normals[:2, :, 2], -1, 1)))
    assert lean.max() < 0.5
    # The bevel's own inner edge goes over into the front, as smooth surfaces do.
    assert normals[-1, 2, 2] == pytest.approx(1, abs=1e-3)


def test_the_crease_angle_is_the_limit():
    # Two squares that meet at 60 degrees.
    tilt = np.radians(60)
    points = np.array(
        [
            [0, 0, 0],
            [1, 0, 0],
            [1, 1, 0],
            [0, 1, 0],
            [-np.cos(tilt), 0, -np.sin(tilt)],
            [-np.cos(tilt), 1, -np.sin(tilt)],
        ],
        np.float32,
    )
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 0, 3], [4, 3, 5]], np.int32)
    flat = corner_normals(points, triangles, 59)
    smooth = corner_normals(points, triangles, 61)
    np.testing.assert_allclose(flat[0, 0], [0, 0, 1], atol=1e-6)
    # Both squares span 90 degrees at the shared corner, so the normal is half-way.
    half = tilt / 2
    np.testing.assert_allclose(smooth[0, 0], [-np.sin(half), 0, np.cos(half)], atol=1e-6)
    np.testing.assert_allclose(smooth[0, 1], [0, 0, 1], atol=1e-6)


def test_triangles_without_area_neither_count_nor_become_nan():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]], np.int32)
    normals = corner_normals(points, triangles, 180)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(normals[0], [[0, 0, 1]] * 3)


def test_a_mesh_has_the_same_normals_at_any_scale():
    points, triangles = _soup(trimesh.creation.icosphere(subdivisions=2))
    usual = corner_normals(points, triangles, 40)
    tiny = corner_normals(points * np.float32(2.0**-60), triangles, 40)
    np.testing.assert_array_equal(usual, tiny)


def test_a_large_mesh_takes_seconds_and_gives_the_same_bits_twice():
    points, triangles = _soup(trimesh.creation.icosphere(subdivisions=4))
    corner_normals(points, triangles, 40)  # compiles
    many = np.concatenate([points + np.float32(3 * i) for i in range(53)])
    faces = np.arange(len(many), dtype=np.int32).reshape(-1, 3)
    assert len(faces) > 270_000
    start = time.perf_counter()
    first = corner_normals(many, faces, 40)
    assert time.perf_counter() - start < 3
    assert first.tobytes() == corner_normals(many, faces, 40).tobytes()


def test_the_hub_of_a_huge_fan_is_left_flat_instead_of_taking_hours():
    count = 6000
    angle = np.linspace(0, 2 * np.pi, count + 1)
    rim = np.stack([np.cos(angle), np.sin(angle), np.full(count + 1, 0.2)], axis=-1)
    points = np.concatenate([[[0, 0, 0]], rim]).astype(np.float32)
    triangles = np.stack([np.zeros(count), np.arange(1, count + 1), np.arange(2, count + 2)], 1)
    normals = corner_normals(points, triangles.astype(np.int32), 40)
    np.testing.assert_allclose(
        normals[:, 0], face_normals_and_angles(points, triangles.astype(int))[0], atol=1e-6
    )


@pytest.mark.parametrize("count", [0, 1])
def test_small_numbers_of_triangles(count):
    points = np.eye(3, dtype=np.float32)
    triangles = np.array([[0, 1, 2]], np.int32)[:count]
    assert corner_normals(points, triangles, 40).shape == (count, 3, 3)


def test_weld_joins_equal_positions_and_minus_zero():
    points = np.array([[0, 0, 1], [0, 0, 0], [-0.0, 0, 0], [0, 0, 1], [0, 1e-7, 0]], np.float32)
    assert welded_ids(points).tolist() == [1, 0, 0, 1, 2]
    assert welded_ids(points[:0]).tolist() == []


def test_areas_are_those_of_any_number_at_a_time(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(9)
    points, triangles = rng.random((40, 3), np.float32), rng.integers(0, 40, (50, 3))
    # Heron's formula.
    a, b, c = (
        np.linalg.norm(points[triangles[:, k]].astype(float) - points[triangles[:, k - 1]], axis=1)
        for k in range(3)
    )
    half = (a + b + c) / 2
    square = half * (half - a) * (half - b) * (half - c)
    monkeypatch.setattr(mesh, "_AT_A_TIME", 7)
    np.testing.assert_allclose((doubled_areas(points, triangles) / 2) ** 2, square, atol=1e-9)
