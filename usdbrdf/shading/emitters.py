"""Which texels shine by themselves: S holds everything but a texel's own emission, so pi L_d / S
well above 1 is impossible for a reflector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.texels import Texels

EMITTER_RATIO = calibration.number("emitters.ratio")
_WHOLE_LAMP = calibration.number("emitters.whole_lamp")
_MIN_PATCH = calibration.count("emitters.min_texels")


@dataclass(frozen=True, kw_only=True)
class Emitters:
    """emissive (T,) bool per texel; is_lamp (num_objects,) bool: the object shines as a whole;
    radiance (num_objects, 3) float32: area-weighted mean of its emissive, seen texels (0 where
    there are none); lower_bound (num_objects,) bool: less than a tenth of that area was ever seen
    unsaturated, so the radiance can only be larger."""

    emissive: Bool
    is_lamp: Bool
    radiance: Float
    lower_bound: Bool


def find_emitters(
    texels: Texels,
    radiance: Float,
    irradiance: Float,
    seen: Bool,
    clipped: Bool,
    far: Bool,
    unknown_lamp: float = 0.0,
) -> Emitters:
    """Emissive texels from L_d and S (T, 3), grouped per object.

    seen (T,): the texel's radiance was observed; clipped (T,): only as a lower bound; far (T,): it
    shows the surroundings, which shine, seen or not.
    unknown_lamp: the radiance, a lower bound, of a lamp that is in S with no more than that. S is
    then too dark, so that dimmer measured surfaces exceed it without shining. 0 if there is none.
    """
    light = radiance.mean(axis=1)
    shines = np.pi * light > EMITTER_RATIO * irradiance.mean(axis=1)
    # A texel that no light reaches is dark, not a lamp: it must also beat the scene's median.
    shines &= light > np.median(light[~far])
    shines &= clipped | (light >= unknown_lamp)
    shines |= far
    known = seen | clipped
    emissive = np.zeros(len(texels), np.bool_)
    num_objects = len(texels.resolution)
    is_lamp = np.zeros(num_objects, np.bool_)
    mean = np.zeros((num_objects, 3), np.float32)
    lower_bound = np.zeros(num_objects, np.bool_)
    for i in range(num_objects):
        own = texels.of_object(i)
        area = np.where(known[own], texels.area[own], 0)
        is_lamp[i] = area.sum() > 0 and (area * shines[own]).sum() > _WHOLE_LAMP * area.sum()
        if is_lamp[i]:
            emissive[own] = True
        else:
            emissive[own] = _connected(texels, i, shines[own] & known[own])
        weight = area * emissive[own]
        exact = weight * seen[own]
        # Some of a lamp is often seen in long exposures alone; what the short one shows counts.
        lower_bound[i] = exact.sum() < 0.1 * weight.sum()
        if not lower_bound[i]:
            weight = exact
        if weight.sum() > 0:
            mean[i] = (radiance[own] * weight[:, None]).sum(axis=0) / weight.sum()
    return Emitters(emissive=emissive, is_lamp=is_lamp, radiance=mean, lower_bound=lower_bound)


def _connected(texels: Texels, index: int, shines: Bool) -> Bool:
    """Keep only groups of at least _MIN_PATCH texels that touch each other in the atlas."""
    if np.count_nonzero(shines) < _MIN_PATCH:
        return np.zeros_like(shines)
    width, height = texels.resolution[index]
    picture = np.zeros(width * height, np.bool_)
    local = texels.pixel[texels.of_object(index)] - texels.first_pixel[index]
    picture[local] = shines
    label, _ = ndimage.label(picture.reshape(height, width), np.ones((3, 3)))
    large = np.bincount(label.ravel()) >= _MIN_PATCH
    large[0] = False
    return np.asarray(large[label.ravel()[local]], np.bool_)
