"""Values on the surface, bilinear between texels."""

from __future__ import annotations

import numpy as np

from tests.physics.surfaces import World, quad, world_of


def _barycentric(number: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.random.default_rng(12345).random((2, number))
    over = u + v > 1
    return (
        np.where(over, 1 - u, u).astype(np.float32),
        np.where(over, 1 - v, v).astype(np.float32),
    )


def _positions(world: World, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    corners = world.scene.points[world.scene.triangles[face]].astype(np.float64)
    weights = np.stack([1 - u - v, u, v], axis=-1)
    return (weights[:, :, None] * corners).sum(axis=1)


def test_a_linear_function_of_the_position_comes_back_on_a_flat_chart():
    world = world_of([
        quad((1, 2, 3), (2, 0.5, 0), (0, 1, 1), size=(20, 30)),
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(7, 5)),
    ])  # fmt: skip
    slope = np.array([[0.3, 0.1, -0.4], [0.2, -0.2, 0.5], [0.1, 0.7, 0.2]])
    values = (2 + world.texels.position @ slope).astype(np.float32)
    texture = world.texture(values)
    u, v = _barycentric(4000)
    face = np.random.default_rng(1).integers(0, 4, 4000).astype(np.int32)
    expected = 2 + _positions(world, face, u, v) @ slope
    found = texture.at(face, u, v)
    # Half a texel from the border the texture is constant: clamped, not extrapolated.
    corners = world.texels.corner_pixel[face]
    size = world.texels.resolution[world.scene.face_object[face]]
    weights = np.stack([1 - u - v, u, v], axis=-1)
    pixel = (weights[:, :, None] * corners).sum(axis=1)
    inner = ((pixel >= 0.5) & (pixel <= size - 0.5)).all(axis=1)
    assert inner.sum() > 2500
    # Texels on a triangle's edge may stand for a point some hundredths of a texel off it.
    np.testing.assert_allclose(found[inner], expected[inner], atol=2e-3)
    assert np.abs(found - expected).max() < 0.3
    own = [values[world.texels.of_object(i)] for i in range(2)]
    for i in range(2):
        mine = face // 2 == i
        assert (found[mine] >= own[i].min(axis=0) - 1e-5).all()
        assert (found[mine] <= own[i].max(axis=0) + 1e-5).all()


def test_a_texel_centre_reads_its_texel():
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(8, 8))])
    values = np.random.default_rng(12345).random((64, 3)).astype(np.float32)
    texels = world.texels
    _, u, v = texels.barycentric.T
    found = world.texture(values).at(texels.face, u.copy(), v.copy())
    np.testing.assert_allclose(found, values, atol=0.02)


def test_objects_do_not_read_each_other():
    parts = [quad((i, 0, 0), (1, 0, 0), (0, 1, 0), size=(4 + i, 3)) for i in range(3)]
    world = world_of(parts)
    texture = world.texture(world.per_object([(1, 2, 3), (10, 20, 30), (100, 200, 300)]))
    face = np.repeat(np.arange(6, dtype=np.int32), 200)
    u, v = _barycentric(len(face))
    expected = np.array([1, 10, 100])[face // 2][:, None] * np.array([1, 2, 3])
    np.testing.assert_allclose(texture.at(face, u, v), expected, rtol=1e-6)


def test_rays_that_hit_nothing_read_nothing():
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))])
    texture = world.texture(world.per_object([(5, 5, 5)]))
    third = np.full(2, 1 / 3, np.float32)
    found = texture.at(np.array([-1, 0], np.int32), third, third)
    np.testing.assert_allclose(found, [[0, 0, 0], [5, 5, 5]], rtol=1e-6)


def test_atlases_of_a_single_row_column_or_texel_work():
    for size in ((1, 1), (1, 6), (6, 1)):
        world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=size)])
        texture = world.texture(world.per_object([(0.5, 1, 2)]))
        u, v = _barycentric(50)
        found = texture.at(np.tile(np.array([0, 1], np.int32), 25), u, v)
        np.testing.assert_allclose(found, np.tile([[0.5, 1, 2]], (50, 1)), rtol=1e-6)
