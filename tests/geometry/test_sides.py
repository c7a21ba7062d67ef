"""Which side of a face is the surface: cameras, connectivity, and the rest of the room tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import camera_at, look_at, make_capture, ring_of_poses, room_mesh, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.sides import (
    Sides,
    connected_windings,
    sides_from_cameras,
    turned_towards_cameras,
    with_backs,
)
from usdbrdf.model.mesh import ScanMesh, face_normals_and_angles
from usdbrdf.options import IngestOptions
from usdbrdf.transport.rays import RayScene

WIDTH, HEIGHT = 64, 48
INTRINSICS = (40.0, 40.0, 32.0, 24.0)


def _cameras(poses):
    return [camera_at(pose, INTRINSICS, WIDTH, HEIGHT) for pose in poses]


def _mesh(points, triangles, face_object):
    return ScanMesh(
        points=points,
        triangles=triangles,
        corner_normals=corner_normals(points, triangles, 40),
        face_object=face_object,
    )


@pytest.fixture(scope="module")
def room():
    points, triangles, face_object, _ = room_mesh()
    return _mesh(points, triangles, face_object)


def _sides(mesh, cameras):
    rays = RayScene(mesh.points, mesh.triangles)
    return with_backs(sides_from_cameras(mesh, rays, cameras), mesh, rays, referenced=False)


def _wound(mesh, turned):
    triangles = mesh.triangles.copy()
    triangles[turned] = triangles[turned][:, [0, 2, 1]]
    return replace(mesh, triangles=triangles)


def test_a_mesh_that_faces_its_cameras_stays_as_it_is(room):
    sides = _sides(room, _cameras(ring_of_poses(12)))
    assert not sides.turned.any()
    assert not sides.both.any()


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_faces_that_are_turned_are_found_whether_a_frame_shows_them_or_not(room, share):
    turned = np.random.default_rng(3).random(len(room.triangles)) < share
    # Three frames see little of the room, and so do the parts of it that are never in view.
    sides = _sides(_wound(room, turned), _cameras(ring_of_poses(3)))
    assert (sides.turned == turned).mean() > 0.95
    shown = _sides(_wound(room, turned), _cameras(ring_of_poses(12)))
    np.testing.assert_array_equal(shown.turned, turned)


def test_windings_agree_across_an_edge_that_two_faces_use_in_opposite_ways(room):
    part, agrees = connected_windings(room)
    assert agrees.all()  # made by one hand
    turned = np.random.default_rng(5).random(len(part)) < 0.5
    other_part, other = connected_windings(_wound(room, turned))
    np.testing.assert_array_equal(other_part, part)
    for number in np.unique(part):
        of_part = part == number
        assert len(np.unique((other == turned)[of_part])) == 1


def test_a_part_that_no_frame_shows_faces_what_was_seen():
    points, triangles, face_object, _ = room_mesh()
    # A sheet before a wall, behind all cameras, wound towards the wall.
    sheet = np.float32([[1, 0.2, 1], [3, 0.2, 1], [3, 0.2, 2], [1, 0.2, 2]])
    both = np.concatenate([points, sheet])
    number = len(points) + np.int32([[0, 1, 2], [0, 2, 3]])
    owner = np.append(face_object, [9, 9]).astype(np.int32)
    poses = [look_at(np.array([2.0 + 0.1 * k, 1.0, 1.5]), np.array([2.0, 3, 1])) for k in range(4)]
    for faces, towards_wall in ((number, True), (number[:, [0, 2, 1]], False)):
        mesh = _mesh(both, np.concatenate([triangles, faces]), owner)
        assert (face_normals_and_angles(both, faces)[0][:, 1] < 0).all() == towards_wall
        sides = _sides(mesh, _cameras(poses))
        assert (sides.turned[-2:] == towards_wall).all()


def test_a_sheet_seen_from_both_sides_gets_a_second_skin():
    sheet = np.float32([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    faces = np.int32([[0, 1, 2], [0, 2, 3]])
    mesh = _mesh(sheet, faces, np.zeros(2, np.int32))
    middle = np.array([0.5, 0.0, 0.5])
    places = [(0.5, -2, 0.6), (0.4, -2, 0.5), (0.6, -2, 0.5), (0.5, 2, 0.6), (0.4, 2, 0.5)]
    poses = [look_at(np.array(place), middle) for place in places]
    sides = _sides(mesh, _cameras(poses))
    assert sides.both.all()
    assert not sides.turned.any()
    skinned = turned_towards_cameras(mesh, sides, None, 40)
    assert len(skinned.triangles) == 4
    normals = face_normals_and_angles(skinned.points, skinned.triangles)[0]
    np.testing.assert_allclose(normals[2:], -normals[:2], atol=1e-6)
    np.testing.assert_allclose(skinned.corner_normals[2:, 0], normals[2:], atol=1e-6)
    # Behind what it is the back of, but hardly.
    gap = (skinned.points[skinned.triangles[2:]] @ normals[0]).ravel()
    assert (gap < -1e-5).all()
    assert (gap > -1e-3).all()


@pytest.mark.parametrize("turned", [False, True])
def test_the_back_of_a_sheet_that_faces_what_frames_see_is_a_surface_of_its_own(turned: bool):
    """A lamp's cover before a wall is bright inside, and does not shine on the wall."""
    points, triangles, face_object, names = room_mesh()
    sheet = np.float32([[1, 0.4, 1], [3, 0.4, 1], [3, 0.4, 2], [1, 0.4, 2]])
    number = len(points) + np.int32([[0, 2, 1], [0, 3, 2]])[:, :: -1 if turned else 1]
    mesh = _mesh(
        np.concatenate([points, sheet]),
        np.concatenate([triangles, number]),
        np.append(face_object, [len(names)] * 2).astype(np.int32),
    )
    # They see the wall beside the sheet, but not the sheet's other side.
    poses = [
        look_at(np.array([2.0 + 0.1 * k, 2.5, 1.5]), np.array([2.0, 0, 1.5])) for k in range(5)
    ]
    sides = _sides(mesh, _cameras(poses))
    assert (sides.turned[-2:] == turned).all()
    assert not sides.both.any()
    # The lamp below the ceiling is another such sheet; floor, walls, ceiling and box are not.
    lamp = names.index("lamp")
    assert set(mesh.face_object[sides.faces_room].tolist()) == {lamp, len(names)}
    assert sides.faces_room[-2:].all()
    skinned = turned_towards_cameras(mesh, sides, None, 40)
    assert len(skinned.triangles) == len(mesh.triangles) + sides.skins.sum()
    normals = face_normals_and_angles(skinned.points, skinned.triangles)[0]
    np.testing.assert_allclose(normals[-2:], [[0, -1, 0]] * 2, atol=1e-6)
    rays = RayScene(mesh.points, mesh.triangles)
    assert not with_backs(sides, mesh, rays, referenced=True).skins.any()


