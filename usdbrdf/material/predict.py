"""The specular light that known lobes send to a camera: I_nd of the paper's image model (eq. 2).

I_nd = integral of f_nd(phi, psi) L cos,    one bounce, L being the lit texture
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.material.lit_scene import LitScene
from usdbrdf.material.lobe import MIN_ALPHA
from usdbrdf.material.lobe_samples import Mixture, non_diffuse, trace_lobe_samples
from usdbrdf.material.target_frames import SurfacePoints

Float = npt.NDArray[np.float32]
Long = npt.NDArray[np.int64]

# Points are traced in pieces of this many rays: what bounds the memory.
_RAYS_AT_ONCE = 1 << 20


def non_diffuse_radiance(
    lit: LitScene,
    points: SurfacePoints,
    phi: Float,
    psi: Float,
    rays: int,
    seed: int,
    stream: Long | None = None,
) -> Float:
    """I_nd (R, 3) at surface points with lobes phi, psi (R,), from ``rays`` rays each.

    Of the rays, 5/8 follow the point's own lobe and the rest go to the lights, both weighted by the
    balance heuristic. All ``points`` must lie on the surface. Every point draws its own random
    numbers, from ``seed`` and its number in ``stream`` (R,), else its place in the array.
    """
    mixture = Mixture(per_lobe=rays - 3 * rays // 8, lights=3 * rays // 8, cosine=0)
    alphas = np.maximum(phi, MIN_ALPHA).astype(np.float64)[:, None]
    result = np.zeros((len(phi), 3), np.float32)
    step = max(1, _RAYS_AT_ONCE // rays)
    for start in range(0, len(phi), step):
        part = np.arange(start, min(start + step, len(phi)))
        samples = trace_lobe_samples(
            lit.rays, points.take(part), lit.radiance, lit.lights, lit.environment, mixture,
            lit.size, seed, part if stream is None else stream[part], alphas[part],
        )  # fmt: skip
        base, slope = non_diffuse(samples, phi[part, None].astype(np.float32))
        result[part] = base[..., 0] + psi[part, None] * slope[..., 0]
    return result
