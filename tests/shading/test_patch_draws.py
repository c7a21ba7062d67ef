"""Random numbers of patches: every texel's uniform, neighbours' in different strata, and one in
each cell of a round."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from usdbrdf.shading.patch_draws import (
    STRATA,
    PatchDraws,
    patch_draws,
    scrambles_of_points,
    strata_of_texels,
)

X, Y = (axis.ravel() for axis in np.meshgrid(np.arange(8), np.arange(8)))


def _quadrants(stratum: np.ndarray, bits: int) -> np.ndarray:
    """Which of 4**bits squares of the cell."""
    return stratum >> 2 * (3 - bits)


def _points(draws: PatchDraws, patches: int, samples: int) -> np.ndarray:
    """All numbers of whole patches in [0, 1), (samples, 4, patches * 64)."""
    patch = np.repeat(np.arange(patches, dtype=np.int32), STRATA)
    stratum = np.tile(np.arange(STRATA, dtype=np.int32), patches)
    identity = np.arange(len(patch))
    scrambles = scrambles_of_points(patch, stratum, identity, draws.seed, draws.shared)
    return (draws.sobol[:samples, :, None] ^ scrambles) * 2.0**-32


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_aligned_squares_of_texels_have_a_stratum_in_each_part_of_the_cell(bits: int):
    parts = _quadrants(strata_of_texels(X, Y), bits)
    square = (X >> bits) * 8 + (Y >> bits)
    for one in np.unique(square):
        assert sorted(parts[square == one]) == list(range(4**bits))


@pytest.mark.parametrize("samples", [8, 32])
def test_a_round_has_one_sample_in_each_cell_for_every_point(samples: int):
    draws = patch_draws(3, samples, samples)
    high, low = draws.shared
    assert 1 << high + low == samples
    points = _points(draws, 3, samples)
    for x, y in ((0, 1), (2, 3)):
        cell = (points[:, x] * (1 << high)).astype(int) << low
        cell |= (points[:, y] * (1 << low)).astype(int)
        np.testing.assert_array_equal(
            np.sort(cell, axis=0), np.repeat(np.arange(samples)[:, None], cell.shape[1], axis=1)
        )


def test_the_points_of_a_patch_follow_each_other_through_the_strata_of_one_cell():
    draws = patch_draws(5, 32, 32)
    points = _points(draws, 4, 32)[:, :2].reshape(32, 2, 4, STRATA)
    size = np.array([1 / 8, 1 / 4])[:, None]
    for patch in range(4):
        own = points[7, :, patch]
        within = own / size % 1
        assert len({tuple(cell) for cell in np.floor(own / size).astype(int).T}) == 1
        strata = (within * 8).astype(int)
        assert len({tuple(cell) for cell in strata.T}) == STRATA
        # Four in turn share a quarter of a quarter of the cell.
        quarters = (within * 4).astype(int).reshape(2, 16, 4)
        assert (quarters == quarters[:, :, :1]).all()


def test_every_texel_is_uniform_over_the_strata_and_within_them():
    # Chi-square over 64 strata, and over 64 parts of each of these, of one texel in 4,096 patches.
    draws = patch_draws(7, 32, 32)
    points = _points(draws, 4096, 1)[0].reshape(4, 4096, STRATA)
    for texel in (0, 21, 63):
        within = points[:, :, texel] * np.array([8, 4, 8, 4])[:, None] % 1
        for x, y in ((0, 1), (2, 3)):
            for place in (within[[x, y]], within[[x, y]] * 8 % 1):
                cell = (place * 8).astype(int)
                found = np.bincount(cell[0] * 8 + cell[1], minlength=64)
                assert stats.chisquare(found).pvalue > 1e-4


def test_a_patch_integrates_as_stratified_samples_do_and_without_bias():
    # What lies within a circle about a corner: pi / 4 of 0.8. A round of 32 samples leaves each
    # texel the error of its cells at the edge, of which the mean over a patch has far less variance
    # than independent errors would leave.
    draws = patch_draws(11, 32, 32)
    points = _points(draws, 512, 32)
    inside = points[:, 0] ** 2 + points[:, 1] ** 2 < 0.8
    error = inside.mean(axis=0).reshape(512, STRATA) - np.pi / 4 * 0.8
    of_texels, of_patches = error.var(), error.mean(axis=1).var()
    assert of_patches < 0.4 * of_texels / STRATA
    assert abs(error.mean()) < 4 * np.sqrt(of_patches / 512)
    assert abs(error[:, 9].mean()) < 4 * np.sqrt(of_texels / 512)
