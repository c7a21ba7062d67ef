"""Cleaning removes what carries no surface, counts it, and moves nothing."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.geometry.mesh_clean import CleanMesh, clean_mesh


def _sphere(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.int32)


def test_a_clean_mesh_comes_back_bit_for_bit():
    points, triangles = _sphere()
    labels = np.arange(len(triangles), dtype=np.int32) % 3
    clean = clean_mesh(points, triangles, labels)
    assert clean.points.tobytes() == points.tobytes()
    assert clean.triangles.tobytes() == triangles.tobytes()
    assert clean.face_object.tobytes() == labels.tobytes()
    assert set(clean.counts.values()) == {0}


@pytest.mark.fault("G3")
def test_dead_weight_is_removed_and_counted():
    points = np.array(
        [[9, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [0, 0, 0]], np.float32
    )
    triangles = np.array(
        [
            [1, 2, 3],
            [2, 3, 5],  # the same positions, begun elsewhere
            [3, 2, 1],  # the other side stays
            [1, 2, 4],  # three points in line
            [1, 5, 2],  # two vertices at one position
            [2, 2, 3],
        ],
        np.int32,
    )
    clean = clean_mesh(points, triangles, np.arange(6, dtype=np.int32))
    assert clean.triangles.tolist() == [[0, 1, 2], [2, 1, 0]]
    assert clean.points.tolist() == points[1:4].tolist()
    assert clean.face_object.tolist() == [0, 2]
    assert clean.counts == {
        "degenerate_faces": 3,
        "duplicate_faces": 1,
        "nonmanifold_edges": 0,
        "unreferenced_vertices": 3,
    }


def _edges(clean: CleanMesh, index: int) -> np.ndarray:
    """How many triangles of an object share each of its edges, by vertex number."""
    own = clean.triangles[clean.face_object == index]
    edges = np.sort(own[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


@pytest.mark.fault("G4")
def test_surfaces_are_separated_where_more_than_two_faces_meet():
    fan = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    sphere, faces = _sphere(1)
    points = np.concatenate([sphere + np.float32(5), fan])
    triangles = np.concatenate([faces, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]) + len(sphere)])
    labels = np.repeat([3, 7], [len(faces), 3]).astype(np.int32)
    clean = clean_mesh(points, triangles.astype(np.int32), labels)
    assert clean.counts["nonmanifold_edges"] == 1
    assert _edges(clean, 7).max() == 1
    # Nothing has moved, no face is gone, and the sphere is as it was.
    assert clean.points[clean.triangles].tobytes() == points[triangles].tobytes()
    assert clean.face_object.tobytes() == labels.tobytes()
    assert clean.triangles[:-3].tobytes() == faces.tobytes()
    assert clean.points[: len(sphere)].tobytes() == points[: len(sphere)].tobytes()


def test_objects_that_touch_and_leaves_with_two_sides_are_no_damage():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])
    triangles = np.array(
        [
            [0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0],  # a leaf: every edge of it four times
            [0, 1, 4], [1, 0, 5],  # two other objects at its stem
        ],
        np.int32,
    )  # fmt: skip
    labels = np.array([0, 0, 0, 0, 1, 2], np.int32)
    clean = clean_mesh(corners.astype(np.float32), triangles, labels)
    assert set(clean.counts.values()) == {0}
    assert clean.triangles.tolist() == triangles.tolist()


@pytest.mark.fault("G4")
def test_a_broken_soup_keeps_its_good_faces_and_their_labels():
    rng = np.random.default_rng(3)
    lattice = np.stack(np.meshgrid(*[np.arange(3)] * 3), -1).reshape(-1, 3)
    points = np.concatenate([lattice, lattice]).astype(np.float32) * np.float32(0.1)
    triangles = rng.integers(0, len(points), (4000, 3)).astype(np.int32)
    labels = rng.integers(0, 4, 4000).astype(np.int32)
    expected: dict[tuple, int] = {}
    for corners, label in zip(points[triangles].tolist(), labels.tolist(), strict=True):
        a, b, c = np.array(corners)
        if np.linalg.norm(np.cross(b - a, c - a)) > 1e-6:
            turn = min(range(3), key=lambda i: corners[i])
            face = tuple(map(tuple, corners[turn:] + corners[:turn]))
            expected.setdefault(face, label)
    clean = clean_mesh(points, triangles, labels)
    faces = []
    for corners in clean.points[clean.triangles].tolist():
        turn = min(range(3), key=lambda i: corners[i])
        faces.append(tuple(map(tuple, corners[turn:] + corners[:turn])))
    assert dict(zip(faces, clean.face_object.tolist(), strict=True)) == expected
    assert len(faces) == len(expected)
    removed = clean.counts["degenerate_faces"] + clean.counts["duplicate_faces"]
    assert len(faces) + removed == len(triangles)
    assert max(_edges(clean, index).max() for index in range(4)) <= 2


def test_tiny_triangles_are_not_taken_for_degenerate_ones():
    points, triangles = _sphere(1)
    clean = clean_mesh(points * np.float32(1e-4), triangles, np.zeros(len(triangles), np.int32))
    assert len(clean.triangles) == len(triangles)


def test_a_mesh_without_any_area_is_refused():
    triangles = np.array([[0, 1, 2]], np.int32)
    with pytest.raises(InputRefused, match=r"^scan.ply: none of the 1 faces.*\[mesh.empty\]"):
        clean_mesh(np.zeros((3, 3), np.float32), triangles, np.zeros(1, np.int32), label="scan.ply")


def test_reduction_keeps_objects_in_proportion_and_the_small_ones_alive():
    points, triangles = _sphere(4)
    both = np.concatenate([points, points[:42] * 0 + _sphere(1)[0] + np.float32(3)])
    small = _sphere(1)[1] + len(points)
    faces = np.concatenate([triangles, small]).astype(np.int32)
    labels = np.repeat([0, 1], [len(triangles), len(small)]).astype(np.int32)
    clean = clean_mesh(both, faces, labels, decimate=1000)
    sizes = np.bincount(clean.face_object)
    assert len(clean.triangles) <= 1000 + len(small)
    assert sizes[0] == pytest.approx(1000, rel=0.05)
    assert 20 <= sizes[1] <= len(small)
    radius = np.linalg.norm(
        clean.points[np.unique(clean.triangles[clean.face_object == 0])], axis=1
    )
    np.testing.assert_allclose(radius, 1, atol=0.01)
    again = clean_mesh(both, faces, labels, decimate=1000)
    assert again.points.tobytes() == clean.points.tobytes()
    assert again.triangles.tobytes() == clean.triangles.tobytes()


def test_without_pymeshlab_sound_meshes_pass_and_others_end_in_a_sentence(tmp_path, monkeypatch):
    (tmp_path / "pymeshlab.py").write_text("raise ModuleNotFoundError('No module named pymeshlab')")
    monkeypatch.syspath_prepend(str(tmp_path))
    points, triangles = _sphere(1)
    face_object = np.zeros(len(triangles), np.int32)
    assert len(clean_mesh(points, triangles, face_object).triangles) == len(triangles)
    with pytest.raises(EnvironmentFailure, match=r"pymeshlab.*installation.*\[child\.start\]$"):
        clean_mesh(points, np.concatenate([triangles, triangles[:1]]), np.zeros(81, np.int32))
