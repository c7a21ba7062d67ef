"""Which surfaces are flat and wide enough to be looked at in squares."""

from __future__ import annotations

import numpy as np

from tests.physics.surfaces import quad, world_of
from usdbrdf.material.observations import SIDE, on_flat_squares, sides_of_samples

WIDE = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), size=(24, 24))
NARROW = quad((3, -1, 0), (2, 0, 0), (0, 0.3, 0), size=(24, 4))


def test_a_plane_is_flat_as_far_as_the_square_reaches_within_it():
    texels = world_of([WIDE]).texels
    row, column = np.divmod(texels.pixel, 24)
    inside = (row >= 2) & (row < 22) & (column >= 2) & (column < 22)
    np.testing.assert_array_equal(on_flat_squares(texels, 2), inside)


def test_where_normals_turn_nothing_is_flat():
    world = world_of([WIDE])
    normal = world.texels.normal
    # A cylinder of 1 m radius: 0.083 m, a texel, turns the normal by 0.083 radians.
    angle = world.texels.position[:, 0]
    normal[:] = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    assert not on_flat_squares(world.texels, 2).any()


def test_wide_objects_are_seen_in_squares_narrow_and_coarse_ones_texel_by_texel():
    texels = world_of([WIDE, NARROW]).texels
    usable = np.ones(len(texels), bool)
    usable[texels.of_object(0)][:100] = False
    # A square is a third of a metre wide.
    one_by_one = sides_of_samples(texels, usable, 16.0)
    np.testing.assert_array_equal(one_by_one[0], [1, 1])
    np.testing.assert_array_equal(one_by_one[1], usable)
    side, kept = sides_of_samples(texels, usable, 17.0)
    np.testing.assert_array_equal(side, [SIDE, 1])
    wide, narrow = texels.of_object(0), texels.of_object(1)
    np.testing.assert_array_equal(kept[wide], usable[wide] & on_flat_squares(texels, 2)[wide])
    np.testing.assert_array_equal(kept[narrow], usable[narrow])
