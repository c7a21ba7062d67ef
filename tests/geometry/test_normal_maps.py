"""Normals of a fine surface on a coarse one, where both are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from usdbrdf.geometry.normal_maps import (
    at,
    corner_tangents,
    from_tangent_space,
    in_tangent_space,
    interpolated,
    nearest_of,
    sampled,
    seen_along_normals,
)
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.unwrap import pack_triangles_singly
from usdbrdf.transport.rays import Hits, RayScene

QUAD = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.int32([[0, 1, 2], [0, 2, 3]])
UP = np.tile(np.float32([0, 0, 1]), (2, 3, 1))


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


def somewhere_on(points, triangles, normals, tangents, count=4000):
    """Positions, unit normals and tangents of random points of a coarse mesh."""
    random = np.random.default_rng(3)
    face = random.integers(len(triangles), size=count)
    weights = random.dirichlet((1, 1, 1), count).astype(np.float32)
    position, normal, tangent = (
        np.einsum("tc,tcd->td", weights, values[face])
        for values in (points[triangles], normals, tangents)
    )
    return position, normal / np.linalg.norm(normal, axis=1, keepdims=True), tangent


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_of_a_quad_run_along_u(mirrored):
    uv = QUAD[HALVES][..., :2].copy()
    if mirrored:
        uv[..., 0] = 1 - uv[..., 0]
    found = corner_tangents(QUAD, HALVES, UP, uv)
    expected = [-1, 0, 0, -1] if mirrored else [1, 0, 0, 1]
    np.testing.assert_allclose(found, np.broadcast_to(np.float32(expected), (2, 3, 4)), atol=1e-7)


def test_tangents_are_unit_across_their_normals_and_shared_where_all_else_is():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    points, triangles = np.float32(sphere.vertices), np.int32(sphere.faces)
    normals = points[triangles]
    # u around, v up: without a seam in the middle.
    corner = points[triangles]
    uv = np.stack([np.arctan2(corner[..., 1], corner[..., 0]), corner[..., 2]], axis=-1)
    seam = np.ptp(uv[..., 0], axis=1) > np.pi
    pole = np.abs(points[triangles][..., 2]).max(axis=1) > 0.8
    tangents = corner_tangents(points, triangles, normals, np.float32(uv))
    assert np.linalg.norm(tangents[..., :3], axis=2) == pytest.approx(1, abs=1e-6)
    assert (tangents[..., :3] * normals).sum(axis=2) == pytest.approx(0, abs=1e-6)
    kept = ~seam & ~pole
    east = np.stack([-corner[..., 1], corner[..., 0], 0 * corner[..., 0]], axis=-1)[kept]
    east /= np.linalg.norm(east, axis=-1, keepdims=True)
    assert degrees_between(tangents[kept, :, :3].reshape(-1, 3), east.reshape(-1, 3)).max() < 15
    assert (tangents[kept][..., 3] == 1).all()


def test_a_triangle_without_area_in_the_picture_still_has_a_tangent():
    found = corner_tangents(QUAD, HALVES, UP, np.zeros((2, 3, 2), np.float32))
    assert np.linalg.norm(found[..., :3], axis=2) == pytest.approx(1)
    assert found[..., 2] == pytest.approx(0)


def test_a_flat_surface_gives_exactly_flat_normals():
    uv = QUAD[HALVES][..., :2]
    tangents = corner_tangents(QUAD, HALVES, UP, uv)
    position, normal, tangent = somewhere_on(QUAD, HALVES, UP, tangents)
    hits, met = seen_along_normals(RayScene(QUAD, HALVES), position, normal, 0.1)
    assert met.all()
    found = in_tangent_space(interpolated(UP, hits), normal, tangent)
    assert (found == np.float32([0, 0, 1])).all()


@pytest.mark.parametrize("height", [-0.02, 0.0, 0.005, 0.01, 0.03])
def test_a_coarse_face_beyond_a_thin_board_sees_the_side_that_faces_as_it_does(height):
    """A board 1 cm thick: its upper side is triangles 0 and 1, its lower one 2 and 3."""
    upper = QUAD + np.float32([0, 0, 0.01])
    board = RayScene(np.concatenate([upper, QUAD]), np.concatenate([HALVES, HALVES[:, ::-1] + 4]))
    position = np.float32([[0.3, 0.6, height], [0.7, 0.2, height]])
    for normal, faces in (([0, 0, 1], {0, 1}), ([0, 0, -1], {2, 3})):
        normals = np.tile(np.float32(normal), (2, 1))
        hits, met = seen_along_normals(board, position, normals, 0.05)
        assert met.all()
        assert set(hits.face.tolist()) == faces


def test_waves_on_a_plane():
    """z = h sin(kx) sin(ky), 12 degrees steep, under two triangles."""
    height, k, side = 0.005, 2 * np.pi * 4, 257
    x, y = np.meshgrid(*[np.linspace(0, 1, side)] * 2)

    def normal_at(x, y):
        slopes = (
            height
            * k
            * np.stack([np.cos(k * x) * np.sin(k * y), np.sin(k * x) * np.cos(k * y)], axis=-1)
        )
        found = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
        return (found / np.linalg.norm(found, axis=-1, keepdims=True)).astype(np.float32)

    z = height * np.sin(k * x) * np.sin(k * y)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    first = np.arange(side * side).reshape(side, side)[:-1, :-1].reshape(-1)
    quads = np.stack([first, first + 1, first + side + 1, first + side], axis=1)
    fine = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    fine_normals = normal_at(points[:, 0], points[:, 1])[fine]
    uv = QUAD[HALVES][..., :2]
    tangents = corner_tangents(QUAD, HALVES, UP, uv)
    position, normal, tangent = somewhere_on(QUAD, HALVES, UP, tangents)
    hits, met = seen_along_normals(RayScene(points, fine), position, normal, 0.02)
    assert met.all()
    unit = interpolated(fine_normals, hits)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    found = in_tangent_space(unit, normal, tangent)
    # u is x and v is y here, so a map is the normals themselves.
    assert degrees_between(found, normal_at(position[:, 0], position[:, 1])).max() < 0.2
    assert degrees_between(normal, normal_at(position[:, 0], position[:, 1])).max() > 7


def test_a_bumpy_sphere_under_a_coarse_one():
    """The map holds what the coarse normals lack, in whatever way its triangles were laid out."""

    def bumpy(subdivisions, bumps):
        sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
        x = np.asarray(sphere.vertices)
        radius = 1 + bumps * np.prod(np.sin(6 * x), axis=1)
        return np.float32(x * radius[:, None]), np.int32(sphere.faces)

    points, triangles = bumpy(6, 0.03)
    normals = corner_normals(points, triangles, 180)
    coarse, own = bumpy(2, 0)
    coarse_normals = corner_normals(coarse, own, 180)
    uv, _ = pack_triangles_singly(coarse[own], 0.05)
    tangents = corner_tangents(coarse, own, coarse_normals, uv)
    position, normal, tangent = somewhere_on(coarse, own, coarse_normals, tangents)
    hits, met = seen_along_normals(RayScene(points, triangles), position, normal, 0.1)
    assert met.all()
    where = interpolated(points[triangles], hits)
    # The ray's point lies along the normal.
    across = where - position
    across -= normal * (across * normal).sum(axis=1, keepdims=True)
    assert np.linalg.norm(across, axis=1).max() < 1e-4

    # Gradient of |p| - radius(p / |p|), by differences.
    def outside(p):
        x = p / np.linalg.norm(p, axis=1, keepdims=True)
        return np.linalg.norm(p, axis=1) - 1 - 0.03 * np.prod(np.sin(6 * x), axis=1)

    steps = 1e-4 * np.eye(3)
    p = where.astype(np.float64)
    truth = np.stack([outside(p + s) - outside(p - s) for s in steps], axis=1)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    unit = interpolated(normals, hits)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    local = in_tangent_space(unit, normal, tangent)
    shown = degrees_between(from_tangent_space(local, normal, tangent), truth)
    alone = degrees_between(normal, truth)
    assert shown.mean() < 0.3
    assert shown.max() < 2
    assert alone.mean() > 4


def test_what_is_too_far_or_turned_away_is_not_met():
    position, normal = QUAD[:, :3] * 0.5 + np.float32([0.2, 0.2, 0]), UP.reshape(-1, 3)[:4]
    scene = RayScene(QUAD + np.float32([0, 0, 0.3]), HALVES)
    assert seen_along_normals(scene, position, normal, 0.31)[1].all()
    assert not seen_along_normals(scene, position, normal, 0.29)[1].any()
    assert not seen_along_normals(scene, position, -normal, 0.31)[1].any()


def test_of_two_sheets_the_one_that_faces_the_same_way_is_met():
    points = np.concatenate([QUAD, QUAD + np.float32([0, 0, -0.01])])
    triangles = np.concatenate([HALVES, HALVES[:, ::-1] + 4])  # a thin board
    position = np.float32([[0.5, 0.2, -0.004], [0.5, 0.2, 0.004]])
    hits, met = seen_along_normals(RayScene(points, triangles), position, UP[0, :2], 0.05)
    assert met.all()
    assert (hits.face < 2).all()


def test_texels_that_met_nothing_take_the_nearest_that_did():
    positions = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2.2, 0, 0]])
    known = np.array([True, False, True, False])
    source = nearest_of(positions, known)
    assert source[[0, 2, 3]].tolist() == [0, 2, 2]
    hits = Hits(np.arange(4, dtype=np.int32), *np.zeros((3, 4), np.float32))
    assert at(hits, source).face[3] == 2


def test_no_normal_points_into_the_surface():
    normal = np.float32([[0, 0, 1]])
    found = in_tangent_space(np.float32([[1, 0, -1]]), normal, np.float32([[1, 0, 0, 1]]))
    assert found[0, 2] > 0
    assert np.linalg.norm(found) == pytest.approx(1)


@pytest.mark.parametrize(
    ("wrap", "expected"), [("clamp", [0, 3]), ("repeat", [3, 0]), ("mirror", [0, 3])]
)
def test_lookups_beyond_the_border(wrap, expected):
    image = np.arange(4, dtype=np.float32).reshape(1, 4, 1)
    # Centres of the texels just outside, to the left and right; then two centres inside.
    uv = np.float32([[-0.125, 0.5], [1.125, 0.5], [0.125, 0.5], [0.625, 0.5]])
    assert sampled(image, uv, wrap)[:, 0].tolist() == [*expected, 0, 2]


def test_v_is_up():
    image = np.float32([[[1.0]], [[0.0]]])
    assert sampled(image, np.float32([[0.5, 0.75], [0.5, 0.5]]), "clamp")[:, 0].tolist() == [1, 0.5]
