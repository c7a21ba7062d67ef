"""Random numbers of tiles: every texel's uniform, neighbours' in different strata, and one in
each cell of a round; groups that share directions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from usdbrdf.transport.tile_draws import (
    STRATA_BY_PLACE,
    TEXELS,
    TileDraws,
    groups_of,
    independent_tiles,
    places_in_tile,
    scrambles_of_points,
    strata_of_texels,
    tile_draws,
)

X, Y = (axis.ravel() for axis in np.meshgrid(np.arange(8), np.arange(8)))
# tiles whose groups share random bits, and what these divide the cell of a direction into.
RUN, STEPS = 16, 16


def _quadrants(stratum: np.ndarray, bits: int) -> np.ndarray:
    """Which of 4**bits squares of the cell."""
    return stratum >> 2 * (3 - bits)


def _points(draws: TileDraws, tiles: int, samples: int) -> np.ndarray:
    """All numbers of whole tiles in [0, 1), (samples, 4, tiles * 64)."""
    identity, stratum = np.arange(tiles * TEXELS), np.tile(STRATA_BY_PLACE, tiles)
    scrambles = scrambles_of_points(identity, stratum, draws.seed, draws.shared)
    return (draws.sobol[:samples, :, None] ^ scrambles) * 2.0**-32


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_aligned_squares_of_texels_have_a_stratum_in_each_part_of_the_cell(bits: int):
    parts = _quadrants(strata_of_texels(X, Y), bits)
    square = (X >> bits) * 8 + (Y >> bits)
    for one in np.unique(square):
        assert sorted(parts[square == one]) == list(range(4**bits))


def test_a_tile_has_groups_of_eight_one_of_each_square_of_four():
    place = places_in_tile(X, Y)
    assert sorted(place) == list(range(TEXELS))
    np.testing.assert_array_equal(STRATA_BY_PLACE[place], strata_of_texels(X, Y))
    group = groups_of(place.astype(np.int64))
    for one in range(8):
        x, y = X[group == one], Y[group == one]
        assert len(set(zip(x // 2, y // 2, strict=True))) == len(x) == 8
        assert np.ptp(y // 2) == 1


def test_every_ninth_texel_or_so_lies_in_another_row_and_column():
    # Those at which a tile looks for what lights it.
    place = places_in_tile(X, Y)
    found = np.flatnonzero(np.isin(place, [8 * i + 5 * i % 8 for i in range(8)]))
    assert sorted(X[found]) == sorted(Y[found]) == list(range(8))


@pytest.mark.parametrize("samples", [8, 32])
def test_a_round_has_one_sample_in_each_cell_for_every_point(samples: int):
    draws = tile_draws(3, samples, samples)
    high, low = draws.shared
    assert 1 << high + low == samples
    points = _points(draws, 3, samples)
    for x, y in ((0, 1), (2, 3)):
        cell = (points[:, x] * (1 << high)).astype(int) << low
        cell |= (points[:, y] * (1 << low)).astype(int)
        np.testing.assert_array_equal(
            np.sort(cell, axis=0), np.repeat(np.arange(samples)[:, None], cell.shape[1], axis=1)
        )


@pytest.mark.parametrize(
    ("first", "shared"), [(1, (0, 0)), (2, (1, 0)), (24, (2, 1)), (32, (3, 2)), (48, (2, 2))]
)
def test_the_scene_s_bits_divide_the_first_round(first: int, shared: tuple[int, int]):
    assert tile_draws(3, first, 64).shared == shared


@pytest.mark.parametrize(("samples", "points"), [(1, 2), (2, 2), (3, 4), (64, 64), (65, 128)])
def test_there_are_points_for_all_samples(samples: int, points: int):
    assert tile_draws(3, 1, samples).sobol.shape == (points, 4)


def test_the_scene_s_random_bits_are_all_of_a_number_s_and_different_in_each_dimension():
    # Chi-square over each of the 32 bits of 400 seeds; the first of Sobol's points is 0.
    flips = np.array([tile_draws(seed, 1, 2).sobol[0] for seed in range(400)])
    ones = (flips[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(int).sum(axis=0)
    assert (np.abs(ones - 200) < 5 * 10).all()
    for one, other in itertools.combinations(range(4), 2):
        assert abs(np.corrcoef(flips[:, one], flips[:, other])[0, 1]) < 5 / np.sqrt(400)


def test_a_group_shares_its_directions_and_no_two_groups_do():
    draws = tile_draws(5, 32, 32)
    points = _points(draws, 2 * RUN, 32)[7].reshape(4, -1, 8)
    assert (points[:2] == points[:2, :, :1]).all()
    assert len({tuple(point) for point in points[:2, :, 0].T}) == 2 * RUN * 8
    assert len({tuple(point) for point in points[2:].reshape(2, -1).T}) == 2 * RUN * TEXELS


def test_the_groups_of_a_run_of_tiles_are_stratified_in_one_cell():
    draws = tile_draws(5, 32, 32)
    size = np.array([1 / 8, 1 / 4])[:, None]
    directions = _points(draws, 2 * RUN, 32)[7, :2].reshape(2, 2, 8 * RUN, 8)[..., 0]
    for run in range(2):
        own = directions[:, run]
        assert len({tuple(cell) for cell in np.floor(own / size).astype(int).T}) == 1
        strata = (own / size % 1 * STEPS).astype(int)
        assert len({tuple(cell) for cell in strata.T}) == 8 * RUN
        for x, y in ((16, 8), (8, 16), (4, 16)):
            cell = strata[0] * x // STEPS * y + strata[1] * y // STEPS
            assert (np.bincount(cell, minlength=x * y) == 8 * RUN // (x * y)).all()
        # Of each tile one in each of 8, of each square of 2 x 2 texels one in each quarter.
        for count, x, y in ((8, 4, 2), (4, 2, 2)):
            parts = strata[0] * x // STEPS * y + strata[1] * y // STEPS
            assert (np.sort(parts.reshape(-1, count)) == np.arange(count)).all()


def test_the_points_on_lights_of_a_tile_are_stratified_in_one_cell():
    draws = tile_draws(5, 32, 32)
    size = np.array([1 / 8, 1 / 4])[:, None]
    lights = _points(draws, 4, 32)[7, 2:].reshape(2, 4, TEXELS)
    for tile in range(4):
        own = lights[:, tile]
        assert len({tuple(cell) for cell in np.floor(own / size).astype(int).T}) == 1
        assert len({tuple(cell) for cell in (own / size % 1 * 8).astype(int).T}) == TEXELS


def test_every_texel_is_uniform_over_the_strata_and_within_them():
    # Chi-square over 64 strata, and over 64 parts of each of these, of one texel in 4,096 runs of
    # tiles.
    draws = tile_draws(7, 32, 32)
    identity = np.arange(4096) * RUN * TEXELS
    for texel in (0, 21, 63):
        stratum = np.full(4096, STRATA_BY_PLACE[texel], np.int32)
        scrambles = scrambles_of_points(identity + texel, stratum, draws.seed, draws.shared)
        within = (draws.sobol[0, :, None] ^ scrambles) * 2.0**-32
        within = within * np.array([8, 4, 8, 4])[:, None] % 1
        for dimensions in ([0, 1], [2, 3]):
            for place in (within[dimensions], within[dimensions] * 8 % 1):
                cell = (place * 8).astype(int)
                found = np.bincount(cell[0] * 8 + cell[1], minlength=64)
                assert stats.chisquare(found).pvalue > 1e-4


@pytest.mark.parametrize(("technique", "most"), [(0, 0.6 * 8), (2, 0.4)])
def test_a_tile_integrates_as_stratified_samples_do_and_without_bias(technique: int, most: float):
    # What lies within a circle about a corner: pi / 4 of 0.8. A round of 32 samples leaves each
    # texel the error of its cells at the edge, of which the mean over a tile has far less variance
    # than independent errors of its 8 groups or its 64 texels would leave.
    draws = tile_draws(11, 32, 32)
    points = _points(draws, 512 * RUN, 32).reshape(32, 4, 512, RUN, TEXELS)[:, technique:, :, 0]
    inside = points[:, 0] ** 2 + points[:, 1] ** 2 < 0.8
    error = inside.mean(axis=0) - np.pi / 4 * 0.8
    of_texels, of_tiles = error.var(), error.mean(axis=1).var()
    assert of_tiles < most * of_texels / TEXELS
    assert abs(error.mean()) < 4 * np.sqrt(of_tiles / 512)
    assert abs(error[:, 9].mean()) < 4 * np.sqrt(of_texels / 512)


@pytest.mark.parametrize("groups", [1, 2, 3, 4, 6])
def test_what_small_tiles_have_of_a_run_is_stratified(groups: int):
    # As above, over runs of tiles whose last groups are missing.
    draws, runs = tile_draws(11, 32, 32), 400
    tile, group = np.divmod(np.arange(runs * RUN * groups), groups)
    identity = TEXELS * tile + 8 * group
    scrambles = scrambles_of_points(identity, np.zeros(len(identity), np.int32), 11, draws.shared)
    points = (draws.sobol[:32, :2, None] ^ scrambles[:2]) * 2.0**-32
    inside = points[:, 0] ** 2 + points[:, 1] ** 2 < 0.8
    error = inside.mean(axis=0).reshape(runs, -1) - np.pi / 4 * 0.8
    assert error.mean(axis=1).var() < 0.4 * error.var() / error.shape[1]


def test_independent_tiles_share_no_random_bits():
    draws = tile_draws(3, 32, 32)
    identity = TEXELS * independent_tiles(4096).astype(np.int64)
    scrambles = scrambles_of_points(identity, np.zeros(4096, np.int32), 3, draws.shared)
    # Neighbours' exclusive or in the bits of strata and below is any, in all four dimensions.
    for d in range(4):
        below = 32 - draws.shared[d % 2]
        mixed = (scrambles[d, 1:] ^ scrambles[d, :-1]) >> np.uint32(below - 4)
        assert stats.chisquare(np.bincount(mixed, minlength=16)).pvalue > 1e-4
