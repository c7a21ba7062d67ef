"""Irradiance again, from what the fit knows better than the texturing did.

The lit texture as a light has three faults: it holds the specular light that most views have in
common, as if it went everywhere; it lacks the light that lobes send elsewhere; and where nobody
looked it is as bright as the nearest surface that was seen, though such places are mostly dark.
What their cure changes is small against S, so few rays do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.job.progress import progress
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Float
from usdbrdf.model.texels import Texels
from usdbrdf.options import Sampling
from usdbrdf.shading.irradiance_map import denoised_irradiance, tiles_of_patches
from usdbrdf.transport.denoise import OIDN
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import specular_irradiance

# Rays per texel for the change of the diffuse light, half of them to where it changes most; and for
# the specular light, with so many again from where each of them ends.
_DIFFUSE_RAYS = 64
_SPECULAR_RAYS, _RAYS_OF_LOBE = 8, 4
# Not the seed of the irradiance as traced: their errors must not add up.
_SEED = 0x5EED


@dataclass(frozen=True)
class Lobes:
    """phi, psi (num_objects,) float32: one lobe per object."""

    phi: Float
    psi: Float


def refined_irradiance(
    run: TaskRun,
    lit: LitScene,
    texels: Texels,
    traced: Float,
    change: Float,
    lobes: Lobes,
    lightmap_filter: str,
    seed: int,
) -> Float:
    """S (T, 3), W/m^2: as ``traced`` (T, 3) from the lit texture, with what changes if the light is
    other by ``change`` (T, 3), W/(m^2 sr), and the lobes are light as well."""
    refined = np.maximum(traced + _change(run, lit, texels, change, lobes, seed), 0)
    return denoised_irradiance(texels, refined) if lightmap_filter == OIDN else refined


def _change(
    run: TaskRun, lit: LitScene, texels: Texels, radiance: Float, lobes: Lobes, seed: int
) -> Float:
    """What the change of the diffuse ``radiance`` (T, 3) and the lobes' light add to S, traced tile
    by tile."""
    texture = lit.radiance.showing(texels, radiance)
    lights = lights_from_radiance(lit.scene, texels, np.abs(radiance))
    sampling = Sampling(standard_error=0, max_rays=_DIFFUSE_RAYS, seed=seed ^ _SEED)
    order, patch = tiles_of_texels(texels)

    def tile(part: slice) -> dict[str, npt.NDArray[Any]]:
        index = order[part]
        position, normal = texels.position[index], texels.normal[index]
        diffuse = irradiance_at(
            lit.rays, texture, lights, black_environment(), position, normal, patch[part],
            sampling, lit.diagonal_m,
        )  # fmt: skip
        specular = specular_irradiance(
            lit, position, normal, index, lobes.phi, lobes.psi,
            rays=_SPECULAR_RAYS, rays_of_lobe=_RAYS_OF_LOBE, seed=seed ^ _SEED,
        )  # fmt: skip
        return {"change": diffuse.mean + specular}

    tiles = tiles_of_patches(patch)
    changes = [
        run.checkpoint(f"refined-{number}", partial(tile, part))["change"]
        for number, part in enumerate(
            progress(tiles, total=len(tiles), label="fit: shade", unit="tiles")
        )
    ]
    back = np.argsort(order)
    return np.asarray(np.concatenate(changes)[back], np.float32)
