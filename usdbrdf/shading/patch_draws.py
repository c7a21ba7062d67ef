"""Random numbers of points in patches: Sobol's, scrambled so that rays of one sample follow each
other closely and yet each point's numbers are uniform.

A point's number is, from its highest bits down,

    bits of the scene   which of 2^m cells of the unit square comes when. In every run of 2^m Sobol
                        points each cell holds one, so that sharing these bits biases nothing.
    bits of the patch   which of 64 strata of the cell is a point's: another one for each texel of
                        a patch of 8 x 8, all flipped by the same random bits. The sum over
                        neighbouring texels is then that of stratified samples, and points that
                        follow each other have neighbouring strata.
    bits of its own

after A. Ahmed and P. Wonka, "Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error via
Hierarchical Ordering of Pixels", 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import loop
from usdbrdf.shading.warps import hashed_uniform, sobol_bits

Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bits = npt.NDArray[np.uint32]

# Bits of a stratum in each of the two dimensions.
_STRATUM_BITS = 3
STRATA = 1 << 2 * _STRATUM_BITS


def interleaved(x: Long, y: Long) -> Long:
    """Morton's order of the plane: the bits of x and y (N,), in turns."""
    code = np.zeros(len(x), np.int64)
    for bit in range(20):
        code |= (x >> bit & 1) << 2 * bit + 1 | (y >> bit & 1) << 2 * bit
    return code


def strata_of_texels(x: Long, y: Long) -> Long:
    """The stratum that suits the texel (x, y) of a patch, each (N,) below 8: all 64 are given, and
    every aligned square of 4 or 16 texels has one in each quarter or sixteenth of the cell."""
    points = sobol_bits(2 * _STRATUM_BITS).astype(np.int64) >> 32 - _STRATUM_BITS
    return interleaved(points[:, 0], points[:, 1])[interleaved(x, y)]


@dataclass(frozen=True, kw_only=True)
class PatchDraws:
    """Where points take their random numbers from.

    seed    of all random bits
    sobol   (N, 4) numbers of 32 bits, two dimensions for each technique, with the scene's random
            bits; N = 0 for independent numbers
    shared  how many of the highest bits of each dimension are the scene's
    """

    seed: int
    sobol: Bits
    shared: tuple[int, int]


def patch_draws(seed: int, first_round: int, samples: int) -> PatchDraws:
    """Sobol points for so many ``samples``; the scene's bits are as many as give a whole
    ``first_round`` the same number of samples in each cell."""
    log2_count = int(np.ceil(np.log2(max(samples, 2))))
    # Another index than the points' and the patches', which are counted from 0.
    flips = [int(hashed_uniform(seed, -1, d) * 2.0**32) for d in range(4)]
    sobol = np.tile(sobol_bits(log2_count), 2) ^ np.array(flips, np.uint32)
    shared = (first_round & -first_round).bit_length() - 1
    return PatchDraws(seed=seed, sobol=sobol, shared=((shared + 1) // 2, shared // 2))


def independent_draws(seed: int) -> PatchDraws:
    return PatchDraws(seed=seed, sobol=np.zeros((0, 4), np.uint32), shared=(0, 0))


@loop
def scrambles_of_points(
    patch: Int, stratum: Int, identity: Long, seed: int, shared: tuple[int, int]
) -> Bits:
    """What each point's Sobol points are combined with by exclusive or, (4, P): the bits of its
    patch and its own, below the ``shared`` ones."""
    scrambles = np.empty((4, len(patch)), np.uint32)
    for d in range(4):
        below = 32 - shared[d % 2]
        own_bits = below - _STRATUM_BITS
        for k in range(len(patch)):
            flips = np.int64(hashed_uniform(seed, patch[k], 16 + d) * 2.0**_STRATUM_BITS)
            own = np.int64(hashed_uniform(seed, identity[k], d) * 2.0**own_bits)
            place = _every_other_bit(stratum[k] >> 1 - d % 2) ^ flips
            scrambles[d, k] = place << own_bits | own
    return scrambles


@loop
def _every_other_bit(code: int) -> int:
    """One of two interleaved numbers of 3 bits."""
    return code & 1 | code >> 1 & 2 | code >> 2 & 4
