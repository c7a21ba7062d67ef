"""Inside step 3: irradiance at every texel, traced tile by tile so that a kill costs one tile."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import StageRun
from usdbrdf.model.arrays import Float
from usdbrdf.model.texels import Texels
from usdbrdf.tasks.atlas import Atlas
from usdbrdf.transport.denoise import denoise_lightmaps
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.irradiance import (
    Irradiance,
    Sampling,
    irradiance_at,
    tiles_of_texels,
    whole_tiles,
)
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import surface_texture

# Irradiance is traced and saved in pieces of this many texels: what a kill can cost, and what
# bounds the memory of the ray buffers.
_TILE = 1 << 15


def trace_irradiance(
    run: StageRun,
    atlas: Atlas,
    rays: RayScene,
    lit: Float,
    environment: Environment,
    sampling: Sampling,
) -> Irradiance:
    """S at all texels with the radiance ``lit`` (T, 3) as the light, from where a kill left it."""
    scene, texels = atlas.scene, atlas.texels
    radiance = surface_texture(texels, scene.face_object, lit)
    lights = lights_from_radiance(scene, texels, lit)
    size = float(np.linalg.norm(np.ptp(scene.points, axis=0)))
    # In less light than this the texel's albedo would be over 1 and is not to be had: lamps, and
    # surfaces lit from outside the scan.
    dark = np.pi * lit.mean(axis=1)
    order, patch = tiles_of_texels(texels)
    tiles = tiles_of_patches(patch)
    say(f"shade: {len(texels):,} texels, {len(lights.face):,} bright triangles")

    def tile(part: slice) -> dict[str, npt.NDArray[Any]]:
        index = order[part]
        found = irradiance_at(
            rays, radiance, lights, environment, texels.position[index], texels.normal[index],
            patch[part], sampling, size, dark[index],
        )  # fmt: skip
        return dict(vars(found))

    parts: dict[str, list[npt.NDArray[Any]]] = {}
    for number, part in enumerate(progress(tiles, total=len(tiles), label="shade", unit="tiles")):
        done = run.checkpoint(f"tile-{number}", partial(tile, part))
        for name, values in done.items():
            parts.setdefault(name, []).append(values)
    back = np.argsort(order)
    return Irradiance(**{name: np.concatenate(values)[back] for name, values in parts.items()})


def tiles_of_patches(patch: npt.NDArray[np.int32]) -> list[slice]:
    """Ranges of about _TILE texels that do not cut a patch."""
    return whole_tiles(patch, _TILE)


def denoised_irradiance(texels: Texels, irradiance: Float) -> Float:
    """Each object's S (T, 3) through the lightmap filter."""
    pictures = (texels.image(i, irradiance) for i in range(len(texels.resolution)))
    filtered = denoise_lightmaps(pictures)
    return np.concatenate([texels.from_image(i, picture) for i, picture in enumerate(filtered)])
