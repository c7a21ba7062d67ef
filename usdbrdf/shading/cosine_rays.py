"""Cosine-distributed rays of surface points, by independent random numbers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.kernel import parallel_kernel
from usdbrdf.shading.warps import cosine_direction, hashed_uniform, tangent_frame

Float = npt.NDArray[np.float32]
Long = npt.NDArray[np.int64]


@parallel_kernel
def cosine_rays(normal: Float, identity: Long, seed: int, samples: int) -> Float:
    """Directions (samples * N, 3) about the normals (N, 3): those of sample s are s * N to
    (s + 1) * N. A point's random numbers follow from its ``identity`` (N,) and the seed."""
    count = len(normal)
    directions = np.zeros((count * samples, 3), np.float32)
    for k in prange(count):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        n = normal[k]
        for sample in range(samples):
            u1 = hashed_uniform(seed, identity[k], sample * 2)
            u2 = hashed_uniform(seed, identity[k], sample * 2 + 1)
            x, y, z = cosine_direction(u1, u2)
            r = sample * count + k
            directions[r, 0] = x * tx + y * bx + z * n[0]
            directions[r, 1] = x * ty + y * by + z * n[1]
            directions[r, 2] = x * tz + y * bz + z * n[2]
    return directions
