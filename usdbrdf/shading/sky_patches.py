"""The sky in patches: what of it texels see, what is thought of its radiance before the evidence,
and its picture.
"""

from __future__ import annotations

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.shading.asked import looked_around
from usdbrdf.shading.outside_light import Asked, Sources
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings
from usdbrdf.transport.environment import directions_of_pixels, pixels_of_directions
from usdbrdf.transport.lit_scene import TexturedScene

# Lower and upper elevation of a band of patches, degrees, and their number.
_BANDS = (
    (-90, -30, 4), (-30, 0, 12), (0, 8, 24), (8, 16, 24), (16, 28, 24), (28, 42, 16), (42, 65, 8),
    (65, 90, 1),
)  # fmt: skip
_PATCHES = sum(count for _, _, count in _BANDS)
_ABOVE_LIMIT = calibration.pair("outside.above_limit")
_SKY_DEVIATION = calibration.number("outside.sky_deviation")
_ALIKE = calibration.number("outside.alike")
_ALIKE_OVER_HORIZON = calibration.number("outside.alike_over_horizon")
_BESIDE = calibration.number("outside.alike_within")
_SEED = 0x51C4
# Rays by which each of the texels asked meets the sky: at first, and at least and at most where it
# does. Where less than this part of them does there are more: what a window shows is noise in few.
FIRST_RAYS, _RAYS, _MOST_RAYS, _OPEN = 32, 1024, 8192, 0.1
_DARKEST = 1e-3  # of what is usual: darker sky is none


def patches_of_sky(clipped: Bool, z_up: bool) -> Int:
    """(D,) the patch of the sky of each direction: bands of azimuths; what clips is in patches of
    its own, whose numbers follow."""
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    up, x = directions[:, 2 if z_up else 1], directions[:, 0]
    ahead = -directions[:, 1] if z_up else directions[:, 2]
    elevation, turn = np.degrees(np.arcsin(np.clip(up, -1, 1))), np.arctan2(x, ahead) / (2 * np.pi)
    patch, first = np.zeros(len(directions), np.int32), 0
    for low, high, count in _BANDS:
        band = (elevation >= low) & (elevation <= high)
        patch[band] = first + np.floor((turn[band] % 1.0) * count).astype(np.int32) % count
        first += count
    return np.where(clipped, patch + first, patch).astype(np.int32)


def enough_rays(open_share: float) -> int:
    """From each texel, if so much of what they send leaves the scan."""
    return int(np.clip(_RAYS * _OPEN / open_share, _RAYS, _MOST_RAYS))


def shares_of_sky(
    surface: TexturedScene, asked: Asked, patches: Int, z_up: bool, seed: int, rays: int
) -> tuple[Double, float]:
    """By so many rays from each, what a patch (-1: none) of radiance 1 brings to the texels asked,
    (2 _PATCHES, N), W/m^2; and the share of the light's directions that leave the scan."""
    count, num_out = len(asked.texel), 0
    met = np.zeros(2 * _PATCHES * count, np.int64)
    for turn, first in enumerate(range(0, rays, _RAYS)):
        some = min(_RAYS, rays - first)
        towards, face = looked_around(surface, asked.texel, (seed ^ _SEED) + turn, some)
        out = np.flatnonzero(face < 0)
        patch = patches[pixels_of_directions(towards[out], HEIGHT, WIDTH, z_up)]
        texel, kept = out % count, patch >= 0
        met += np.bincount(patch[kept] * count + texel[kept], minlength=len(met))
        num_out += len(out)
    brought = np.asarray(np.pi / rays * met.reshape(2 * _PATCHES, count), np.float64)
    return brought, num_out / (rays * count)


def sources_in_sky(
    asked: Asked, seen: Surroundings, patches: Int, share: Double, used: Long, z_up: bool
) -> Sources:
    """The patches that light what is asked."""
    # What clips shines as well, above what saturates.
    known, usual, dark = seen.coverage.observed, seen.trend(z_up), seen.dark
    shown = seen.radiance.astype(np.float64)
    shown[seen.coverage.clipped] *= np.exp(_ABOVE_LIMIT[0])
    # Where all is dark that was seen, but not all that lights the scan was, the rest is not.
    if not usual.any() or seen.is_night():
        usual = np.tile(np.median(asked.reflected, axis=0) / np.pi, (len(usual), 1))
    bound = used >= _PATCHES
    darkest = max(_DARKEST * float(np.median(usual.max(axis=1))), 1e-30)
    mean = np.zeros((len(used), 3))
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    centre = np.zeros((len(used), 3))
    for k, patch in enumerate(used):
        centre[k] = directions[patches % _PATCHES == patch % _PATCHES].mean(axis=0)
        near = known & (directions @ centre[k] > np.cos(_BESIDE) * np.linalg.norm(centre[k]))
        if bound[k]:
            mean[k] = np.log(seen.radiance[patches == patch].max(axis=0)) + _ABOVE_LIMIT[0]
        elif near.any():
            # Where some of it is dark, as below a horizon, as much of the patch is.
            shines = near & ~dark if (near & ~dark).any() else near
            part = np.count_nonzero(shines) / np.count_nonzero(near)
            mean[k] = np.log(np.maximum(part * np.median(shown[shines], axis=0), darkest))
        else:
            mean[k] = np.log(np.maximum(usual[patches == patch], darkest)).mean(axis=0)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    near = np.argwhere(np.triu(centre @ centre.T > np.cos(_BESIDE), 1))
    near = near[~bound[near].any(axis=1)]
    below = centre[:, 2 if z_up else 1] < 0
    apart = np.where(below[near[:, 0]] == below[near[:, 1]], _ALIKE, _ALIKE_OVER_HORIZON)
    deviation = np.where(bound, _ABOVE_LIMIT[1], _SKY_DEVIATION)
    return Sources(share[used], mean, deviation, -bound.astype(np.int64), near, apart)


def picture_of_sky(
    seen: Surroundings, patches: Int, used: Long, radiance: Double, z_up: bool
) -> Float:
    """(HEIGHT, WIDTH, 3): what was measured, and the patches."""
    filled = seen.trend(z_up)
    for patch, value in zip(used, radiance, strict=True):
        filled[patches == patch] = value
    filled = np.where(seen.coverage.clipped[:, None], np.maximum(filled, seen.radiance), filled)
    known = seen.coverage.measured[:, None]
    return np.where(known, seen.radiance, filled).reshape(HEIGHT, WIDTH, 3).astype(np.float32)
