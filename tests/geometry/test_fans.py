"""Points are shared by faces that hang together around them, and by no others."""

import numpy as np

from usdbrdf.geometry.fans import point_of_each_fan
from usdbrdf.model.mesh import is_closed

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)


def points_of_faces(triangles):
    """The same corners, and how many points there are."""
    points, found = point_of_each_fan(triangles)
    np.testing.assert_array_equal(points[found], triangles)
    return found, len(points)


def test_a_sound_mesh_stays_as_it_is():
    for triangles in (TETRAHEDRON, TETRAHEDRON[:2], TETRAHEDRON[::-1]):
        found, count = points_of_faces(triangles)
        np.testing.assert_array_equal(found, triangles)
        assert count == 4
    assert is_closed(points_of_faces(TETRAHEDRON)[0])


def test_a_third_face_at_an_edge_stands_alone():
    found, count = points_of_faces(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.int32))
    assert count == 9
    assert len(np.unique(found)) == 9


def test_faces_that_run_alike_along_their_edge_do_not_hang_together():
    assert points_of_faces(np.array([[0, 1, 2], [0, 1, 3]], np.int32))[1] == 6


def test_bodies_that_touch_in_a_point_have_one_each():
    other = np.where(TETRAHEDRON == 3, 3, TETRAHEDRON + 4).astype(np.int32)
    both = np.concatenate([TETRAHEDRON, other])
    both = np.unique(both, return_inverse=True)[1].reshape(-1, 3).astype(np.int32)
    found, count = points_of_faces(both)
    assert count == 8
    assert not set(found[:4].ravel()) & set(found[4:].ravel())
    assert is_closed(found)


def test_no_faces_have_no_points():
    points, found = point_of_each_fan(np.zeros((0, 3), np.int32))
    assert len(points) == 0
    assert found.shape == (0, 3)
