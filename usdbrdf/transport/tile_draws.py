"""Random numbers of points in tiles: Sobol's, scrambled so that rays of one sample follow each
other closely and yet each point's numbers are uniform.

A point's number is, from its highest bits down,

    bits of the scene   which of 2^m cells of the unit square comes when. In every run of 2^m Sobol
                        points each cell holds one, so that sharing these bits biases nothing.
    bits of neighbours  which stratum of the cell is a point's: another one for each of them, all
                        flipped by the same random bits. The sum over neighbouring texels is then
                        that of stratified samples.
    bits of its own

after A. Ahmed and P. Wonka, "Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error via
Hierarchical Ordering of Pixels", 2020.

Of points on lights each texel of a tile of 8 x 8 has one of 64 strata. Directions are a group's of
8 texels, in whole tiles one of each square of 2 x 2 texels in 8 x 4: parallel rays where the
surface is flat, which Embree traces together at less cost, and neighbours' errors still differ, as
filters need it. The groups of a run of 16 tiles have 128 strata.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bits, Int, Long
from usdbrdf.transport.warps import hashed_uniform, sobol_bits

# Texels of a tile and of a group; tiles of a run, and its groups.
TEXELS, _GROUP, _RUN = 64, 8, 16
_RUN_GROUPS = _RUN * TEXELS // _GROUP
# Bits of a texel's and of a group's stratum in each of the two dimensions.
_TEXEL_BITS, _GROUP_BITS = 3, 4


def interleaved(x: Long, y: Long) -> Long:
    """Morton's order of the plane: the bits of x and y (N,), in turns."""
    code = np.zeros(len(x), np.int64)
    for bit in range(20):
        code |= (x >> bit & 1) << 2 * bit + 1 | (y >> bit & 1) << 2 * bit
    return code


def strata_of_texels(x: Long, y: Long) -> Long:
    """The stratum that suits the texel (x, y) of a tile, each (N,) below 8: all 64 are given, and
    every aligned square of 4 or 16 texels has one in each quarter or sixteenth of the cell."""
    points = sobol_bits(2 * _TEXEL_BITS).astype(np.int64) >> 32 - _TEXEL_BITS
    return interleaved(points[:, 0], points[:, 1])[interleaved(x, y)]


def places_in_tile(x: Long, y: Long) -> Long:
    """When the texel (x, y) of a tile, each (N,) below 8, comes: group after group. A group has
    every second column and row of a half, near ones near."""
    group = y // 4 * 4 + interleaved(x % 2, y % 2)
    return _GROUP * group + interleaved(y // 2, x // 2) % _GROUP


def _strata_by_place() -> Int:
    y, x = np.divmod(np.arange(TEXELS), 8)
    strata = np.empty(TEXELS, np.int32)
    strata[places_in_tile(x, y)] = strata_of_texels(x, y)
    return strata


# The stratum of the texel that comes first in a tile, second, ..., (64,).
STRATA_BY_PLACE = _strata_by_place()


def _strata_of_groups() -> Long:
    """The strata of a run's groups in each of two dimensions, (128, 2): all different, those of a
    tile one in each eighth of the cell, and those of each square of 2 x 2 texels one in each
    quarter. In smaller tiles the last groups are missing: so that what is left of a run is
    stratified too, eighths and quarters change places from tile to tile."""
    number = np.arange(_RUN_GROUPS)
    tile = number // (TEXELS // _GROUP)
    points = sobol_bits(7).astype(np.int64) >> 32 - _GROUP_BITS
    return np.asarray(points[number ^ tile >> 2 & 3 ^ (tile >> 1 & 1) << 2])


_STRATA_OF_GROUPS = _strata_of_groups()


def independent_tiles(count: int) -> Int:
    """Patches (count,) of points that share no random bits but the scene's."""
    return _RUN * np.arange(count, dtype=np.int32)


@dataclass(frozen=True, kw_only=True)
class TileDraws:
    """Where points take their random numbers from.

    seed    of all random bits
    sobol   (N, 4) numbers of 32 bits, two dimensions for each technique, with the scene's random
            bits; N = 0 for independent numbers
    shared  how many of the highest bits of each dimension are the scene's
    """

    seed: int
    sobol: Bits
    shared: tuple[int, int]


def tile_draws(seed: int, first_round: int, samples: int) -> TileDraws:
    """Sobol points for so many ``samples``; the scene's bits are as many as give a whole
    ``first_round`` the same number of samples in each cell."""
    log2_count = int(np.ceil(np.log2(max(samples, 2))))
    # Another index than the points' and the tiles', which are counted from 0.
    flips = [int(hashed_uniform(seed, -1, d) * 2.0**32) for d in range(4)]
    sobol = np.tile(sobol_bits(log2_count), 2) ^ np.array(flips, np.uint32)
    shared = (first_round & -first_round).bit_length() - 1
    return TileDraws(seed=seed, sobol=sobol, shared=((shared + 1) // 2, shared // 2))


def independent_draws(seed: int) -> TileDraws:
    return TileDraws(seed=seed, sobol=np.zeros((0, 4), np.uint32), shared=(0, 0))


@loop
def groups_of(identity: Long) -> Long:
    """Which group's directions a point has, (N,)."""
    return identity // _GROUP


@loop
def scrambles_of_points(identity: Long, stratum: Int, seed: int, shared: tuple[int, int]) -> Bits:
    """What each point's Sobol points are combined with by exclusive or, (4, P), below the
    ``shared`` bits: two dimensions for its group's directions, two for its own points on lights.

    identity (P,): 64 times the tile and its place in that; stratum (P,) of its points on lights.
    """
    scrambles = np.empty((4, len(identity)), np.uint32)
    for d in range(4):
        below = 32 - shared[d % 2]
        for k in range(len(identity)):
            if d < 2:
                bits, owner = _GROUP_BITS, identity[k] // _GROUP
                run_or_tile = owner // _RUN_GROUPS
                place = _STRATA_OF_GROUPS[owner % _RUN_GROUPS, d]
            else:
                bits, owner = _TEXEL_BITS, identity[k]
                run_or_tile = owner // TEXELS
                place = _every_other_bit(stratum[k] >> 1 - d % 2)
            flips = np.int64(hashed_uniform(seed, run_or_tile, 16 + d) * 2.0**bits)
            own = np.int64(hashed_uniform(seed, owner, d) * 2.0 ** (below - bits))
            scrambles[d, k] = (place ^ flips) << below - bits | own
    return scrambles


@loop
def _every_other_bit(code: int) -> int:
    """One of two interleaved numbers of 3 bits."""
    return code & 1 | code >> 1 & 2 | code >> 2 & 4
