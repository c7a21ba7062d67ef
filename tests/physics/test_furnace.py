"""The white furnace: in a closed box of albedo rho and uniform emission Le every radiance is the
same, L = Le + rho L, so L = Le / (1 - rho), whatever the shape of the box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.chi2 import assert_same_mean
from tests.physics.surfaces import World, box, estimates, quad, room, world_of
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.geometry.unwrap import TexelSizes, unwrap
from usdbrdf.options import Sampling
from usdbrdf.shading.base_color import albedo_from_irradiance
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels

RHO = np.array([0.2, 0.5, 0.8])
EMITTED = np.array([1.0, 0.5, 0.25])
L = EMITTED / (1 - RHO)


@pytest.fixture(scope="module")
def furnace() -> World:
    """A room with a box floating in it: corners, edges and blockers, and no way out."""
    return world_of(room((0, 0, 0), (4, 3, 2.5)) + box((1, 1, 0.5), (2, 2.2, 1.5)))


def _lit(world: World) -> np.ndarray:
    return np.tile(L.astype(np.float32), (len(world.texels), 1))


def _somewhere_bright(world: World) -> np.ndarray:
    """A radiance from which only lights are made: estimators must not care where they aim."""
    return world.per_object([(1, 1, 1)] * 5 + [(100, 100, 100)] + [(1, 1, 1)] * 6)


def _shade(
    world: World, lights: np.ndarray, estimator: str, rays: int, lit: np.ndarray | None = None
) -> Irradiance:
    lit = _lit(world) if lit is None else lit
    order, tile = tiles_of_texels(world.texels)
    found = irradiance_at(
        world.rays, world.texture(lit), world.lights(lights), black_environment(),
        world.texels.position[order], world.texels.normal[order], tile,
        Sampling(estimator=estimator, standard_error=0.0, max_rays=rays, seed=1), world.size,
    )  # fmt: skip
    back = np.argsort(order)
    return Irradiance(**{name: values[back] for name, values in vars(found).items()})


@pytest.mark.parametrize("estimator", ["cosine", "mis"])
def test_cosine_rays_alone_give_pi_L_without_noise(furnace: World, estimator: str):
    # L cos / (cos / pi) = pi L for every single ray. Uniform radiance makes no lights.
    assert len(furnace.lights(_lit(furnace)).face) == 0
    found = _shade(furnace, _lit(furnace), estimator, 256)
    np.testing.assert_allclose(found.mean, np.tile(np.pi * L, (len(found.mean), 1)), rtol=1e-5)
    assert found.standard_error.max() < 1e-5


@pytest.mark.parametrize("estimator", ["cosine", "mis"])
def test_no_ray_leaves_a_closed_box(furnace: World, estimator: str):
    found = _shade(furnace, _somewhere_bright(furnace), estimator, 1024)
    leaks = np.count_nonzero(found.escaped[furnace.texels.interior])
    assert leaks == 0, f"rays escaped from {leaks} texels"


def test_no_ray_leaves_a_closed_room_with_real_charts():
    # Charts of the real unwrapper, walls that no axis follows: texels at the room's edges and
    # corners must not see past the wall they touch. S / pi = 1 at every one of them.
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    walls = [
        quad(*((part.points[[0, 1, 3]] - [[0, 0, 0], part.points[0], part.points[0]]) @ turn.T))
        for part in room((0.123, 0.377, -1.01), (4.2, 3.3, 2.5))
    ]
    scene = world_of(walls).scene
    uv, resolution = unwrap(scene, TexelSizes.even(scene, 0.07))
    scene = replace(scene, corner_uv=uv)
    world = World(scene=scene, texels=texels_from_atlas(scene, resolution))
    order, tile = tiles_of_texels(world.texels)
    ones = np.ones((len(order), 3), np.float32)
    found = irradiance_at(
        world.rays, world.texture(ones), world.lights(ones), black_environment(),
        world.texels.position[order], world.texels.normal[order], tile,
        Sampling(standard_error=0.0, max_rays=64), world.size,
    )  # fmt: skip
    leaks = found.escaped > 0
    assert not leaks.any(), f"{leaks.sum()} of {len(leaks)} texels, up to {found.escaped.max():.0%}"
    np.testing.assert_allclose(found.mean, np.pi, rtol=1e-4)


def test_lights_in_the_list_do_not_change_the_answer(furnace: World):
    # S = pi L still, now with noise: half of the rays go to one wall.
    lights = furnace.lights(_somewhere_bright(furnace))
    assert len(lights.face) == 2
    pick = np.random.default_rng(12345).choice(len(furnace.texels), 40, replace=False)
    replicates, _ = estimates(
        furnace, _lit(furnace), lights,
        furnace.texels.position[pick], furnace.texels.normal[pick],
        estimator="mis", rays=128, repeat=64, seed=1,
    )  # fmt: skip
    assert_same_mean(replicates, np.pi * L)


def test_the_furnace_is_a_fixed_point_of_emission_plus_reflection(furnace: World):
    # L = Le + rho S / pi, with S out of the estimator and nothing else.
    found = _shade(furnace, _somewhere_bright(furnace), "mis", 1024)
    area = furnace.texels.area / furnace.texels.area.sum()
    mean = area @ found.mean
    np.testing.assert_allclose(EMITTED + RHO * mean / np.pi, L, rtol=2e-3)


def test_bounce_by_bounce_the_furnace_fills_from_darkness(furnace: World):
    # L_k = Le + rho S(L_k-1) / pi = L (1 - rho^k), where every S comes out of the estimator.
    area = (furnace.texels.area / furnace.texels.area.sum())[:, None]
    lit = np.zeros((len(furnace.texels), 3), np.float32)
    for bounces in range(1, 9):
        found = _shade(furnace, _somewhere_bright(furnace), "mis", 256, lit)
        lit = (EMITTED + RHO * found.mean / np.pi).astype(np.float32)
        mean = (area * lit).sum(axis=0)
        np.testing.assert_allclose(mean, L * (1 - RHO**bounces), rtol=2e-3)


def test_the_albedo_of_the_reflected_part_comes_back(furnace: World):
    # What leaves a texel without its own emission is L - Le = rho L, and S = pi L.
    found = _shade(furnace, _lit(furnace), "mis", 64)
    reflected = np.tile((L - EMITTED).astype(np.float32), (len(furnace.texels), 1))
    rho, known = albedo_from_irradiance(reflected, found.mean, 1e-6)
    assert known.all()
    np.testing.assert_allclose(rho, np.tile(RHO, (len(rho), 1)), rtol=1e-5)
    # With its emission it looks like rho = 1: that is why emitters are told apart.
    emitting, _ = albedo_from_irradiance(_lit(furnace), found.mean, 1e-6)
    np.testing.assert_allclose(emitting, 1, rtol=1e-5)
