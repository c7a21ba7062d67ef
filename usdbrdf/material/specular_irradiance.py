"""The share of irradiance that arrives by way of lobes: lamps mirrored in a floor light a ceiling.

S_nd(x) = integral of I_nd(y, -w) cos dw,    y being what x sees in direction w

L_d alone as the light (paper eq. 10) leaves it out, but for what is seen from everywhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import lift_from_surface
from usdbrdf.material.lit_scene import LitScene
from usdbrdf.material.predict import non_diffuse_radiance
from usdbrdf.material.target_frames import points_of_rays
from usdbrdf.shading.cosine_rays import cosine_rays

Float = npt.NDArray[np.float32]
Long = npt.NDArray[np.int64]


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
