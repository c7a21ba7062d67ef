"""The maps of ``warps`` over many numbers at a time, in place, as loops without calls or branches:
the compiler makes vector instructions of them, several times as fast."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import loop

Float = npt.NDArray[np.float32]
Bits = npt.NDArray[np.uint32]


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
