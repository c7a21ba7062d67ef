"""Cosine-distributed rays of surface points, in any number of threads.

N points take samples ``start`` to ``stop``; ray r = (sample - start) * N + point.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.kernel import parallel_kernel
from usdbrdf.shading.warps import cosine_direction, hashed_uniform, tangent_frame

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]

# Where N points take their random numbers from: Sobol points (S, 5), or none of them for
# independent numbers; a shift per patch (P, 5); each point's patch (N,); seed; identity (N,).
Draws: TypeAlias = tuple[Double, Double, Int, int, Long]


@parallel_kernel
def cosine_rays(normal: Float, draws: Draws, start: int, stop: int) -> Float:
    """Cosine-distributed directions (R, 3) about the normals (N, 3), by independent numbers."""
    _, _, _, seed, identity = draws
    count = len(normal)
    directions = np.zeros((count * (stop - start), 3), np.float32)
    for k in prange(count):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        n = normal[k]
        for sample in range(start, stop):
            u1 = hashed_uniform(seed, identity[k], sample * 2)
            u2 = hashed_uniform(seed, identity[k], sample * 2 + 1)
            x, y, z = cosine_direction(u1, u2)
            r = (sample - start) * count + k
            directions[r, 0] = x * tx + y * bx + z * n[0]
            directions[r, 1] = x * ty + y * by + z * n[1]
            directions[r, 2] = x * tz + y * bz + z * n[2]
    return directions
