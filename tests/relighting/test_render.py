"""The path tracer's scenes against closed forms, in the variant that runs everywhere."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from tests.relighting.scenes import cube, looking, material, photograph, plate
from usdbrdf.model.light import DistantLight, ShapeLight, SkyLight
from usdbrdf.model.material import constant_map
from usdbrdf.relighting.render import VARIANTS, mitsuba_variant
from usdbrdf.transport.environment import Environment, environment_at
from usdbrdf.transport.renderer_match import matching_factor


@pytest.fixture(params=VARIANTS)
def mi(request: pytest.FixtureRequest) -> Any:
    chosen = mitsuba_variant()
    if request.param != VARIANTS[1] and chosen.variant() != request.param:
        pytest.skip("no usable LLVM library")
    return mitsuba_variant(request.param)


@pytest.fixture
def scalar() -> Any:
    return mitsuba_variant("scalar_rgb")


def test_closed_furnace(scalar: Any) -> None:
    # Walls that emit 1 and reflect 0.8 in all directions: 1 + 0.8 + ... + 0.8^bounces. The lobe of
    # this roughness adds what it reflects of uniform light, less than 0.01 on average.
    view = looking((0, 0, 0), (0.3, 0.2, 0.5), fov=1.0)
    for bounces in (4, 8):
        walls = cube(material(0.8, emission=1.0), inside=True)
        found = photograph(scalar, [walls], view, samples=256, bounces=bounces).mean()
        series = [sum(a**k for k in range(bounces + 1)) for a in (0.8, 0.82)]
        assert series[0] * 0.995 < found < series[1] * 1.005


@pytest.mark.parametrize(("phi", "psi"), [(0.04, 0.9), (0.3, 0.5), (0.8, 0.1)])
def test_open_furnace(mi: Any, phi: float, psi: float) -> None:
    # Under a sky of 1 a plate shows its directional albedo. The stand-in of the scalar variant has
    # the fitted lobe's albedo on average over directions, the plugin in every direction.
    sky = [SkyLight(image=constant_map(1.0), world_from_here=np.eye(3))]
    cosines = np.sqrt((np.arange(4) + 0.5) / 4)
    found, expected = [], []
    for theta in np.arccos(cosines):
        view = looking((math.sin(theta), 0, math.cos(theta)), (0, 0, 0), fov=1e-3)
        ground = plate(material(0.3, phi=phi, psi=psi))
        found.append(photograph(mi, [ground], view, lights=sky, samples=1024).mean())
        expected.append(0.3 + directional_albedo(theta, phi, psi))
    if mi.variant() == VARIANTS[0]:
        assert found == pytest.approx(expected, abs=0.004)
    assert np.mean(found) == pytest.approx(np.mean(expected), abs=0.006)


def test_a_common_lobe_is_stronger_than_the_fitted_one() -> None:
    # By up to a third on smooth surfaces, by less on rough ones.
    factors = [matching_factor(phi, 0.04) for phi in (0.1, 0.3, 0.6)]
    assert 0.65 < factors[0] < factors[1] < factors[2] < 1.0


def _above(height: float) -> np.ndarray:
    pose = np.diag([1.0, -1, -1, 1])  # the front, +z, turned down
    pose[2, 3] = height
    return pose


def _square(height: float, side: float) -> np.ndarray:
    return _above(height) @ np.diag([side / 2, side / 2, 1, 1])


@pytest.mark.parametrize("kind", ["rectangle", "disk", "sphere", "parallel", "sun", "sky"])
def test_irradiance_of_lights(scalar: Any, kind: str) -> None:
    radiance = np.array([3.0, 2.0, 1.0])
    image, down = constant_map(*radiance), np.array([0.0, 0, -1])
    a = 0.5  # half side over height
    form = 4 / math.pi * a / math.hypot(1, a) * math.atan(a / math.hypot(1, a)) * 2 / 2
    sphere = np.diag([0.5, 0.5, 0.5, 1.0])
    sphere[2, 3] = 2
    light, expected = {
        "rectangle": (
            ShapeLight(kind="rectangle", world_from_here=_square(2, 2), emission=image),
            math.pi * form,
        ),
        "disk": (
            ShapeLight(kind="disk", world_from_here=_above(2), emission=image),
            math.pi / (1 + 2**2),
        ),
        "sphere": (
            ShapeLight(kind="sphere", world_from_here=sphere, emission=image),
            math.pi * (0.5 / 2) ** 2,
        ),
        "parallel": (
            DistantLight(towards=down, irradiance=np.float32(radiance), half_angle=0.0),
            1.0,
        ),
        "sun": (DistantLight(towards=down, irradiance=np.float32(radiance), half_angle=0.05), 1.0),
        "sky": (SkyLight(image=image, world_from_here=np.eye(3)), math.pi),
    }[kind]
    # At normal incidence and with little roughness the lobe of f0 = 0 reflects next to nothing.
    ground = plate(material(0.5))
    found = photograph(scalar, [ground], looking((0, 0, 1), (0, 0, 0)), lights=[light], samples=512)
    expected_radiance = 0.5 / math.pi * expected * radiance
    assert found.mean(axis=(0, 1)) == pytest.approx(expected_radiance, rel=0.02)


def test_the_sky_is_where_the_shading_step_has_it(scalar: Any) -> None:
    rng = np.random.default_rng(3)
    image = np.kron(rng.random((4, 8, 3)), np.ones((8, 8, 1))).astype(np.float32)
    turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for z_up in (True, False):
        sky = SkyLight(image=image, world_from_here=turned if z_up else np.eye(3))
        environment = Environment(image, z_up)
        for direction in ((0.5, 0.4, 0.6), (-0.7, 0.2, -0.3), (0.1, -0.8, 0.5)):
            way = np.array(direction) / np.linalg.norm(direction)
            ground = plate(material(), half=0.01, z=-9)
            view = looking((0, 0, 0), way, fov=1e-3)
            seen = photograph(scalar, [ground], view, lights=[sky], samples=4).mean(axis=(0, 1))
            expected = [environment_at(environment, *way, channel) for channel in range(3)]
            assert seen == pytest.approx(expected, abs=1e-3)


def test_maps_lie_as_their_uv_say_and_colours_keep_their_order(scalar: Any) -> None:
    # Rows run from v = 1 down, so the first row is seen at the top by a camera whose y is +y.
    texels = np.array([[(1, 0, 0), (0, 1, 0)], [(0, 0, 1), (1, 1, 0)]], np.float32)
    glowing = replace(material(0.0), emission=np.kron(texels, np.ones((4, 4, 1))).astype("f4"))
    view = looking((0, 0, 1), (0, 0, 0), width=2, height=2, fov=2 * math.atan(1))
    seen = photograph(scalar, [plate(glowing, half=1.0)], view, samples=4096, bounces=4)
    centres = seen.reshape(2, 2, 3)
    assert centres == pytest.approx(texels, abs=0.2)


def test_pixels_are_where_the_projects_cameras_have_them(scalar: Any) -> None:
    # Off-centre principal point, pixels that are not square: a lamp is found where it is.
    view = looking((0.3, 0.2, 3), (0, 0, 0), width=24, height=16, fov=0.6)
    fx, _, _, _ = view.intrinsics
    lens = (fx, fx * 0.8, 9.0, 10.5)
    view = replace(view, intrinsics=lens)
    lamp = plate(material(0.0, emission=1.0), half=0.3)
    lamp = lamp.moved(np.array([[1.0, 0, 0, 0.1], [0, 1, 0, -0.15], [0, 0, 1, 0], [0, 0, 0, 1]]))
    seen = photograph(scalar, [lamp], view, samples=256).mean(axis=2)
    origins, ways = view.rays(view.pixels())
    hit = origins + ways * (-origins[:, 2:] / ways[:, 2:])
    position = (seen.ravel()[:, None] * hit[:, :2]).sum(axis=0) / seen.sum()
    assert position == pytest.approx([0.1, -0.15], abs=0.01)
