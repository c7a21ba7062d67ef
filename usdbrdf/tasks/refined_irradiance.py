"""Inside step 4: irradiance again, from what the fit knows better than the texturing did.

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

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.job.progress import progress
from usdbrdf.job.task import StageRun
from usdbrdf.model.arrays import Float
from usdbrdf.tasks.atlas import Atlas
from usdbrdf.tasks.trace import denoised_irradiance, tiles_of_patches
from usdbrdf.transport.denoise import AUTO, NONE, OIDN, chosen_filter
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import Sampling, irradiance_at, tiles_of_texels
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import specular_irradiance

# Rays per texel for the change of the diffuse light, half of them to where it changes most; and for
# the specular light, with so many again from where each of them ends.
_DIFFUSE_RAYS = 64

_SPECULAR_RAYS, _RAYS_OF_LOBE = 8, 4

# Not the seed of the irradiance as traced: their errors must not add up.
_SEED = 0x5EED


@dataclass(frozen=True, kw_only=True)
class Lobes:
    """phi, psi (num_objects,) float32: one lobe per object."""

    phi: Float
    psi: Float


def filter_of(asset: Asset) -> str:
    """The lightmap filter that ``refined_irradiance`` takes: the shading's, if it is here too."""
    shading = asset.layer("shading")
    known = shading.is_file() and read_provenance(shading).get("parameters", {})
    return chosen_filter(AUTO) if known and known.get("denoise") == OIDN else NONE


def refined_irradiance(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    diffuse: Float,
    lobes: Lobes,
    lightmap_filter: str,
    seed: int,
) -> Float:
    """S (T, 3), W/m^2: as traced from the lit texture, with what changes if ``diffuse`` (T, 3) and
    the lobes are the light instead."""
    traced = atlas.map("irradiance_raw" if lightmap_filter == OIDN else "irradiance")
    emits = (atlas.map_where_present("emission", 3) > 0).any(axis=1, keepdims=True)
    change = np.where(emits, 0, diffuse - atlas.map("lit")).astype(np.float32)
    refined = np.maximum(traced + _change(run, atlas, lit, change, lobes, seed), 0)
    return denoised_irradiance(atlas.texels, refined) if lightmap_filter == OIDN else refined


def _change(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    radiance: Float,
    lobes: Lobes,
    seed: int,
) -> Float:
    """What the change of the diffuse ``radiance`` (T, 3) and the lobes' light add to S, traced tile
    by tile."""
    texels = atlas.texels
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
