"""The specular light that known lobes send to a camera, I_nd of the paper's image model (eq. 2),
and to other surfaces: lamps mirrored in a floor light a ceiling."""

from __future__ import annotations

import numpy as np

from usdbrdf.model.arrays import Float, Long
from usdbrdf.transport.brdf import MIN_ALPHA
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, points_of_rays
from usdbrdf.transport.lobe_samples import Mixture, non_diffuse, trace_lobe_samples
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.warps import cosine_rays

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


def specular_irradiance(
    lit: LitScene,
    position: Float,
    normal: Float,
    identity: Long,
    phi: Float,
    psi: Float,
    *,
    rays: int,
    rays_of_lobe: int,
    seed: int,
) -> Float:
    """S_nd (N, 3), W/m^2, at N surface points with normals (N, 3), world; unbiased.

    phi, psi      (num_objects,) the lobe of each object; what emits reflects nothing
    identity      (N,) numbers of the points, of which their random numbers follow
    rays          cosine-distributed rays per point, and ``rays_of_lobe`` from where each ends
    """
    count = len(position)
    origin = np.tile(lift_from_surface(position, normal, lit.size), (rays, 1))
    directions = cosine_rays(normal, identity, seed, rays)
    points = points_of_rays(lit.rays, lit.scene, origin, directions)
    emits = lit.emission.at(points.face, points.u, points.v)[:, 0] > 0.5
    reflects = np.flatnonzero((points.face >= 0) & ~emits)
    owner = lit.scene.face_object[points.face[reflects]]
    arriving = np.zeros((len(directions), 3), np.float32)
    number = (rays * identity + np.arange(rays)[:, None]).ravel()[reflects]
    arriving[reflects] = non_diffuse_radiance(
        lit, points.take(reflects), phi[owner], psi[owner], rays_of_lobe, seed, number
    )
    mean: Float = arriving.reshape(rays, count, 3).mean(axis=0)
    return np.float32(np.pi) * mean
