"""Irradiance at every texel, traced tile by tile so that a kill costs one tile."""

from __future__ import annotations

from functools import partial

import numpy as np

from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Float
from usdbrdf.model.texels import Texels
from usdbrdf.options import Sampling
from usdbrdf.transport.denoise import denoise_lightmaps
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels, whole_tiles
from usdbrdf.transport.textured_scene import TexturedScene

# Irradiance is traced and saved in pieces of this many texels: what a kill can cost, and what
# bounds the memory of the ray buffers.
_TILE = 1 << 15


def trace_irradiance(
    run: TaskRun, surface: TexturedScene, lit: Float, environment: Environment, sampling: Sampling
) -> Irradiance:
    """S at all texels with the radiance ``lit`` (T, 3) as the light, from where a kill left it."""
    texels = surface.texels
    radiance, lights = surface.texture(lit), surface.lights(lit)
    # In less light than this the texel's albedo would be over 1 and is not to be had: lamps, and
    # surfaces lit from outside the scan.
    dark = np.pi * lit.mean(axis=1)
    order, patch = tiles_of_texels(texels)
    tiles = tiles_of_patches(patch)
    say(f"shade: {len(texels):,} texels, {len(lights.face):,} bright triangles")

    def tile(part: slice) -> dict[str, Array]:
        index = order[part]
        found = irradiance_at(
            surface.rays, radiance, lights, environment, texels.position[index],
            texels.normal[index], patch[part], sampling, surface.diagonal_m, dark[index],
        )  # fmt: skip
        return dict(vars(found))

    parts: dict[str, list[Array]] = {}
    for number, part in enumerate(progress(tiles, total=len(tiles), label="shade", unit="tiles")):
        done = run.checkpoint(f"tile-{number}", partial(tile, part))
        for name, values in done.items():
            parts.setdefault(name, []).append(values)
    back = np.argsort(order)
    return Irradiance(**{name: np.concatenate(values)[back] for name, values in parts.items()})


def tiles_of_patches(patch: Array) -> list[slice]:
    """Ranges of about _TILE texels that do not cut a patch."""
    return whole_tiles(patch, _TILE)


def denoised_irradiance(texels: Texels, irradiance: Float) -> Float:
    """Each object's S (T, 3) through the lightmap filter."""
    pictures = (texels.image(i, irradiance) for i in range(len(texels.resolution)))
    filtered = denoise_lightmaps(pictures)
    return np.concatenate([texels.from_image(i, picture) for i, picture in enumerate(filtered)])
