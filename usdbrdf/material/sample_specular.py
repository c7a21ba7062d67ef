"""The specular light in the samples of a frame, by a few rays each: what is taken off them."""

from __future__ import annotations

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.texels import Texels
from usdbrdf.transport.lit_scene import LitScene, points_of_texels
from usdbrdf.transport.lobe_radiance import lobe_radiance

# Rays per sample: the mean over the frames averages their noise out, so a texel that many frames
# see needs fewer of each.
_RAYS, _MANY_FRAMES, _RAYS_OF_MANY = 8, 16, 4
# Texels to a side of a tile, over which a frame's specular light is averaged, and to what share of
# a lobe's width this may spread the mirrored directions.
TILE_SIDE = 4
_BLUNT = calibration.number("refine.turn_of_tile")


def specular_of_samples(
    lit: LitScene, phi: Float, psi: Float, texel: Int, samples: Float, eye: Double, seed: int
) -> Float:
    """(M, 3) light that texels (M,), with lobes phi (M,) and psi (M, 3) and seen by ``samples``
    (M,) frames, reflect to ``eye``: each that of its whole tile, where this is little turned."""
    texels = lit.texels
    found = np.empty((len(texel), 3), np.float32)
    often = samples >= _MANY_FRAMES
    for rays, which in ((_RAYS, ~often), (_RAYS_OF_MANY, often)):
        own = texel[which].astype(np.int64)
        points = points_of_texels(texels, own, eye)
        found[which] = lobe_radiance(lit, points, phi[which], psi[which], rays, seed, own)
    return _shared(texels, phi, texel, eye, found)


def _shared(texels: Texels, phi: Float, texel: Int, eye: Double, specular: Float) -> Float:
    """Of ``specular`` (M, 3), which texels (M,) reflect to ``eye``, the means over tiles of the
    atlas, where these turn the mirrored direction by little of the lobe's width.

    A few rays meet something bright now and then, and a robust mean takes that for outliers: what
    was taken off all samples would be less than what the lobe reflects."""
    tile = np.unique(texels.tile(texel.astype(np.int64), TILE_SIDE), return_inverse=True)[1]
    count = np.bincount(tile)

    def mean(values: Float) -> Double:
        sums = [np.bincount(tile, column) / count for column in values.T]
        found: Double = np.stack(sums, axis=-1)[tile]
        return found

    position, normal = texels.position[texel], texels.normal[texel]
    away = np.linalg.norm(position - eye, axis=1)
    turn = np.linalg.norm(position - mean(position), axis=1) / np.maximum(away, 1e-12)
    turn += 2 * np.linalg.norm(normal - mean(normal), axis=1)
    # Other charts may lie in the same tile.
    apart = np.linalg.norm(position - mean(position), axis=1) > TILE_SIDE * np.sqrt(
        texels.area[texel]
    )
    narrow = mean(((turn > _BLUNT * phi) | apart)[:, None])
    return np.where(narrow > 0, specular, mean(specular)).astype(np.float32)
