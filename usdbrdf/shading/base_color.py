"""What a surface reflects: pi L_d / S (paper, section 3.3), in one lighting or in several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.inpaint import inpaint

NEUTRAL = calibration.number("albedo.unseen")
# What comes from a surface, in units of what reaches it, above which it shines by itself.
EMITTER_RATIO = calibration.number("emitters.ratio")
_DARK = calibration.number("albedo.dark")
_OF_LIGHTING = calibration.number("albedo.error_of_lighting")
_TINY = float(np.finfo(np.float32).tiny)
_MOST_RATIO = calibration.number("emitters.most_ratio")


def clear_of(doubt: npt.ArrayLike) -> Double:
    """pi L_d / S above which a texel shines, where S has the relative standard error ``doubt``."""
    return np.minimum(EMITTER_RATIO * (1 + 2 * np.asarray(doubt, np.float64)), _MOST_RATIO)


def albedo_from_irradiance(
    diffuse_radiance: Float, irradiance: Float, floor: float
) -> tuple[Float, Bool]:
    """Lambertian albedo of each texel, rho = pi L_d / S (paper, section 3.3).

    diffuse_radiance (T, 3) float32, L_d, scene-linear; irradiance (T, 3) float32, S, W/m^2;
    floor: S below it is unknown, not dark. Returns rho (T, 3) float32, not clipped and 0 where
    unknown, and known (T,) bool.
    """
    known: Bool = np.all(irradiance > floor, axis=1)
    rho = np.where(known[:, None], np.pi * diffuse_radiance / np.maximum(irradiance, floor), 0)
    return rho.astype(np.float32), known


def albedo_map(
    texels: Texels, radiance: Float, irradiance: Float, known: Bool, emissive: Bool
) -> tuple[Float, Bool]:
    """(albedo (T, 3) in [0, 1], (T,) the known, non-emissive texels that would be over 1).

    radiance, irradiance (T, 3); known (T,): the texel's radiance is not filled in, and its albedo
    need not be; emissive (T,): it shines by itself, and its albedo is 0. Objects of which nothing
    is known are NEUTRAL.
    """
    albedo, tells = albedo_where_lit(radiance, irradiance, known & ~emissive)
    over = (albedo > 1).any(axis=1) & tells
    return _filled_in(texels, np.clip(albedo, 0, 1), tells, known, emissive), over


class Reflection(NamedTuple):
    """One lighting: of T texels radiance and irradiance (T, 3), as ``albedo_map`` has them and
    ``known`` and ``emissive`` (T,) too; error (T,), standard deviation of radiance / irradiance
    relative to it, as far as the samples and the rays tell; bound (T,), W/(m^2 sr): of what clips
    in every frame how bright its brightest channel is at least, of all else 0."""

    radiance: Float
    irradiance: Float
    error: Float
    known: Bool
    emissive: Bool
    bound: Float

    @property
    def measured(self) -> Bool:
        """(T,): more is known than a bound."""
        return np.asarray(self.known & (self.bound == 0), np.bool_)

    def as_bright_as_bounds(self, base_color: Float) -> Float:
        """A base colour (T, 3), brighter where it reflects less than frames saw at least; its hue
        stays, for one channel alone may have clipped, and no channel exceeds 1."""
        # In double precision: what nothing shines on may be any times too dark.
        reflected = (base_color.astype(np.float64) * self.irradiance).max(axis=1) / np.pi
        brighter = np.maximum(self.bound / np.maximum(reflected, _TINY), 1)
        brighter = np.minimum(brighter, 1 / np.maximum(base_color.max(axis=1), _TINY))
        return np.asarray(base_color * np.maximum(brighter, 1)[:, None], np.float32)


def base_color_of(texels: Texels, lightings: Sequence[Reflection]) -> Float:
    """(T, 3) in [0, 1]: the albedo that all lightings tell, each weighted by the inverse of its
    variance; what shines in one of them, others tell alone. What clips in every frame has the hue
    of its object's measured texels: its own is unknown."""
    if len(lightings) == 1:
        (only,) = lightings
        seen = only.radiance, only.irradiance, only.measured, only.emissive
        return only.as_bright_as_bounds(albedo_map(texels, *seen)[0])
    total, weights = np.zeros((len(texels), 3), np.float32), np.zeros(len(texels), np.float32)
    for one in lightings:
        albedo, tells = albedo_where_lit(one.radiance, one.irradiance, one.measured & ~one.emissive)
        weight = 1 / (one.error**2 + _OF_LIGHTING**2)
        weight = np.where(tells, weight, 0).astype(np.float32)
        total += weight[:, None] * np.clip(albedo, 0, 1)
        weights += weight
    known = np.any([one.measured & ~one.emissive for one in lightings], axis=0)
    emissive = np.all([one.emissive for one in lightings], axis=0)
    mean = total / np.maximum(weights, _TINY)[:, None]
    base_color = _filled_in(texels, np.asarray(mean, np.float32), weights > 0, known, emissive)
    for one in lightings:
        brighter = one.as_bright_as_bounds(base_color)
        base_color = np.where((weights > 0)[:, None], base_color, brighter)
    return base_color


def albedo_where_lit(radiance: Float, irradiance: Float, reflects: Bool) -> tuple[Float, Bool]:
    """Albedo (T, 3), not clipped, and which texels of those that reflect it is known of."""
    floor = _DARK * float(np.median(irradiance.mean(axis=1)))
    albedo, lit_enough = albedo_from_irradiance(radiance, irradiance, max(floor, _TINY))
    return albedo, reflects & lit_enough


def _filled_in(texels: Texels, albedo: Float, tells: Bool, known: Bool, emissive: Bool) -> Float:
    albedo = inpaint(texels, albedo, tells)
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        if not known[own].any():
            albedo[own] = NEUTRAL
    albedo[emissive] = 0
    return albedo
