"""Closest hits, occlusion, and origins that clear their own surface."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, box, quad, room, sphere, world_of
from usdbrdf.errors import UsdBrdfError
from usdbrdf.transport import rays
from usdbrdf.transport.rays import (
    RayScene,
    _aligned,
    closest_hits_of_groups,
    empty_hits,
    lift_from_surface,
    occlusion,
)


@pytest.fixture(scope="module")
def triangle() -> RayScene:
    points = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0]], np.float32)
    return RayScene(points, np.array([[0, 1, 2]], np.int32))


def _f32(*rows: tuple[float, ...]) -> np.ndarray:
    return np.array(rows, np.float32)


def test_a_hit_says_where_it_is(triangle: RayScene):
    # hit = (1-u-v) p0 + u p1 + v p2 = (2u, v, 0); the direction's length is the unit of distance.
    hits = triangle.closest(_f32((0.5, 0.25, 3), (0.5, 0.25, 3)), _f32((0, 0, -1), (0, 0, -2)))
    np.testing.assert_array_equal(hits.face, [0, 0])
    np.testing.assert_allclose(hits.u, 0.25, atol=1e-6)
    np.testing.assert_allclose(hits.v, 0.25, atol=1e-6)
    np.testing.assert_allclose(hits.distance, [3, 1.5], rtol=1e-6)


def test_rays_that_leave_the_scene_have_no_face(triangle: RayScene):
    hits = triangle.closest(_f32((0.5, 0.25, 3), (5, 5, 3)), _f32((0, 0, 1), (0, 0, -1)))
    np.testing.assert_array_equal(hits.face, [-1, -1])


def test_a_ray_without_direction_meets_nothing(triangle: RayScene):
    # It starts on the triangle; the rays around it find what they would find without it.
    origins = _f32((0.5, 0.25, 3), (0.5, 0.25, 0), (0.5, 0.25, 1))
    hits = triangle.closest(origins, _f32((0, 0, -1), (0, 0, 0), (0, 0, -1)))
    np.testing.assert_array_equal(hits.face, [0, -1, 0])
    np.testing.assert_allclose(hits.distance[[0, 2]], [3, 1], rtol=1e-6)


def test_the_nearest_of_several_surfaces_is_found():
    parts = [quad((-1, -1, z), (2, 0, 0), (0, 2, 0)) for z in (0, 2, 1)]
    hits = world_of(parts).rays.closest(
        _f32((0.1, 0.2, 5), (0.1, 0.2, 0.5)), _f32(*[(0, 0, -1)] * 2)
    )
    np.testing.assert_array_equal(hits.face // 2, [1, 0])
    np.testing.assert_allclose(hits.distance, [3, 0.5], rtol=1e-6)


def test_occlusion_ends_where_it_is_told(triangle: RayScene):
    # The triangle is at distance 3; anything up to 2.99 is free, 3.01 is not.
    origins = _f32(*[(0.5, 0.25, 3)] * 3)
    directions = _f32((0, 0, -1), (0, 0, -1), (0, 0, 1))
    blocked = [
        _blocked(triangle, origins, directions, d)[k] for k, d in enumerate((2.99, 3.01, 100))
    ]
    np.testing.assert_array_equal(blocked, [False, True, False])


def test_many_rays_give_the_same_as_few():
    # More than one chunk, so several threads.
    world = world_of(room((0, 0, 0), (4, 3, 2.5)) + box((1, 1, 0.5), (2, 2.2, 1.5)))
    rng = np.random.default_rng(12345)
    directions = rng.standard_normal((150_000, 3)).astype(np.float32)
    origins = np.tile(_f32((3, 0.5, 2)), (len(directions), 1))
    whole = world.rays.closest(origins, directions)
    assert (whole.face >= 0).all()
    part = slice(65_530, 65_550)
    some = world.rays.closest(origins[part], directions[part])
    np.testing.assert_array_equal(whole.face[part], some.face)
    np.testing.assert_array_equal(whole.distance[part], some.distance)
    way = directions * whole.distance[:, None]
    assert not _blocked(world.rays, origins, way, 0.999).any()
    assert _blocked(world.rays, origins, way, 1.001).all()


def _blocked(rays: RayScene, origins: np.ndarray, directions: np.ndarray, far: float) -> np.ndarray:
    blocked = np.empty(len(origins), np.bool_)
    start = np.arange(len(origins), dtype=np.int32)
    occlusion(rays.address, origins, start, directions, far, blocked)
    return blocked


def test_origins_are_taken_in_turns(triangle: RayScene, monkeypatch: pytest.MonkeyPatch):
    origins = _f32((0.5, 0.25, 3), (5, 5, 3), (0.5, 0.25, 1))
    down = np.tile(_f32((0, 0, -1)), (12, 1))
    for chunk in (1 << 16, 4):
        monkeypatch.setattr(rays, "_CHUNK", chunk)
        hits = triangle.closest(origins, down)
        np.testing.assert_array_equal(hits.face, [0, -1, 0] * 4)
        np.testing.assert_allclose(hits.distance[hits.face == 0], [3, 1] * 4, rtol=1e-6)


@pytest.mark.fault("G8")
def test_no_ray_leaves_a_closed_room_far_from_the_origin():
    # Through edges and corners of many triangles, where float32 steps by 6e-5 m.
    at = np.array([1e3, -1e3, 1e3])
    world = world_of([sphere(at, 2, 48, 96, (96, 48))])
    rng = np.random.default_rng(5)
    directions = rng.standard_normal((200_000, 3)).astype(np.float32)
    assert (world.rays.closest(at[None].astype(np.float32), directions).face >= 0).all()


def _in_groups(rays: RayScene, origins: np.ndarray, directions: np.ndarray, group: np.ndarray):
    hits = empty_hits(len(group))
    closest_hits_of_groups(rays.address, origins, directions, group, hits)
    return hits


def _sizes_in_turn(rays: int) -> np.ndarray:
    """Groups of 1 to 11 rays."""
    return np.repeat(np.arange(rays), np.arange(rays) % 11 + 1)[:rays].astype(np.int64)


def test_groups_find_what_single_rays_find():
    ball = sphere((2, 1.5, 1.2), 0.6, 24, 48, (48, 24))
    world = world_of([*room((0, 0, 0), (4, 3, 2.5)), ball])
    rng = np.random.default_rng(9)
    group = _sizes_in_turn(20_000)
    # Nearly parallel ones, and others; some start outside and meet nothing.
    towards = rng.standard_normal((20_000, 3))
    for spread in (0.01, 1):
        directions = (towards[group] + spread * rng.standard_normal((20_000, 3))).astype(np.float32)
        origins = rng.uniform(-0.2, 2.7, (20_000, 3)).astype(np.float32)
        single = world.rays.closest(origins, directions)
        face, u, v, distance = _in_groups(world.rays, origins, directions, group)
        assert 0.5 < (single.face >= 0).mean() < 1
        same = face == single.face
        assert same.mean() > 0.9999  # on an edge either triangle will do
        hit = same & (face >= 0)
        np.testing.assert_allclose(distance[hit], single.distance[hit], rtol=1e-4)
        for found, one in ((u, single.u), (v, single.v)):
            np.testing.assert_allclose(found[hit], one[hit], atol=1e-3)


def test_no_ray_of_a_group_leaves_a_closed_room_far_from_the_origin():
    at = np.array([1e3, -1e3, 1e3], np.float32)
    world = world_of([sphere(at, 2, 48, 96, (96, 48))])
    rng = np.random.default_rng(5)
    group = _sizes_in_turn(200_000)
    directions = rng.standard_normal((200_000, 3))[group] + rng.normal(0, 0.02, (200_000, 3))
    origins = np.tile(at, (200_000, 1))
    assert (_in_groups(world.rays, origins, directions.astype(np.float32), group)[0] >= 0).all()


@pytest.mark.fault("G2")
@pytest.mark.parametrize(
    ("points", "triangles"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3))),
        (np.zeros((3, 3)), [[0, 1, 3]]),
        (np.zeros((3, 3)), [[0, 1, -1]]),
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]]),
    ],
)
def test_meshes_that_embree_would_take_silently_are_refused(points, triangles):
    with pytest.raises(UsdBrdfError, match="ray scene"):
        RayScene(np.array(points, np.float32), np.array(triangles, np.int32))


def _self_hits(world: World, scene_size: float) -> tuple[int, float]:
    """Rays from every texel, cosine-distributed about its flat normal, that meet something within
    a thousandth of the scene; and the largest lift in metres."""
    rng = np.random.default_rng(12345)
    texels = world.texels
    normal = texels.geometric_normal
    origin = lift_from_surface(texels.position, normal, scene_size)
    lift = float(np.linalg.norm(origin - texels.position, axis=1).max())
    met = 0
    for _ in range(16):
        w = rng.standard_normal((len(texels), 3))
        w /= np.linalg.norm(w, axis=1, keepdims=True)
        # Unit normal plus a point of the unit sphere; a thousandth off the horizon.
        w = w + 1.001 * normal
        w /= np.linalg.norm(w, axis=1, keepdims=True)
        hits = world.rays.closest(origin, w.astype(np.float32))
        met += int(((hits.face >= 0) & (hits.distance < 1e-3 * scene_size)).sum())
    return met, lift


@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_a_convex_surface_does_not_shade_itself(shape: str, offset: float):
    # From outside of a convex body every ray of the hemisphere is free, whatever the triangle it
    # starts on, also a kilometre from the origin, where float32 steps by 6e-5 m.
    at = np.array([offset, -offset, offset])
    parts = (
        box(at, at + np.array([1, 0.7, 0.4]), size=(24, 24))
        if shape == "box"
        else [sphere(at, 0.5, 24, 48, (96, 48))]
    )
    world = world_of(parts)
    met, lift = _self_hits(world, world.size)
    assert met == 0
    # The lift stays far below a texel (2 cm): 1e-5 of the size, four steps of the float, rounding.
    assert lift < 1e-5 * world.size + 5 * 1.2e-7 * (offset + 1)


def test_without_a_lift_a_surface_would_shade_itself():
    # That the test above can fail: the same rays started on the surface itself.
    world = world_of([sphere((1e3, -1e3, 1e3), 0.5, 24, 48, (96, 48))])
    rng = np.random.default_rng(12345)
    w = rng.standard_normal((len(world.texels), 3)).astype(np.float32)
    w *= np.sign((w * world.texels.geometric_normal).sum(axis=1, keepdims=True))
    hits = world.rays.closest(world.texels.position, w)
    assert ((hits.face >= 0) & (hits.distance < 1e-3)).any()


@pytest.mark.parametrize("size", [16, 64])
def test_what_embree_is_handed_lies_where_it_wants_it(size: int):
    held = [_aligned(words, size) for words in (12, 12, 20, 21, 48)]  # wherever each comes to lie
    assert [len(one) for one in held] == [12, 12, 20, 21, 48]
    assert not any(one.ctypes.data % size for one in held)
    assert not any(one.any() for one in held)
