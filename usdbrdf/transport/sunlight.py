"""What the sun brings to texels: the share of its disc that they see, which is the edge of every
shadow, by rays from all over a texel to all over the disc."""

from __future__ import annotations

import numpy as np

from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.transport.environment import Sun
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.warps import axes_across, shifts_of

# Rays of a texel: the first, and if some of these are blocked all others; texels at a time, which
# bounds the memory; random numbers of their own.
_FIRST, _ALL, _AT_ONCE, _SEED = 4, 36, 1 << 17, 0x50A
# Kronecker's sequence in four dimensions: powers of the root of x^5 = x + 1 (M. Roberts, "The
# unreasonable effectiveness of quasirandom sequences", 2018).
_ROOT = 1.1673039782614187
_STEPS = _ROOT ** -np.arange(1.0, 5.0)


def sunlight(surface: TexturedScene, index: Long, sun: Sun, seed: int) -> Float:
    """(N, 3) W/m^2 that the sun brings to texels ``index`` (N,)."""
    if not sun.shines:
        return np.zeros((len(index), 3), np.float32)
    return sunlit(surface, index, sun, seed)[:, None] * sun.irradiance.astype(np.float32)


def sunlit(surface: TexturedScene, index: Long, sun: Sun, seed: int) -> Float:
    """(N,) of texels ``index``: the cosine to the sun times the share of sun and texel between
    which nothing stands."""
    texels, found = surface.texels, np.zeros(len(index), np.float32)
    cosine = texels.normal[index] @ sun.direction
    towards = np.flatnonzero((cosine > 0) & (texels.geometric_normal[index] @ sun.direction > 0))
    for start in range(0, len(towards), _AT_ONCE):
        part = towards[start : start + _AT_ONCE]
        share = _share(surface, index[part], sun, seed, range(_FIRST))
        edge = np.flatnonzero((share > 0) & (share < 1))
        share[edge] = _share(surface, index[part[edge]], sun, seed, range(_FIRST, _ALL))
        found[part] = share * cosine[part]
    return found


def _share(surface: TexturedScene, index: Long, sun: Sun, seed: int, samples: range) -> Float:
    """(N,) share of some ``samples`` that nothing blocks, of those that lie before the surface."""
    if not len(index):
        return np.zeros(0, np.float32)
    texels, count = surface.texels, len(samples)
    drawn = shifts_of(index, 4, seed ^ _SEED)[:, None] + _STEPS * (np.array(samples)[:, None] + 1)
    drawn %= 1.0
    across, down = (drawn[..., :2] - 0.5).transpose(2, 0, 1)[..., None].astype(np.float32)
    position = texels.position[index, None] + across * texels.step_x[index, None]
    position = (position + down * texels.step_y[index, None]).reshape(-1, 3)
    normal = np.repeat(texels.geometric_normal[index], count, axis=0)
    origin = lift_from_surface(position, normal, surface.diagonal_m)
    hits = surface.light_rays.closest(origin, towards_sun(sun, drawn[..., 2:].reshape(-1, 2)))
    free = (hits.face < 0).reshape(-1, count)
    # Some of a texel's square lies beyond another wall, where the sun may shine, or, where the
    # surface is hollow, below the next triangle, where it does not.
    centre = lift_from_surface(texels.position[index], texels.geometric_normal[index],
                               surface.diagonal_m).repeat(count, axis=0)  # fmt: skip
    way = surface.light_rays.closest(centre, origin - centre)
    before = ((way.face < 0) | (way.distance > 1)).reshape(-1, count)
    num_before = before.sum(axis=1)
    share = (free & before).sum(axis=1) / np.maximum(num_before, 1)
    found: Float = np.where(num_before > 0, share, free.mean(axis=1)).astype(np.float32)
    return found


def towards_sun(sun: Sun, drawn: Double) -> Float:
    """(R, 3) float32 unit directions to points of the disc, of numbers (R, 2) between 0 and 1."""
    right, up = axes_across(sun.direction)
    radius, angle = np.tan(sun.half_angle) * np.sqrt(drawn[:, :1]), 2 * np.pi * drawn[:, 1:]
    directions = sun.direction + radius * (np.cos(angle) * right + np.sin(angle) * up)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.ascontiguousarray(directions, np.float32)
