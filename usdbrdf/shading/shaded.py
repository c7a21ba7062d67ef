"""The lit texture becomes irradiance, albedo and emitters (paper, section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Float
from usdbrdf.model.coverage import CoverageMap
from usdbrdf.options import BEFORE_FILTER, Sampling
from usdbrdf.shading.albedo import albedo_map
from usdbrdf.shading.clipped_light import ClippedLight, estimate_clipped_light
from usdbrdf.shading.emitters import Emitters, find_emitters
from usdbrdf.shading.irradiance_map import denoised_irradiance, trace_irradiance
from usdbrdf.transport.denoise import OIDN
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.irradiance import Irradiance
from usdbrdf.transport.textured_scene import TexturedScene

# Shares that are worth a warning: of the known texels with an albedo over 1, of light's directions
# that leave the scan.
_MANY_OVER_ONE, _MOSTLY_OPEN = 0.05, 0.5


@dataclass(frozen=True, kw_only=True)
class Shaded:
    """What is known of all texels.

    light           L_d (T, 3) with the estimated radiance of lamps that clipped
    traced          S as it was traced
    relative_error  (T,) float32 of that
    irradiance      (T, 3) float32, W/m^2: S as it is used; ``traced.mean`` itself if not filtered
    emitters        what shines by itself
    albedo          (T, 3) float32 in [0, 1], 0 on emitters
    over_one        share of the measured reflectors whose albedo came out over 1
    """

    light: ClippedLight
    traced: Irradiance
    relative_error: Float
    irradiance: Float
    emitters: Emitters
    albedo: Float
    over_one: float

    @property
    def emission(self) -> Float:
        """(T, 3) W/(m^2 sr): what shines by itself, zero elsewhere."""
        return np.where(self.emitters.emissive[:, None], self.light.lit, np.float32(0))

    def radiance_status(self, index: int) -> str:
        """How the radiance of what shines on an object is known: "measured"; where it clipped in
        every frame "estimated" from the light that it casts, or "lowerBound"."""
        if not self.emitters.lower_bound[index]:
            return "measured"
        return "lowerBound" if math.isnan(self.light.error_of_object(index)) else "estimated"

    def radiance_error(self, index: int) -> float:
        """Relative standard error of an object's estimated radiance, else NaN."""
        bounded = self.emitters.lower_bound[index]
        return self.light.error_of_object(index) if bounded else math.nan

    def doubts(self, identifiers: Sequence[str]) -> Iterator[str]:
        """Sentences about what a person should look at; identifiers: of the objects."""
        if not self.emitters.emissive.any():
            yield "no emitter was found, so a relit stage will be dark. [shading.no-light]"
        for i, identifier in enumerate(identifiers):
            status = self.radiance_status(i)
            if status == "lowerBound":
                yield (
                    f"{identifier}: saturated in every frame, its radiance is only a lower bound. "
                    "Capture a shorter exposure. [shading.clipped]"
                )
            elif status == "estimated":
                radiance = ", ".join(f"{value:.3g}" for value in self.emitters.radiance[i])
                yield (
                    f"{identifier}: saturated in every frame; from the light that it casts its "
                    f"radiance is {radiance}, +-{100 * self.radiance_error(i):.0f} %. Capture a "
                    "shorter exposure to measure it. [shading.estimated]"
                )
        if self.over_one > _MANY_OVER_ONE:
            yield (
                f"{100 * self.over_one:.0f} % of the seen texels have an albedo over 1 and were "
                "clamped. Check the exposures, or give the missing light as --environment. "
                "[shading.albedo]"
            )
        escaped = float(self.traced.escaped.mean())
        if escaped > _MOSTLY_OPEN:
            yield (
                f"{100 * escaped:.0f} % of the light's directions leave the scan and count as "
                "black. Give the surroundings as --environment. [shading.open]"
            )

    def summary(self, identifiers: Sequence[str]) -> dict[str, Any]:
        """Figures of the whole scene, JSON; identifiers: of the objects."""
        lamps = [i for i in range(len(identifiers)) if self.emitters.is_lamp[i]]
        return {
            "rays_per_texel": float(self.traced.rays.mean()),
            "standard_error": float(np.median(self.relative_error)),
            "escaped_fraction": float(self.traced.escaped.mean()),
            "emitters": [identifiers[i] for i in lamps],
            "estimated_emitters": {
                identifiers[i]: self.radiance_error(i)
                for i in lamps
                if self.radiance_status(i) == "estimated"
            },
            "albedo_over_one": self.over_one,
        }


def shade_surface(
    run: TaskRun,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    environment: Environment,
    sampling: Sampling,
    lightmap_filter: str,
) -> Shaded:
    """Trace S with the light ``lit`` (T, 3), L_d as texturing left it; divide; find the emitters.

    run  keeps what is done for a run that goes on
    """
    light = estimate_clipped_light(run, surface, lit, coverage, environment, sampling.seed)
    if lightmap_filter == OIDN:
        before = replace(sampling, standard_error=BEFORE_FILTER * sampling.standard_error)
        traced = trace_irradiance(run, surface, light.lit, environment, before)
        irradiance = denoised_irradiance(surface.texels, traced.mean)
    else:
        traced = trace_irradiance(run, surface, light.lit, environment, sampling)
        irradiance = traced.mean
    emitters = find_emitters(
        surface.texels,
        light.lit,
        irradiance,
        coverage.measured,
        light.may_shine(coverage.clipped),
        light.least_of_lamps(),
    )
    albedo, over_one = albedo_map(
        surface.texels, light.lit, irradiance, coverage.measured, emitters.emissive
    )
    relative = np.sqrt((traced.standard_error**2).mean(axis=1)) / np.maximum(
        traced.mean.mean(axis=1), 1e-30
    )
    return Shaded(
        light=light,
        traced=traced,
        relative_error=relative,
        irradiance=irradiance,
        emitters=emitters,
        albedo=albedo,
        over_one=over_one,
    )