def _sofa(noise: float):
    """Front, top and two sides, open behind and below, before a wall; several thousand faces."""
    rng = np.random.default_rng(2)
    n = 24
    u, v = (one.ravel() for one in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n)))
    corner, wide, deep, high = np.array([1.0, 0.1, 0.0]), 2.0, 0.8, 0.7
    o = np.zeros_like(u)
    sheets = [
        np.stack([wide * u, o + deep, high * v], axis=1),
        np.stack([wide * u, deep * v, o + high], axis=1),
        np.stack([o, deep * u, high * v], axis=1),
        np.stack([o + wide, deep * u, high * v], axis=1),
    ]
    cell = np.arange((n - 1) * n).reshape(n - 1, n)[:, :-1].ravel()
    quads = np.stack([cell, cell + 1, cell + n, cell + 1, cell + n + 1, cell + n], axis=1)
    one = quads.reshape(-1, 3)
    faces = np.concatenate([one + k * n * n for k in range(len(sheets))])
    points = np.concatenate(sheets) + corner
    # What was shared stays so.
    rounded = np.unique(points.round(6), axis=0, return_inverse=True)[1].ravel()
    points += noise * rng.standard_normal((rounded.max() + 1, 3))[rounded]
    return points.astype(np.float32), faces.astype(np.int32)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_what_hangs_together_has_a_back_as_a_whole_or_none(noise: float):
    """A patchwork of second skins would let light through the gaps, and its charts need room."""
    points, triangles, face_object, names = room_mesh()
    more, faces = _sofa(noise)
    mesh = _mesh(
        np.concatenate([points, more]),
        np.concatenate([triangles, len(points) + faces]),
        np.append(face_object, np.full(len(faces), len(names))).astype(np.int32),
    )
    sides = _sides(mesh, _cameras(ring_of_poses(12)))
    sofa = sides.skins[len(triangles) :] & ~sides.both[len(triangles) :]
    assert sofa.mean() in (0, 1)


