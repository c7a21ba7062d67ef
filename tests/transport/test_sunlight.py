"""The sun: shadows and their edges on texels, its highlights, and how it leaves a picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import quad, world_of
from usdbrdf.transport.environment import (
    Environment,
    Sun,
    directions_of_pixels,
    pixels_of_directions,
    solid_angles,
    with_sun_apart,
)
from usdbrdf.transport.lit_scene import SurfacePoints, TexturedScene
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.sunlight import sunlight, sunlit

TOWARDS = np.array([0.3, -0.4, np.sqrt(0.75)])
IRRADIANCE = np.array([5.0, 4.0, 2.0])


def _surface(world):
    return TexturedScene(world.scene, world.texels, world.rays)


def _floor_under(height: float):
    """A floor of 8 m, and a roof over the half of it where x < 0, seen from below."""
    return world_of([
        quad((-4, -4, 0), (8, 0, 0), (0, 8, 0), (64, 64)),
        quad((-40, -40, height), (0, 80, 0), (40, 0, 0)),
    ])  # fmt: skip


@pytest.mark.parametrize("z_up", [False, True])
def test_pixels_and_directions_agree(z_up: bool):
    directions = directions_of_pixels(12, 24, z_up)
    found = pixels_of_directions(directions.reshape(-1, 3), 12, 24, z_up)
    np.testing.assert_array_equal(found, np.arange(12 * 24))
    assert directions[0, :, 2 if z_up else 1].min() > 0.9
    # The middle column looks along +z of a y-up world.
    ahead = directions[6, 12]
    assert (-ahead[1] if z_up else ahead[2]) > 0.9
    assert solid_angles(12, 24).sum() * 24 == pytest.approx(4 * np.pi)


def test_a_surface_in_the_open_gets_the_cosine_law():
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))])
    every = np.arange(len(world.texels))
    found = sunlight(_surface(world), every, Sun(TOWARDS, IRRADIANCE), 0)
    np.testing.assert_allclose(found, np.tile(IRRADIANCE * TOWARDS[2], (len(every), 1)), rtol=1e-6)
    below = Sun(TOWARDS * [1, 1, -1], IRRADIANCE)
    assert not sunlight(_surface(world), every, below, 0).any()
    assert not sunlight(_surface(world), every, Sun(TOWARDS, np.zeros(3)), 0).any()


@pytest.mark.parametrize("fold", [-0.3, 0.3])
def test_a_folded_surface_does_not_shade_itself(fold: float):
    """Texels along the fold reach beyond their triangle, where it is hollow below the other one."""
    flat = quad((0, 0, 0), (1, 0, 0), (0, 1, 0), (16, 16))
    points = flat.points + np.array([[0, 0, 0], [0, 0, fold], [0, 0, 0], [0, 0, fold]])
    corners = points[flat.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normals = np.repeat(normal[:, None], 3, axis=1)
    world = world_of([replace(flat, points=points, normals=normals)])
    every = np.arange(len(world.texels))
    found = sunlit(_surface(world), every, Sun(np.array([0.0, 0, 1]), IRRADIANCE), 0)
    np.testing.assert_allclose(found, world.texels.normal[:, 2], rtol=1e-6)


@pytest.mark.parametrize("half_angle", [1e-6, 0.05])
def test_the_edge_of_a_shadow_lies_where_it_must_and_is_as_soft(half_angle: float):
    height = 2.0
    world = _floor_under(height)
    floor = np.arange(*world.texels.of_object(0).indices(len(world.texels)))
    sun = Sun(TOWARDS, IRRADIANCE, half_angle)
    share = sunlit(_surface(world), floor, sun, 0) / TOWARDS[2]
    # The roof's edge, x = 0, throws its shadow along the ray.
    edge = -height * TOWARDS[0] / TOWARDS[2]
    x = world.texels.position[floor, 0]
    reach = 8 / 64 + 2 * height * np.tan(half_angle) / TOWARDS[2] ** 2
    assert not share[x < edge - reach].any()
    assert (share[x > edge + reach] > 1 - 1e-6).all()
    columns = [share[np.abs(x - value) < 0.02].mean() for value in np.unique(x.round(2))]
    assert (np.diff(columns) > -0.05).all()
    # All that is missing of the light is in front of the edge: its place to a tenth of a texel.
    assert 8 - 8 / 64 * np.sum(columns) == pytest.approx(edge + 4, abs=0.02)


def test_a_lobe_mirrors_the_sun_as_it_mirrors_a_lamp_as_large():
    # The same disc once as the sun, once as pixels of a picture, which the lobe's rays must find.
    world = world_of([quad((-1, -1, 0), (2, 0, 0), (0, 2, 0))])
    directions = directions_of_pixels(180, 360, True)
    disc = directions @ TOWARDS > np.cos(0.06)
    solid = np.repeat(solid_angles(180, 360)[:, None], 360, axis=1)[disc].sum()
    picture = np.zeros((180, 360, 3), np.float32)
    picture[disc] = IRRADIANCE / solid
    half_angle = float(np.sqrt(solid / np.pi))
    black = np.zeros((1, 1, 3), np.float32)
    mirrored = TOWARDS * [-1, -1, 1]
    count = 20_000
    points = SurfacePoints(
        np.zeros(count, np.int32),
        *np.full((2, count), 0.25, np.float32),
        np.tile(np.float32([0.1, 0.2, 0]), (count, 1)),
        np.tile(np.float32([0, 0, 1]), (count, 1)),
        np.tile(mirrored.astype(np.float32), (count, 1)),
    )
    found = []
    for environment in (
        Environment(black, True).under(Sun(TOWARDS, IRRADIANCE, half_angle)),
        Environment(picture, True),
    ):
        lit = world.lit(world.per_object([(0, 0, 0)]), environment=environment)
        phi, psi = np.full((2, count), 0.2, np.float32)
        found.append(lobe_radiance(lit, points, phi, psi, 16, 3).mean(axis=0))
    np.testing.assert_allclose(found[0], found[1], rtol=0.03)
    assert found[0][0] > 0


def test_the_sun_of_a_picture_is_taken_apart_and_all_light_stays():
    sky = np.full((90, 180, 3), 0.5, np.float32)
    same = with_sun_apart(sky, False)
    assert not same.sun.shines
    np.testing.assert_array_equal(same.image, sky)
    directions = directions_of_pixels(90, 180, False)
    towards = directions[20, 50]
    disc = directions @ towards > np.cos(0.03)
    sky[disc] += np.float32([3000, 2000, 1000])
    solid = np.repeat(solid_angles(90, 180)[:, None], 180, axis=1)
    found = with_sun_apart(sky, False)
    expected = (np.float64([3000, 2000, 1000]) * solid[disc][:, None]).sum(axis=0)
    np.testing.assert_allclose(found.sun.irradiance, expected, rtol=1e-5)
    assert found.sun.direction @ towards > np.cos(0.005)
    np.testing.assert_allclose(found.image, 0.5)


def test_no_sun_comes_around_the_corner_of_a_room():
    # Sun from behind a wall that ends at the floor's edge: the floor's border texels reach beyond.
    world = world_of([
        quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (15, 15)),
        quad((0.1, -4, -1), (0, 0, 30), (0, 12, 0)),
    ])  # fmt: skip
    sun = Sun(np.array([-0.6, 0.0, 0.8]), IRRADIANCE)
    floor = np.arange(*world.texels.of_object(0).indices(len(world.texels)))
    share = sunlit(_surface(world), floor, sun, 0)
    inside = world.texels.position[floor, 0] > 0.1
    assert not share[inside].any()
    assert inside.mean() > 0.9
