"""Irradiance under uniform emitters, against the closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.chi2 import assert_same_mean
from tests.physics.form_factors import coaxial_discs, polygon_irradiance
from tests.physics.surfaces import Part, World, disc, estimates, quad, world_of

RGB = np.array([3.0, 2.0, 1.0])
DARK = (0.0, 0.0, 0.0)


class Receivers(NamedTuple):
    """Points (N, 3) with normals (N, 3); some see only part of the emitter above their horizon."""

    points: np.ndarray
    normals: np.ndarray


RECEIVERS = Receivers(
    np.array([[0, 0, 0.5], [1.5, 0.3, 0], [-2, 2, 0.7], [0.3, 0.2, 1.2], [2.5, 0, 1.5]]),
    np.array([[0, 0, 1], [0, 0, 1], [0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]),
)


def _ceiling() -> Part:
    """A 2 m x 1 m rectangle at z = 2 that looks down."""
    return quad((-1, -0.5, 2), (0, 1, 0), (2, 0, 0))


def _floor() -> Part:
    return quad((-3, -3, -0.1), (6, 0, 0), (0, 6, 0))


def test_the_closed_form_itself():
    # A square of half-width a straight above at height a, by the form factor of a point under a
    # rectangle's corner (Sparrow and Cess), X = Y = 1, four quarters:
    # F = 4 / (2 pi) [X / sqrt(1 + X^2) atan(Y / sqrt(1 + X^2)) + the same with X and Y exchanged]
    #   = 4 / (2 pi) * 2 / sqrt(2) * atan(1 / sqrt(2)), and E = pi F.
    square = [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    form_factor = 4 / (2 * np.pi) * 2 / np.sqrt(2) * np.arctan(1 / np.sqrt(2))
    assert polygon_irradiance([0, 0, 0], [0, 0, 1], square) == pytest.approx(np.pi * form_factor)
    # Of a receiver that stands upright half of it is above the horizon, to either side alike.
    halves = [polygon_irradiance([0, 0, 0], [s, 0, 0], square) for s in (1, -1)]
    assert halves[0] == pytest.approx(halves[1])
    # Equal large discs close together see nothing but each other.
    assert coaxial_discs(100, 100, 0.01) == pytest.approx(1, abs=2e-4)


@pytest.mark.parametrize(("estimator", "rays"), [("cosine", 256), ("mis", 64)])
def test_a_rectangle_lights_points_as_lambert_says(estimator: str, rays: int):
    ceiling = _ceiling()
    world = world_of([ceiling, _floor()])
    lit = world.per_object([RGB, DARK])
    lights = world.lights(lit)
    assert len(lights.face) == 2
    unit = [polygon_irradiance(p, n, ceiling.points) for p, n in zip(*RECEIVERS, strict=True)]
    replicates, _ = estimates(
        world, lit, lights, *RECEIVERS, estimator=estimator, rays=rays, repeat=256, seed=3
    )
    assert_same_mean(replicates, np.array(unit)[:, None] * RGB)


def test_two_rectangles_of_different_radiance_add_up():
    # Lights are picked in proportion to area times radiance; the pick must cancel.
    near, far = quad((-2, 0, 1), (0, 1, 0), (1, 0, 0)), quad((1, -1, 2), (0, 2, 0), (1, 0, 0))
    world = world_of([near, far, quad((-9, -9, -0.1), (18, 0, 0), (0, 18, 0))])
    lit = world.per_object([(5, 5, 5), (40, 40, 40), DARK])
    lights = world.lights(lit)
    assert len(lights.face) == 4
    points = np.array([[0, 0, 0], [-1.5, 0.5, 0.2]])
    normals = np.array([[0, 0, 1], [0.6, 0, 0.8]])
    expected = [
        5 * polygon_irradiance(p, n, near.points) + 40 * polygon_irradiance(p, n, far.points)
        for p, n in zip(points, normals, strict=True)
    ]
    replicates, _ = estimates(
        world, lit, lights, points, normals, estimator="mis", rays=64, repeat=256
    )
    assert_same_mean(replicates, np.array(expected)[:, None])


@pytest.mark.parametrize("estimator", ["cosine", "mis"])
def test_coaxial_discs_exchange_what_their_form_factor_says(estimator: str):
    # Mean irradiance over disc 1 = pi L F12. The emitter is a polygon of 512 sides and the disc's
    # area: its rim wanders by (pi / 512)^2 / 6 < 1e-5 of the radius, far below the noise.
    r1, r2, distance = 0.8, 0.5, 0.7
    world = world_of([disc((0, 0, distance), r2, -1), quad((-3, -3, -1), (6, 0, 0), (0, 6, 0))])
    lit = world.per_object([RGB, DARK])
    rng = np.random.default_rng(12345)
    number = 4096
    radius, angle = r1 * np.sqrt(rng.random(number)), 2 * np.pi * rng.random(number)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=-1)
    normals = np.tile([0.0, 0.0, 1.0], (number, 1))
    single, _ = estimates(
        world, lit, world.lights(lit), points, normals, estimator=estimator, rays=64, repeat=1
    )
    # Every point is one independent estimate of the mean over the disc.
    assert_same_mean(single[0], np.pi * RGB * coaxial_discs(r1, r2, distance), slack=1e-4)


def _small_light() -> tuple[World, Part]:
    """0.2 m x 0.2 m four metres away: 0.08 % of the cosine-weighted hemisphere."""
    light = quad((1.4, 0.4, 4), (0, 0.2, 0), (0.2, 0, 0))
    return world_of([light, _floor()]), light


def test_aimed_rays_find_a_small_light_with_far_less_noise():
    world, light = _small_light()
    lit = world.per_object([(500, 500, 500), DARK])
    points, normals = np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 1]])
    expected = 500 * polygon_irradiance(points[0], normals[0], light.points)
    variance = {}
    for estimator in ("cosine", "mis"):
        replicates, found = estimates(
            world, lit, world.lights(lit), points, normals,
            estimator=estimator, rays=256, repeat=1024, seed=5,
        )  # fmt: skip
        assert_same_mean(replicates, expected)
        assert (found.rays == 256).all()
        variance[estimator] = replicates.var(axis=0, ddof=1).mean()
    # A cosine ray brings pi L with probability p = E / (pi L), else nothing: binomial. The variance
    # of a binomial's variance over 1024 replicates with about 0.2 hits each is about 1/0.2/1024.
    p = expected / (np.pi * 500)
    binomial = (np.pi * 500) ** 2 * p * (1 - p) / 256
    assert variance["cosine"] == pytest.approx(binomial, rel=4 * np.sqrt(1 / (256 * p) / 1024))
    # The lamp is so small that L cos / density hardly changes over it.
    assert variance["cosine"] > 1e4 * variance["mis"]


@pytest.mark.parametrize(("estimator", "rays"), [("cosine", 512), ("mis", 64)])
def test_a_blocker_takes_away_exactly_its_shadow(estimator: str, rays: int):
    # Emitter [-1, 1] x [-0.5, 0.5] at z = 2, black blocker [0.1, 0.7] x [-0.4, 0.2] at z = 1, both
    # horizontal: seen from (px, py, 0) the blocker covers p + 2 (blocker - p) of the plane z = 2,
    # again a rectangle. E = E(emitter) - E(emitter and shadow).
    ceiling = _ceiling()
    blocker = quad((0.1, -0.4, 1), (0, 0.6, 0), (0.6, 0, 0))
    world = world_of([ceiling, blocker, _floor()])
    lit = world.per_object([RGB, DARK, DARK])
    points = np.array([[0.0, 0, 0], [0.6, -0.1, 0], [0.4, 0.35, 0], [-0.2, 0.3, 0]])
    normals = np.array([[0, 0, 1], [0, 0, 1], [0.6, 0, 0.8], [0, 0, 1.0]])
    expected, shares = [], []
    for p, n in zip(points, normals, strict=True):
        low = np.maximum(p[:2] + 2 * (np.array([0.1, -0.4]) - p[:2]), [-1, -0.5])
        high = np.minimum(p[:2] + 2 * (np.array([0.7, 0.2]) - p[:2]), [1, 0.5])
        shadow = [
            [low[0], low[1], 2], [high[0], low[1], 2], [high[0], high[1], 2], [low[0], high[1], 2]
        ]  # fmt: skip
        whole = polygon_irradiance(p, n, ceiling.points)
        lost = polygon_irradiance(p, n, shadow) if (high > low).all() else 0.0
        expected.append(whole - lost)
        shares.append(lost / whole)
    assert min(shares) > 0.1
    assert max(shares) < 0.9
    replicates, _ = estimates(
        world, lit, world.lights(lit), points, normals, estimator=estimator, rays=rays, repeat=256
    )
    assert_same_mean(replicates, np.array(expected)[:, None] * RGB)


def test_a_light_shines_into_the_side_it_is_seen_from_only_through_cosine_rays():
    # A scanned lamp is a single sheet; seen from behind its texture still glows. The aimed rays
    # leave its back out, so the cosine rays must carry it with their full weight: S is the same.
    light = quad((-1, -0.5, 2), (2, 0, 0), (0, 1, 0))  # looks up, receiver below
    world = world_of([light, _floor()])
    lit = world.per_object([RGB, DARK])
    lights = world.lights(lit)
    assert len(lights.face) == 2
    points, normals = RECEIVERS.points[:1], RECEIVERS.normals[:1]
    expected = polygon_irradiance(points[0], normals[0], light.points) * RGB
    replicates, _ = estimates(
        world, lit, lights, points, normals, estimator="mis", rays=256, repeat=256
    )
    assert_same_mean(replicates, expected)


def test_a_graded_light_is_integrated_with_its_gradient():
    # L = 1 + 4 s along the emitter's long side, s in [0, 1]; the texture is linear between its
    # texel centres and constant over the outer half texels: cut the emitter into strips.
    columns = 64
    ceiling = quad((-1, -0.5, 2), (0, 1, 0), (2, 0, 0), size=(1, columns))
    world = world_of([ceiling, _floor()])
    lit = np.zeros((len(world.texels), 3), np.float32)
    own = world.texels.of_object(0)
    lit[own] = (1 + 4 * (world.texels.position[own, 0:1] + 1) / 2) * np.ones(3)
    strips = 512
    edge = np.linspace(-1, 1, strips + 1)
    middle = np.clip((edge[1:] + edge[:-1]) / 2, -1 + 1 / columns, 1 - 1 / columns)
    value = 1 + 4 * (middle + 1) / 2
    expected = []
    for p, n in zip(*RECEIVERS, strict=True):
        expected.append(sum(
            value[i] * polygon_irradiance(p, n, [
                [edge[i], -0.5, 2], [edge[i + 1], -0.5, 2], [edge[i + 1], 0.5, 2], [edge[i], 0.5, 2]
            ])
            for i in range(strips)
        ))  # fmt: skip
    replicates, _ = estimates(
        world, lit, world.lights(lit), *RECEIVERS, estimator="mis", rays=64, repeat=256
    )
    assert_same_mean(replicates, np.array(expected)[:, None], slack=1e-4)
