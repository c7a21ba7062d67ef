"""Lamps of known shape: kind, size, pose and radiance of the lights that stand for them."""

import math

import numpy as np
import pytest
import trimesh

from usdbrdf.shading.lamp_shapes import lamp_shapes

WARM = np.array([8.0, 4.0, 2.0])


def lights_of(mesh, radiance=WARM, turn=True):
    """With the lamp turned and moved, so that no axis is a special one."""
    mesh = mesh.copy()
    if turn:
        mesh.apply_transform(trimesh.transformations.euler_matrix(0.3, -0.7, 1.1))
        mesh.apply_translation([1.0, -2.0, 3.0])
    shines = np.broadcast_to(radiance, (len(mesh.faces), 3))
    return mesh, lamp_shapes(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), shines.astype(np.float32)
    )


def polygon(corners, radius=0.5):
    """A flat fan that faces +z."""
    angle = 2 * math.pi * np.arange(corners) / corners
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(corners)])
    faces = [[0, i, i + 1] for i in range(1, corners - 1)]
    return trimesh.Trimesh(ring, faces, process=False)


def power(lights):
    areas = {"rectangle": 1.0, "disk": math.pi / 4, "sphere": math.pi}
    return sum(areas[x.kind] * x.size[0] * x.size[1] * np.array(x.radiance) for x in lights)


def test_a_box_is_six_rectangles():
    mesh, lights = lights_of(trimesh.creation.box([1.2, 0.7, 0.1]))
    assert {light.kind for light in lights} == {"rectangle"}
    sides = np.sort([sorted(light.size) for light in lights], axis=0)
    expected = np.sort([(0.1, 0.7)] * 2 + [(0.1, 1.2)] * 2 + [(0.7, 1.2)] * 2, axis=0)
    assert sides == pytest.approx(expected, abs=1e-4)
    assert power(lights) == pytest.approx(mesh.area * WARM, rel=1e-3)


def test_lights_face_away_from_the_lamp_and_clear_it():
    mesh, lights = lights_of(trimesh.creation.box([1.2, 0.7, 0.1]))
    for light in lights:
        pose = light.world_from_light
        assert pose[:3, :3].T @ pose[:3, :3] == pytest.approx(np.eye(3), abs=1e-5)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1, abs=1e-5)
        towards = -pose[:3, 2]
        height = (mesh.vertices - pose[:3, 3]) @ towards
        assert -5e-3 < height.max() < 0  # all of the lamp is just behind
        # Width and height lie along its own x and y.
        seen = (mesh.vertices - pose[:3, 3]) @ pose[:3, :2]
        assert np.ptp(seen, axis=0) == pytest.approx(light.size, abs=1e-3)


def test_a_round_plate_is_a_disc():
    _, (light,) = lights_of(polygon(24))
    assert light.kind == "disk"
    assert light.size[0] == pytest.approx(2 * 0.5 * math.sqrt(0.9886), rel=1e-3)  # equal area
    assert light.radiance == pytest.approx(tuple(WARM))


@pytest.mark.parametrize("corners", [3, 5, 6, 8])
def test_a_polygon_of_few_corners_is_neither(corners):
    assert lights_of(polygon(corners))[1] == ()


def test_a_ball_is_a_sphere_that_encloses_it_and_has_its_power():
    mesh, (light,) = lights_of(trimesh.creation.icosphere(subdivisions=3, radius=0.18))
    assert light.kind == "sphere"
    assert light.world_from_light[:3, 3] == pytest.approx([1, -2, 3], abs=1e-5)
    distance = np.linalg.norm(mesh.vertices - light.world_from_light[:3, 3], axis=1)
    assert distance.max() < light.size[0] / 2 < 1.002 * 0.18
    assert power([light]) == pytest.approx(mesh.area * WARM, rel=1e-4)
    assert light.radiance == pytest.approx(tuple(WARM), rel=0.02)


def test_noise_of_a_scan_changes_little():
    rng = np.random.default_rng(3)
    plate = trimesh.creation.box([1.0, 1.0, 0.2]).subdivide().subdivide().subdivide()
    plate.vertices += rng.normal(0, 0.002, plate.vertices.shape)
    mesh, lights = lights_of(plate)
    assert len(lights) == 6
    assert power(lights) == pytest.approx(mesh.area * WARM, rel=0.03)


def test_a_light_has_the_mean_radiance_of_its_side():
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    up = box.face_normals[:, 2] > 0.5
    shines = np.where(up[:, None], WARM, 0.01 * WARM)
    _, lights = lights_of(box, shines, turn=False)
    # The others give 5 % of the power: too much to be dropped.
    assert len(lights) > 3
    assert -lights[0].world_from_light[:3, 2] == pytest.approx([0, 0, 1])
    assert lights[0].radiance == pytest.approx(tuple(WARM))


def ring():
    return trimesh.creation.annulus(r_min=0.3, r_max=0.5, height=0.02)


def half_ball():
    ball = trimesh.creation.icosphere(subdivisions=3)
    return ball.submesh([ball.triangles_center[:, 2] > 0], append=True)


def tube():
    return trimesh.creation.cylinder(radius=0.02, height=1.0)


@pytest.mark.parametrize("shape", [ring, half_ball, tube])
def test_other_shapes_stay_as_they_are(shape):
    assert lights_of(shape())[1] == ()


def test_what_emits_nothing_has_no_light():
    assert lights_of(polygon(24), np.zeros(3))[1] == ()
