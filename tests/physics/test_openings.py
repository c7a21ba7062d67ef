"""Light that comes in through a window: rays that are sent there find what others find, with less
noise, and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.options import Sampling
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.irradiance import irradiance_at
from usdbrdf.transport.lights import GROUP, Lights, lights_from_radiance, weighed_groups
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.openings import _corners_of, opening_at, openings_of
from usdbrdf.transport.sampling_loops import PointDraws, Receivers, weight_of_opening
from usdbrdf.transport.tile_draws import independent_tiles

# A room of 4 x 4 x 3 m whose wall at x = 4 has a window of 1 x 1 m in its middle.
_LOW, _HIGH = 1.0, 2.0


def _room_with_window() -> World:
    x, y, z = np.eye(3)
    o = np.zeros(3)
    wall = 4 * x
    return world_of([
        quad(o, 4 * x, 4 * y),
        quad(3 * z, 4 * y, 4 * x),
        quad(o, 4 * y, 3 * z),
        quad(o, 3 * z, 4 * x),
        quad(4 * y, 4 * x, 3 * z),
        quad(wall, _LOW * z, 4 * y),
        quad(wall + _HIGH * z, (3 - _HIGH) * z, 4 * y),
        quad(wall + _LOW * z, z, 1.5 * y),
        quad(wall + _LOW * z + 2.5 * y, z, 1.5 * y),
    ])  # fmt: skip


def _sky() -> Environment:
    """Bright above the horizon and many colours, so that no direction is as good as another."""
    rng = np.random.default_rng(5)
    image = rng.uniform(0.5, 1.5, (16, 32, 3)).astype(np.float32)
    image[:8] *= 20
    return Environment(image, z_up=True)


def _lights(world: World, lit: np.ndarray, sky: Environment) -> Lights:
    return lights_from_radiance(world.scene, world.texels, lit, outside=(world.rays, sky))


def _receivers() -> tuple[np.ndarray, np.ndarray]:
    """On the floor and on the wall across from the window."""
    rng = np.random.default_rng(7)
    spot = rng.uniform(0.2, 2.8, (64, 2))
    floor = np.stack([spot[:, 0], spot[:, 1], 0 * spot[:, 0]], axis=1)
    wall = np.stack([0 * spot[:, 0], spot[:, 1], spot[:, 0]], axis=1)
    normals = np.repeat([[0.0, 0, 1], [1, 0, 0]], 64, axis=0)
    return np.concatenate([floor, wall]).astype(np.float32), normals.astype(np.float32)


def _irradiance(world: World, lights: Lights, sky: Environment, rays: int, seed: int) -> np.ndarray:
    lit = world.per_object([(0.1, 0.1, 0.1)] * 9)
    position, normal = _receivers()
    sampling = Sampling(standard_error=0, max_rays=rays, seed=seed)
    return irradiance_at(
        world.rays, world.texture(lit), lights, sky, position, normal,
        independent_tiles(len(position)), sampling, 6.0,
    ).mean.astype(np.float64)  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    return _room_with_window()


def test_the_triangles_of_the_window_are_lights_and_no_others(world: World) -> None:
    lights = _lights(world, world.per_object([(0.1, 0.1, 0.1)] * 9), _sky())
    assert len(lights.face) > 50
    assert (lights.face >= lights.first_opening).all()
    centre = lights.corners.mean(axis=1)
    np.testing.assert_allclose(centre[:, 0], 4, atol=0.01)
    assert (np.abs(centre[:, 1:] - [2.0, 1.5]) < 0.57).all()
    np.testing.assert_allclose(lights.normals, np.tile([[-1.0, 0, 0]], (len(centre), 1)), atol=1e-6)


def test_what_comes_through_the_window_is_the_same_with_less_noise(world: World) -> None:
    sky, lit = _sky(), world.per_object([(0.1, 0.1, 0.1)] * 9)
    lights, none = _lights(world, lit, sky), world.lights(lit)
    assert not len(none.face)
    true = _irradiance(world, none, sky, 1 << 15, 1)
    np.testing.assert_allclose(
        _irradiance(world, lights, sky, 1 << 13, 2).sum(axis=0), true.sum(axis=0), rtol=4e-3
    )
    aimed, blind = (
        ((_irradiance(world, some, sky, 256, 3) - true) ** 2).mean() for some in (lights, none)
    )
    assert aimed < blind / 4


def test_lobes_find_the_window_too(world: World) -> None:
    sky, lit = _sky(), world.per_object([(0.1, 0.1, 0.1)] * 9)
    position, normal = _receivers()
    to_camera = np.array([2.0, 2.0, 1.5]) - position
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    zero, face = np.zeros(len(position), np.float32), np.repeat([0, 4], 64).astype(np.int32)
    points = SurfacePoints(face, zero, zero, position, normal, to_camera.astype(np.float32))

    def found(lights: Lights, rays: int, seed: int) -> np.ndarray:
        scene = LitScene(
            scene=world.scene, texels=world.texels, rays=world.rays, radiance=world.texture(lit),
            lights=lights, emission=world.texture(0 * lit), environment=sky, lobe=DIELECTRIC,
        )  # fmt: skip
        return lobe_radiance(scene, points, zero + 0.7, zero + 0.5, rays, seed).astype(np.float64)

    lights, none = _lights(world, lit, sky), world.lights(lit)
    true = found(none, 1 << 15, 1)
    aimed, blind = found(lights, 64, 2), found(none, 64, 2)
    np.testing.assert_allclose(found(lights, 1 << 13, 3).sum(axis=0), true.sum(axis=0), rtol=4e-3)
    assert ((aimed - true) ** 2).mean() < ((blind - true) ** 2).mean() / 3


def test_nothing_is_an_opening_under_the_open_sky_or_in_the_dark(world: World) -> None:
    lit = world.per_object([(0.1, 0.1, 0.1)] * 9)
    assert not len(_lights(world, lit, black_environment()).face)
    x, y, _ = np.eye(3)
    ground = world_of([quad(np.zeros(3), x, y), quad(y + x, -x, np.array([0, 0, 0.2]))])
    flat = Environment(np.ones((4, 8, 3), np.float32), z_up=True)
    assert not len(_lights(ground, ground.per_object([(0.1, 0.1, 0.1)] * 2), flat).face)


def test_where_nothing_opens_there_is_none_of_anything(world: World) -> None:
    dark = np.zeros(len(world.scene.triangles))
    found = openings_of(world.scene, world.texels, world.rays, dark, black_environment())
    assert len(found.corners) == len(found.area) == len(found.weight) == 0
    assert found.arriving == 0
    assert not found.box.any()


def test_a_ray_leaves_through_the_triangle_that_it_crosses() -> None:
    box = np.array([[-1.0, -2, 0], [0.5, 0.25, 1], [4, 16, 3]])
    corners = _corners_of(box)
    assert len(corners) == 4 * (4 * 16 + 16 * 3 + 3 * 4)
    rng = np.random.default_rng(2)
    for _ in range(500):
        x = rng.uniform([-0.9, -1.9, 0.1], [0.9, 1.9, 2.9])
        w = rng.normal(size=3)
        which, far = opening_at(box, *x, *w)
        a, b, c = corners[which]
        u, v = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), x + far * w - a, rcond=None)[0]
        assert min(u, v, 1 - u - v) > -1e-9
        normal = np.cross(b - a, c - a)
        assert normal @ w < 0
        np.testing.assert_allclose(normal @ (x + far * w - a), 0, atol=1e-9)


def test_a_ray_that_leaves_is_weighed_against_those_that_are_sent_to_where_it_does(
    world: World,
) -> None:
    """By the balance heuristic: cos / (p_cosine + p_light), both per solid angle; pi where none
    could have been sent."""
    sky = Environment(np.ones((4, 8, 3), np.float32), z_up=True)
    lights = _lights(world, world.per_object([(0.1, 0.1, 0.1)] * 9), sky)
    groups, (position, normal) = lights.groups, _receivers()
    count = len(position)
    picks = weighed_groups(groups, position, normal, np.array([0, count]))
    bits = np.zeros((0, 4), np.uint32)
    receivers = Receivers(
        position, normal, PointDraws(bits, bits, 0, np.zeros(0, np.int64)), groups,
        np.zeros(count, np.int32), picks, np.zeros((0, 0), np.float32), np.zeros(0, np.int32),
    )  # fmt: skip
    rng = np.random.default_rng(11)
    through = np.stack([np.full(count, 4.0), *rng.uniform((1.5, _LOW), (2.5, _HIGH), (count, 2)).T])
    towards = through.T - position
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    weighed = 0
    for k in range(count):
        triangle, far = opening_at(lights.box, *position[k], *towards[k])
        number = np.flatnonzero(lights.face == lights.first_opening + triangle)
        cosine = float(normal[k] @ towards[k])
        found = weight_of_opening(receivers, k, towards, k)
        if not len(number):
            assert found == pytest.approx(math.pi)
            continue
        (a, b, c), weighed = lights.corners[number[0]].astype(float), weighed + 1
        across = np.cross(b - a, c - a)
        sent = -(across @ towards[k]) / np.linalg.norm(across)
        group = int(groups.triangles[groups.of_face[lights.first_opening + triangle], GROUP])
        density = lights.density[lights.first_opening + triangle] * picks.ratio[0, group]  # by area
        wanted = cosine / (cosine / math.pi + density * far**2 / sent)
        assert found == pytest.approx(wanted, rel=1e-4)
    assert weighed > count / 2
    # What leaves behind the surface is no light of it.
    assert weight_of_opening(receivers, 0, -np.abs(towards), 0) == pytest.approx(math.pi)


def test_the_openings_bring_what_the_points_inside_receive(world: World) -> None:
    sky = Environment(np.ones((4, 8, 3), np.float32), z_up=True)
    found = openings_of(
        world.scene, world.texels, world.rays, np.zeros(len(world.scene.triangles)), sky
    )
    # All that comes in through 1 m^2 from a sky of 1 lands inside, pi of it.
    assert found.weight.sum() == pytest.approx(1.0, rel=0.02)