@pytest.mark.parametrize("larger", [0.0, 0.3])
@pytest.mark.parametrize("gap", [0.0, 1e-5, 1e-4])
def test_a_sheet_whose_back_the_file_has_gets_no_other(gap: float, larger: float):
    """But one that lies on a larger one, of which frames see the rim, has none."""
    points, triangles, face_object, names = room_mesh()
    sheet = np.float32([[1, 0.4, 1], [3, 0.4, 1], [3, 0.4, 2], [1, 0.4, 2]])
    way = np.float32([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    behind = sheet - np.float32([0, gap, 0]) + np.float32(larger) * way
    number = np.int32([[0, 2, 1], [0, 3, 2]])
    faces = np.concatenate([triangles, len(points) + number, len(points) + 4 + number[:, ::-1]])
    owner = np.append(face_object, np.repeat([len(names), len(names) + 1], 2)).astype(np.int32)
    mesh = _mesh(np.concatenate([points, sheet, behind]), faces, owner)
    places = [(2.0 + 0.1 * k, 2.5, 1.5) for k in range(5)]
    poses = [look_at(np.array(place), np.array([2.0, 0, 1.5])) for place in places]
    skins = _sides(mesh, _cameras(poses)).skins[-4:]
    assert skins.all() == skins.any() == (larger > 0)


def test_normals_turn_with_their_faces_and_missing_ones_are_made(room):
    turned = np.arange(len(room.triangles)) % 2 == 0
    right = corner_normals(room.points, room.triangles, 40)
    wrong = _wound(room, turned)
    flipped = np.where(turned[:, None, None], -right[:, [0, 2, 1]], right)
    nothing = np.zeros(len(turned), np.bool_)
    frames = np.zeros((len(turned), 2), np.int32)
    part, _ = connected_windings(room)
    sides = Sides(turned=turned, both=nothing, frames=frames, part=part, faces_room=nothing)
    given_all = np.ones(len(turned), np.bool_)
    given = turned_towards_cameras(replace(wrong, corner_normals=flipped), sides, given_all, 40)
    np.testing.assert_array_equal(given.triangles, room.triangles)
    np.testing.assert_array_equal(given.corner_normals, right)
    # Normals that were right although the winding was not stay as they are.
    kept = np.where(turned[:, None, None], right[:, [0, 2, 1]], right)
    given = turned_towards_cameras(replace(wrong, corner_normals=kept), sides, given_all, 40)
    np.testing.assert_array_equal(given.corner_normals, right)
    made = turned_towards_cameras(wrong, sides, None, 40)
    np.testing.assert_array_equal(made.corner_normals, right)


@pytest.mark.fault("G3")
def test_a_capture_with_turned_faces_is_the_same_scan(tmp_path):
    made = make_capture(tmp_path / "right")
    expected = read_scan(made.folder, IngestOptions())
    turned = np.random.default_rng(1).random(len(made.triangles)) < 0.3
    turned |= made.face_object == made.names.index("box")
    triangles = made.triangles.copy()
    triangles[turned] = triangles[turned][:, [0, 2, 1]]
    write_ply(made.folder / "mesh.ply", made.points, triangles, made.face_object)
    scan = read_scan(made.folder, IngestOptions())
    corner = scan.mesh.points[scan.mesh.triangles]
    of_expected = expected.mesh.points[expected.mesh.triangles]
    np.testing.assert_array_equal(np.sort(corner, axis=1), np.sort(of_expected, axis=1))
    np.testing.assert_allclose(
        face_normals_and_angles(scan.mesh.points, scan.mesh.triangles)[0],
        face_normals_and_angles(expected.mesh.points, expected.mesh.triangles)[0],
        atol=1e-6,
    )
    assert scan.counts["faces_turned"] == turned.sum()
    assert any("[mesh.winding]" in sentence for sentence in scan.warnings)
    assert "faces_turned" not in expected.counts
