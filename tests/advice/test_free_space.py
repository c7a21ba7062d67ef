"""Where cameras can stand, against distances that another program measures."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from tests.advice.plate_room import CABINET, ROOM, frame_poses, mesh
from usdbrdf.advice import free_space
from usdbrdf.advice.free_space import corners_near, free_places, is_enclosed, surface_samples
from usdbrdf.errors import UsageError
from usdbrdf.transport.rays import RayScene

CLEARANCE = 0.3


@pytest.fixture(scope="module")
def room():
    points, triangles, _, _ = mesh()
    return points, triangles, RayScene(points, triangles)


@pytest.fixture(scope="module")
def eyes():
    return np.array([pose[:3, 3] for pose in frame_poses()])


def test_places_are_clear_reached_and_at_a_persons_height(room, eyes):
    points, triangles, rays = room
    found = free_places(rays, eyes, 2, heights=(0.8, 1.7), clearance=CLEARANCE, count=60)
    assert found.in_room
    assert len(found.eye) == 60
    surface = trimesh.Trimesh(points, triangles, process=False)
    distance = cKDTree(trimesh.sample.sample_surface(surface, 400_000, seed=1)[0]).query(found.eye)[
        0
    ]
    assert distance.min() >= CLEARANCE
    low, high = np.array(CABINET)
    assert not ((found.eye > low) & (found.eye < high)).all(axis=1).any()
    assert ((found.eye > 0) & (found.eye < ROOM)).all()
    assert ((found.eye[:, 2] >= 0.8) & (found.eye[:, 2] <= 1.7)).all()
    # Over all of the room, not about its middle alone.
    assert np.ptp(found.eye[:, 0]) > 2.8
    assert np.ptp(found.eye[:, 1]) > 2.0


def test_a_wall_across_keeps_cameras_on_their_side(room, eyes):
    points, triangles, _ = room
    x, (_, y, z) = 2.6, ROOM
    wall = np.array([[x, 0, 0], [x, y, 0], [x, y, z], [x, 0, z]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(points)
    rays = RayScene(np.concatenate([points, wall]), np.concatenate([triangles, faces]))
    here = eyes[eyes[:, 0] < x - 0.3]
    found = free_places(rays, here, 2, heights=(0.5, 2.0), clearance=CLEARANCE, count=50)
    assert len(found.eye) > 10
    assert found.eye[:, 0].max() < x - CLEARANCE


def test_around_an_object_as_far_away_as_the_cameras_were():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    rays = RayScene(ball.vertices.astype(np.float32), ball.faces.astype(np.int32))
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    eyes = np.stack([1.2 * np.cos(turn), 1.2 * np.sin(turn), 0.1 + 0.05 * np.arange(8)], axis=1)
    assert not is_enclosed(rays, eyes)
    found = free_places(rays, eyes, 2, heights=(0.5, 2.0), clearance=0.2, count=40)
    assert not found.in_room
    away = np.linalg.norm(found.eye, axis=1) - 0.3
    assert len(found.eye) == 40
    assert away.min() > 0.6
    assert away.max() < 1.2
    assert ((found.eye[:, 2] >= 0.09) & (found.eye[:, 2] <= 0.46)).all()
    assert np.isnan(found.height).sum() > 20  # there is no ground beside the ball


def test_nobody_is_sent_onto_a_bed():
    hall = trimesh.creation.box(bounds=[[0, 0, 0], [6, 6, 3]])
    hall.invert()
    bed = trimesh.creation.box(bounds=[[1.5, 1.5, 0], [4.5, 4.5, 0.6]])
    both = trimesh.util.concatenate([hall, bed])
    rays = RayScene(both.vertices.astype(np.float32), both.faces.astype(np.int32))
    eyes = np.array([[0.7, 0.7, 1.5], [5.3, 0.7, 1.5], [0.7, 5.3, 1.6], [5.3, 5.3, 1.4]])
    found = free_places(rays, eyes, 2, heights=(0.5, 2.0), clearance=CLEARANCE, count=200)
    assert len(found.eye) > 100
    assert found.eye[:, 2].max() <= 2.0
    np.testing.assert_allclose(found.height, found.eye[:, 2], atol=1e-4)
    inside = np.abs(found.eye[:, :2] - 3).max(axis=1)
    assert inside.min() > 1.5 - 1.0


def test_where_there_is_no_room_there_is_no_place(room, eyes):
    found = free_places(room[2], eyes, 2, heights=(0.5, 2.0), clearance=2.0, count=50)
    assert len(found.eye) == 0


@pytest.mark.parametrize("most", [500, 1000, 3000, 7000, 20_000])
def test_the_clearance_that_is_told_to_be_enough_is(room, eyes, monkeypatch, most):
    """Rounded down it was refused with itself: "--clearance 0.01: ... Take 0.01 or more"."""
    monkeypatch.setattr(free_space, "_NODES", most)
    monkeypatch.setattr(free_space, "_MOST_NODES", most)

    def found(clearance):
        return free_places(room[2], eyes, 2, heights=(0.5, 2.0), clearance=clearance, count=5)

    with pytest.raises(UsageError, match=r"Take .* or more") as refused:
        found(0.01)
    found(float(str(refused.value).split("Take ")[1].split()[0]))


def test_samples_lie_as_close_as_is_asked(room):
    points, triangles, _ = room
    samples = surface_samples(points[triangles].astype(np.float64), 0.1)
    surface = trimesh.Trimesh(points, triangles, process=False)
    anywhere = trimesh.sample.sample_surface(surface, 2000, seed=3)[0]
    assert cKDTree(samples).query(anywhere)[0].max() <= 0.1
    dense = cKDTree(trimesh.sample.sample_surface(surface, 400_000, seed=1)[0])
    assert dense.query(samples)[0].max() < 0.08


def test_of_a_large_ground_only_what_lies_near_is_looked_at():
    side = 1000.0
    ground = np.array([[-side, -side, 0], [side, -side, 0], [side, side, 0], [-side, side, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    low, high = np.array([-5.0, -3.0, -1.0]), np.array([7.0, 2.0, 1.0])
    near = corners_near(ground[triangles], low, high)
    across = np.cross(near[:, 1] - near[:, 0], near[:, 2] - near[:, 0])
    area = np.linalg.norm(across, axis=1).sum() / 2
    assert 12 * 5 <= area < 30 * 20
    assert (across[:, 2] > 0).all()
    assert (near.min(axis=(0, 1))[:2] <= low[:2]).all()
    assert (near.max(axis=(0, 1))[:2] >= high[:2]).all()
    rays = RayScene(ground.astype(np.float32), triangles)
    eyes = np.array([[0.0, 0, 1.6], [1, 0, 1.6], [0, 1, 1.5]])
    found = free_places(rays, eyes, 2, heights=(0.5, 2.0), clearance=0.25, count=50)
    assert len(found.eye)
    assert np.abs(found.eye[:, :2]).max() < 8


def test_a_clearance_that_asks_for_too_much_is_refused(room, eyes):
    with pytest.raises(UsageError, match=r"--clearance 0\.005: .* Take 0\.\d+ or more"):
        free_places(room[2], eyes, 2, heights=(0.5, 2.0), clearance=0.005, count=50)
