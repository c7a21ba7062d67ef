"""Picking lights tile by tile: probabilities that add up, points that follow the density, and an
irradiance that stays right whatever the picks favour."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, box, room, world_of
from usdbrdf.options import Sampling
from usdbrdf.transport import irradiance
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels
from usdbrdf.transport.lights import GROUP, LightGroups, Lights, TilePicks, weighed_groups
from usdbrdf.transport.openings import NO_OPENINGS
from usdbrdf.transport.sampling_loops import Picked, PointDraws, Receivers, counted, pick_triangles


def _soup(count: int) -> Lights:
    """Small triangles all over a room, of very different powers."""
    rng = np.random.default_rng(7)
    corners = rng.random((count, 1, 3)) * 4 + rng.normal(size=(count, 3, 3)) * 0.1
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    share = rng.random(count) ** 4 * area
    share /= share.sum()
    return Lights(
        face=np.arange(count, dtype=np.int32),
        cumulative=np.cumsum(share),
        density=(share / area).astype(np.float32),
        corners=corners.astype(np.float32),
        normals=(normal / (2 * area[:, None])).astype(np.float32),
        box=NO_OPENINGS.box,
        first_opening=count,
    )


def _weighed(groups: LightGroups) -> TilePicks:
    rng = np.random.default_rng(8)
    origin = (rng.random((16, 3)) * 4).astype(np.float32)
    normal = rng.normal(size=(16, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    return weighed_groups(groups, origin, normal, np.array([0, 8, 16]))


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_every_triangle_has_one_group_whose_bounds_hold_it(count: int):
    lights = _soup(count)
    groups = lights.groups
    np.testing.assert_array_equal(np.sort(groups.face), lights.face)
    np.testing.assert_array_equal(groups.of_face[groups.face], np.arange(count))
    of = groups.triangles[:, GROUP].astype(int)
    assert (np.diff(of) >= 0).all()
    assert of.max() + 1 == groups.bounds.shape[1] <= 512
    far = np.linalg.norm(lights.corners[groups.face] - groups.bounds[:3, of].T[:, None], axis=-1)
    assert (far.max(axis=1) <= groups.bounds[6, of] * 1.0001 + 1e-6).all()
    apart = np.linalg.norm(lights.normals[groups.face] - groups.bounds[3:6, of].T, axis=-1)
    assert (apart <= groups.bounds[7, of] * 1.0001 + 1e-6).all()


def test_densities_of_a_tile_integrate_to_one():
    lights = _soup(3000)
    groups = lights.groups
    cumulative, _, ratio = _weighed(groups)
    np.testing.assert_allclose(cumulative[:, -1], 1, atol=1e-6)
    corners = lights.corners.astype(np.float64)
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(*edges), axis=1) / 2
    for q in range(2):
        density = lights.density * ratio[q, groups.triangles[groups.of_face, GROUP].astype(int)]
        assert (density * area).sum() == pytest.approx(1, abs=1e-5)
        assert density.min() >= 0.099 * lights.density.min()  # none is left out
    assert np.abs(ratio[0] - ratio[1]).max() > 1  # the two tiles favour different lights


@pytest.mark.parametrize("number", [1, 5, 300])
def test_picks_follow_the_density_and_leave_a_uniform_number(number: int):
    lights = _soup(number)
    groups = lights.groups
    tiles = _weighed(groups)
    ratio, count = tiles.ratio, 1 << 16
    even = (np.arange(count, dtype=np.uint64) << 16).astype(np.uint32)  # each 2**-16 once
    chosen, left = np.zeros(count, np.int32), np.zeros(count, np.float32)
    favour = np.zeros(count, np.float32)
    nothing, bits = np.zeros((0, 3), np.float32), np.zeros((0, 4), np.uint32)
    receivers = Receivers(
        nothing, nothing, PointDraws(bits, bits, 0, np.zeros(0, np.int64)), groups,
        np.zeros(count, np.int32), tiles, np.zeros((0, 0), np.float32), np.zeros(0, np.int32),
    )  # fmt: skip
    pick_triangles(receivers, 0, 0, even, Picked(chosen, favour, left, left))
    power = np.diff(groups.cumulative, prepend=0)
    expected = power * ratio[0, groups.triangles[:, GROUP].astype(int)]
    np.testing.assert_allclose(np.bincount(chosen, minlength=number) / count, expected, atol=3e-5)
    np.testing.assert_array_equal(favour, ratio[0, groups.triangles[chosen, GROUP].astype(int)])
    assert left.min() >= 0
    assert left.max() < 1
    np.testing.assert_allclose(np.histogram(left, 8, (0, 1))[0] / count, 1 / 8, atol=5e-3)
    # And so for each light alone, the first one too: even numbers leave even ones.
    for light in np.flatnonzero(np.bincount(chosen, minlength=number) >= 20):
        own = np.sort(left[chosen == light])
        evenly = (np.arange(len(own)) + 0.5) / len(own)
        np.testing.assert_allclose(own, evenly, atol=1.01 / len(own) + 1e-3)


def test_light_counts_by_its_angle_to_each_surface_s_own_curve():
    """Between even cosines on a straight line, whatever the length of the direction."""
    rng = np.random.default_rng(4)
    normal, towards = rng.normal(size=(2, 50, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    curves = rng.random((3, 9)).astype(np.float32)
    surface = rng.integers(3, size=50).astype(np.int32)
    groups = _soup(1).groups
    bits, nothing = np.zeros((0, 4), np.uint32), np.zeros((0, 3), np.float32)
    receivers = Receivers(
        nothing, normal, PointDraws(bits, bits, 0, np.zeros(0, np.int64)), groups,
        np.zeros(50, np.int32), _weighed(groups), curves, surface,
    )  # fmt: skip
    cosine = (normal * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    assert 10 < (cosine > 0).sum() < 40
    for k in range(50):
        wanted = np.interp(max(cosine[k], 0), np.linspace(0, 1, 9), curves[surface[k]])
        assert counted(receivers, k, towards, k) == pytest.approx(wanted, abs=1e-5)
        # Straight on and from behind are the curves' ends.
        straight = np.tile(3 * normal[k], (k + 1, 1))
        ends = [
            counted(receivers, k, side * straight, k) for side in (np.float32(1), np.float32(-1))
        ]
        assert ends == pytest.approx(curves[surface[k]][[-1, 0]].tolist(), abs=1e-5)


def _two_lamps() -> World:
    """A room with a shelf, a lamp under the ceiling and a smaller one on the floor."""
    shelf = box((0.2, 0.2, 0), (0.6, 0.6, 0.9))
    lamps = box((0.8, 0.8, 1.7), (1.2, 1.2, 1.8)) + box((1.6, 1.6, 0.05), (1.7, 1.7, 0.3))
    return world_of(room((0, 0, 0), (2, 2, 2), (24, 24)) + shelf + lamps)


def _shaded(world: World, lit: np.ndarray, sampling: Sampling) -> np.ndarray:
    order, tile = tiles_of_texels(world.texels)
    return irradiance_at(
        world.rays, world.texture(lit), world.lights(lit), black_environment(),
        world.texels.position[order], world.texels.normal[order], tile, sampling, world.size,
    ).mean.mean(axis=1).astype(np.float64)  # fmt: skip


def test_unbiased_at_few_rays_and_nearer_than_by_power(monkeypatch: pytest.MonkeyPatch):
    world = _two_lamps()
    owner = world.texels.object_index()
    lit = np.full((len(owner), 3), 0.05, np.float32)
    lit[owner >= 12] = 10
    reference = _shaded(world, lit, Sampling(standard_error=0, max_rays=1 << 12, seed=99))

    lit_at_all = reference > 0  # nothing arrives under the box

    def estimates() -> np.ndarray:
        few = [Sampling(standard_error=0, max_rays=16, seed=seed) for seed in range(24)]
        return np.stack([_shaded(world, lit, s)[lit_at_all] for s in few]) / reference[lit_at_all]

    ours = estimates()
    means = ours.mean(axis=1)
    z = (means.mean() - 1) / (means.std(ddof=1) / len(means) ** 0.5)
    assert abs(z) < 4

    def by_power(groups: LightGroups, *points: np.ndarray) -> TilePicks:
        tiles, count = len(points[2]) - 1, groups.bounds.shape[1]
        return TilePicks(
            np.tile(groups.start[1:], (tiles, 1)),
            np.zeros((tiles, count), np.int16),
            np.ones((tiles, count), np.float32),
        )

    monkeypatch.setattr(irradiance, "weighed_groups", by_power)
    assert ((ours - 1) ** 2).mean() < 0.7 * ((estimates() - 1) ** 2).mean()
