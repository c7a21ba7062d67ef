"""The light that lobes send on, in a room that is equally bright all over."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from tests.physics.surfaces import World, room, world_of
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import specular_irradiance

RGB = np.array([3.0, 2.0, 1.0])
LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.5])
CEILING = 1  # its place among the room's six objects
POINT, UP = (0.5, -0.3, 0.0), (0.0, 0.0, 1.0)
REPEAT = 4096


@pytest.fixture(scope="module")
def world() -> World:
    return world_of(room(tuple(LOW), tuple(HIGH)))


def _lit(world: World, emits: int | None = None) -> LitScene:
    radiance = world.per_object([tuple(RGB)] * 6)
    mask = world.per_object([(float(i == emits),) * 3 for i in range(6)])
    return world.lit(radiance, emission=mask)


def _found(lit: LitScene, phi: float, psi: float, seed: int = 0) -> np.ndarray:
    """(REPEAT, 3) estimates at one point of the floor."""
    tiled = (np.tile(np.array(v, np.float32), (REPEAT, 1)) for v in (POINT, UP))
    lobe = (np.full(6, value, np.float32) for value in (phi, psi))
    numbers = np.arange(REPEAT)
    return specular_irradiance(lit, *tiled, numbers, *lobe, rays=4, rays_of_lobe=8, seed=seed)


def _expected(phi: float, psi: float, without_ceiling: bool = False) -> np.ndarray:
    """Quadrature over the cosine-weighted hemisphere of the walls' directional albedo."""
    angles = np.linspace(0, np.pi / 2, 40)[:-1]
    table = [directional_albedo(angle, phi, psi, steps=100) for angle in angles]
    u, v = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(400) + 0.5) / 400)
    sine, azimuth = np.sqrt(u), 2 * np.pi * v
    w = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.sqrt(1 - u)], axis=-1)
    distance = np.where(w > 0, HIGH - np.array(POINT), LOW - np.array(POINT)) / w
    axis = distance[..., :].argmin(axis=-1)
    cosine = np.abs(np.take_along_axis(w, axis[..., None], axis=-1))[..., 0]
    albedo = np.interp(np.arccos(cosine), angles, table)
    if without_ceiling:
        albedo = np.where(axis == 2, 0, albedo)
    return np.pi * RGB * albedo.mean()


@pytest.mark.parametrize(("phi", "psi"), [(0.05, 1.0), (0.3, 0.5), (0.8, 0.2)])
def test_it_is_the_directional_albedo_of_what_the_point_sees(world: World, phi: float, psi: float):
    found = _found(_lit(world), phi, psi)
    error = found.std(axis=0) / np.sqrt(REPEAT)
    expected = _expected(phi, psi)
    assert (np.abs(found.mean(axis=0) - expected) < 4 * error + 2e-3 * expected).all()
    assert (error < 0.02 * expected).all()


def test_what_emits_reflects_nothing(world: World):
    found = _found(_lit(world, CEILING), 0.3, 1.0).mean(axis=0)
    assert world.scene.corner_normals[2 * CEILING][0][2] == pytest.approx(-1)
    np.testing.assert_allclose(found, _expected(0.3, 1.0, without_ceiling=True), rtol=0.03)


def test_what_leaves_the_scene_brings_nothing(world: World):
    outside = np.tile(np.array((0, 0, -1), np.float32), (8, 1))
    down = np.tile(np.array((0, 0, -1), np.float32), (8, 1))
    lobe = np.ones(6, np.float32)
    found = specular_irradiance(
        _lit(world), outside, down, np.arange(8), lobe, lobe, rays=4, rays_of_lobe=8, seed=0
    )
    np.testing.assert_array_equal(found, 0)


def test_seeds_are_independent(world: World):
    a, b = _found(_lit(world), 0.3, 0.5, seed=0), _found(_lit(world), 0.3, 0.5, seed=9)
    assert abs(np.corrcoef(a[:, 0], b[:, 0])[0, 1]) < 0.1
