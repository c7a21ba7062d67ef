"""From numbers in the unit square to directions and back to their densities."""

from __future__ import annotations

import math

import numpy as np

from usdbrdf.kernel import kernel, loop, parallel_kernel
from usdbrdf.model.arrays import Bits, Double, Float, Long


def sobol_bits(log2_count: int) -> Bits:
    """The first 2**log2_count points of Sobol's two-dimensional sequence as numbers of 32 bits,
    (N, 2). Combined with random bits by exclusive or (T. Kollig and A. Keller, "Efficient
    Multidimensional Sampling", 2002) they stay one in each cell of every grid of 2**m cells."""
    index: Bits = np.arange(1 << log2_count, dtype=np.uint32)
    # In the order of Gray's code, in which one number follows from the one before it.
    code: Bits = index ^ index >> np.uint32(1)
    points = np.zeros((len(index), 2), np.uint32)
    direction: Bits = np.full(2, 1 << 31, np.uint32)
    for bit in range(log2_count):
        points ^= (code >> np.uint32(bit) & np.uint32(1))[:, None] * direction
        direction = direction >> np.uint32(1) ^ direction * np.array([0, 1], np.uint32)
    return points


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
    """Uniform numbers that depend on those ``numbers`` (N,) and the seed only, (N, dimensions)."""
    shifts = np.zeros((len(numbers), dimensions))
    for i in range(len(numbers)):
        for d in range(dimensions):
            # Other draws than a point's own ones, whose numbers are counted from 0 as well.
            shifts[i, d] = hashed_uniform(seed, numbers[i], 16 + d)
    return shifts


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
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0], b, sign + n[1] * n[1] * a, -n[1])


def axes_across(direction: Double) -> tuple[Double, Double]:
    """Two unit vectors (3,) that make a right-handed frame with a unit vector (3,)."""
    right = np.cross(np.eye(3)[np.abs(direction).argmin()], direction)
    right /= np.linalg.norm(right)
    return right, np.cross(direction, right)


@kernel
def triangle_point(u1: float, u2: float) -> tuple[float, float]:
    """Uniform barycentric (u, v) of a triangle from the unit square (E. Heitz, "A Low-Distortion
    Map Between Triangle and Square", 2019)."""
    if u2 > u1:
        u = u1 * 0.5
        return u, u2 - u
    v = u2 * 0.5
    return u1 - v, v


# Constants in the loops' own precision: with Python's the compiler would go over to doubles.
_ONE, _TWO, _HALF, _EIGHTH_TURN = (np.float32(c) for c in (1, 2, 0.5, math.pi / 4))
_S3, _S5, _S7, _S9 = (np.float32(c) for c in (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880))
_C2, _C4, _C6, _C8 = (np.float32(c) for c in (-1 / 2, 1 / 24, -1 / 720, 1 / 40320))
_BIT = np.float32(2.0**-24)


@loop
def fractions(point: int, scramble: Bits, out: Float) -> None:
    """Scrambled numbers of 32 bits -> [0, 1)."""
    bits = np.uint32(point)
    for k in range(len(out)):
        out[k] = np.float32(np.int32(np.uint32(bits ^ scramble[k]) >> np.uint32(8))) * _BIT


@loop
def on_hemisphere(x: Float, y: Float, z: Float) -> None:
    """Numbers (x, y) in the unit square -> cosine-distributed (x, y, z), all (P,), as
    ``warps.cosine_direction`` does."""
    for k in range(len(x)):
        a = _TWO * x[k] - _ONE
        b = _TWO * y[k] - _ONE
        wide = abs(a) > abs(b)
        r = a if wide else b
        other = b if wide else a
        t = _EIGHTH_TURN * (other / (r if r != 0 else _ONE))
        # Sine and cosine by their series, within 4e-8 and 2e-7 between +-pi/4.
        q = t * t
        sine = t * (_ONE + q * (_S3 + q * (_S5 + q * (_S7 + q * _S9))))
        cosine = _ONE + q * (_C2 + q * (_C4 + q * (_C6 + q * _C8)))
        x[k] = r * (cosine if wide else sine)
        y[k] = r * (sine if wide else cosine)
        z[k] = np.float32(math.sqrt((_ONE - r) * (_ONE + r)))


@loop
def in_triangle(u: Float, v: Float) -> None:
    """Numbers (u, v) in the unit square -> barycentric (u, v), as ``warps.triangle_point`` does."""
    for k in range(len(u)):
        low = v[k] > u[k]
        half = _HALF * (u[k] if low else v[k])
        u[k], v[k] = (half if low else u[k] - half), (v[k] - half if low else half)


def cosine_rays(normal: Float, identity: Long, seed: int, samples: int) -> Float:
    """Directions (samples * N, 3) about the normals (N, 3): those of sample s are s * N to
    (s + 1) * N. A point's random numbers follow from its ``identity`` (N,) and the seed."""
    directions = np.zeros((samples, len(normal), 3), np.float32)
    _cosine_rays(len(normal), normal, identity, seed, directions)
    return directions.reshape(-1, 3)


@parallel_kernel
def _cosine_rays(
    first: int, last: int, normal: Float, identity: Long, seed: int, directions: Float
) -> None:
    for k in range(first, last):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        n = normal[k]
        for sample in range(len(directions)):
            u1 = hashed_uniform(seed, identity[k], sample * 2)
            u2 = hashed_uniform(seed, identity[k], sample * 2 + 1)
            x, y, z = cosine_direction(u1, u2)
            directions[sample, k, 0] = x * tx + y * bx + z * n[0]
            directions[sample, k, 1] = x * ty + y * by + z * n[1]
            directions[sample, k, 2] = x * tz + y * bz + z * n[2]
