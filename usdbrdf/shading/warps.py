"""From numbers in the unit square to directions and back to their densities."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from usdbrdf.kernel import kernel

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Long = npt.NDArray[np.int64]
Bits = npt.NDArray[np.uint32]


def sobol_points(log2_count: int, dimensions: int) -> Double:
    """The first 2**log2_count points of Sobol's sequence, (N, dimensions), unscrambled.

    Shifted modulo 1 by a random vector per point (Cranley and Patterson 1976) they give unbiased
    estimates whose error falls nearly with 1/N where the integrand is smooth.
    """
    points: Double = qmc.Sobol(dimensions, scramble=False).random_base2(log2_count)
    return points


def sobol_bits(log2_count: int) -> Bits:
    """The first 2**log2_count two-dimensional ones as numbers of 32 bits, (N, 2). Combined with
    random bits by exclusive or (T. Kollig and A. Keller, "Efficient Multidimensional Sampling",
    2002) they stay one in each cell of every grid of 2**m cells."""
    return np.asarray(sobol_points(log2_count, 2) * 2.0**32, np.uint64).astype(np.uint32)


@kernel
def hashed_uniform(seed: int, index: int, draw: int) -> float:
    """A uniform number in [0, 1) that depends on its arguments only (splitmix64 finaliser)."""
    # Odd offsets, since the finaliser leaves 0 where it is.
    x = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(index)
    x = (x + np.uint64(0x632BE59BD9B4E019)) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(draw)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return float(x >> np.uint64(11)) * 2.0**-53


@kernel
def shifts_of(numbers: Long, dimensions: int, seed: int) -> Double:
    """The random shifts of the patches with these ``numbers`` (N,), (N, dimensions)."""
    shifts = np.zeros((len(numbers), dimensions))
    for i in range(len(numbers)):
        for d in range(dimensions):
            # Other draws than a point's own ones, whose numbers are counted from 0 as well.
            shifts[i, d] = hashed_uniform(seed, numbers[i], 16 + d)
    return shifts


@kernel
def patch_shifts(num_patches: int, dimensions: int, seed: int, first: int = 0) -> Double:
    """Those of patches ``first`` and on, (num_patches, dimensions): a patch's shift depends on its
    number and the seed only."""
    return shifts_of(np.arange(first, first + num_patches), dimensions, seed)


@kernel
def cosine_direction(u1: float, u2: float) -> tuple[float, float, float]:
    """Cosine-weighted direction about +z, density cos / pi, by the concentric map of
    P. Shirley and K. Chiu, "A low distortion map between disk and square", 1997."""
    a = 2 * u1 - 1
    b = 2 * u2 - 1
    if a == 0 and b == 0:
        return 0.0, 0.0, 1.0
    if abs(a) > abs(b):
        r = a
        angle = (np.pi / 4) * (b / a)
    else:
        r = b
        angle = np.pi / 2 - (np.pi / 4) * (a / b)
    x = r * np.cos(angle)
    y = r * np.sin(angle)
    return x, y, np.sqrt(max(0.0, 1 - x * x - y * y))


@kernel
def tangent_frame(n: Float) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors that make a right-handed frame with the unit normal n (T. Duff et al.,
    "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017)."""
    sign = 1.0 if n[2] >= 0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (
        1.0 + sign * n[0] * n[0] * a,
        sign * b,
        -sign * n[0],
        b,
        sign + n[1] * n[1] * a,
        -n[1],
    )


@kernel
def triangle_point(u1: float, u2: float) -> tuple[float, float]:
    """Uniform barycentric (u, v) of a triangle from the unit square (E. Heitz, "A Low-Distortion
    Map Between Triangle and Square", 2019)."""
    if u2 > u1:
        u = u1 * 0.5
        return u, u2 - u
    v = u2 * 0.5
    return u1 - v, v
