"""What is taken off the samples of a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import box, quad, world_of
from usdbrdf.material.sample_specular import TILE_SIDE, specular_of_samples
from usdbrdf.texturing.passes import with_rows_beside
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.lit_scene import SurfacePoints
from usdbrdf.transport.lobe_radiance import lobe_radiance

EYE = np.array([1.0, -0.5, 1.5])
SIDE = 4


@pytest.fixture(scope="module")
def room():
    """A floor of 2 m below a bright strip, and a block."""
    return world_of([
        quad((0, 0, 0), (2, 0, 0), (0, 2, 0), (42, 38)),
        quad((0.9, 1.2, 1.5), (0, 0.1, 0), (0.3, 0, 0), (8, 8)),
        *box((0.2, 0.2, 0.01), (0.5, 0.5, 0.3), (9, 9)),
    ])  # fmt: skip


def _lit(room):
    light = [[0.1] * 3, [20.0] * 3, *[[0.2] * 3] * (len(room.texels.resolution) - 2)]
    return replace(room.lit(room.per_object(light)), lobe=DIELECTRIC)


def _found(lit, texel: np.ndarray, phi: float) -> np.ndarray:
    count = len(texel)
    of_psi = np.full((count, 3), 0.5, np.float32)
    samples = np.full(count, 5.0, np.float32)
    return specular_of_samples(lit, np.full(count, phi, np.float32), of_psi, texel, samples, EYE, 1)


def test_the_specular_light_of_blunt_lobes_is_their_tiles_mean(room):
    lit, floor = _lit(room), np.arange(*room.texels.of_object(0).indices(10**6)).astype(np.int32)
    found = _found(lit, floor, 0.6)
    picture = found.reshape(38, 42, 3)
    for row in range(0, 38, SIDE):
        for column in range(0, 42, SIDE):
            tile = picture[row : row + SIDE, column : column + SIDE]
            np.testing.assert_allclose(tile, np.broadcast_to(tile[0, 0], tile.shape), rtol=1e-6)
    # The same light as of each, less noise.
    position, (_, u, v) = room.texels.position[floor], room.texels.barycentric[floor].T
    way = (EYE - position).astype(np.float32)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    points = SurfacePoints(room.texels.face[floor], u, v, position, room.texels.normal[floor], way)
    phi, psi = np.full(len(floor), 0.6, np.float32), np.full((len(floor), 3), 0.5, np.float32)
    each = lobe_radiance(lit, points, phi, psi, 8, 1, floor.astype(np.int64))
    true = lobe_radiance(lit, points, phi, psi, 2048, 2)
    np.testing.assert_allclose(found.mean(0), each.mean(0), rtol=1e-4)
    assert (found - true).std() < 0.75 * (each - true).std()


def test_lobes_that_a_tile_turns_by_much_of_their_width_keep_their_own(room):
    floor = np.arange(*room.texels.of_object(0).indices(10**6)).astype(np.int32)
    picture = _found(_lit(room), floor, 0.02).reshape(38, 42, 3)
    assert (picture[:SIDE, :SIDE] != picture[0, 0]).any()


@pytest.mark.parametrize("stop", [1, 50, 400, 1000, 1596, 1597, 1700])
def test_what_a_texel_gets_does_not_depend_on_its_group(room, stop: int):
    every = np.arange(len(room.texels), dtype=np.int32)
    lit = _lit(room)
    whole = _found(lit, every, 0.5)
    for part in (slice(0, stop), slice(stop, len(every))):
        widened = with_rows_beside(room.texels, part, TILE_SIDE)
        assert widened.start <= part.start
        assert widened.stop >= part.stop
        assert widened.stop - widened.start <= part.stop - part.start + 2 * SIDE * 42
        own = _found(lit, every[widened], 0.5)
        inside = slice(part.start - widened.start, part.stop - widened.start)
        np.testing.assert_array_equal(own[inside], whole[part])
