"""The lit texture becomes irradiance, albedo and emitters (paper, section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Float
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import BEFORE_FILTER, Sampling
from usdbrdf.shading.clipped_light import ClippedLight, estimate_clipped_light
from usdbrdf.shading.emitters import Emitters, find_emitters
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.transport.denoise import OIDN, denoise_lightmaps
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels, whole_tiles
from usdbrdf.transport.lit_scene import TexturedScene

NEUTRAL = calibration.number("albedo.unseen")
_DARK = calibration.number("albedo.dark")
_TINY = float(np.finfo(np.float32).tiny)


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
) -> tuple[Float, float]:
    """(albedo (T, 3) in [0, 1], share of the known, non-emissive texels over 1).

    radiance, irradiance (T, 3); known (T,): the texel's radiance is not filled in, and its albedo
    need not be; emissive (T,): it shines by itself, and its albedo is 0. Objects of which nothing
    is known are NEUTRAL.
    """
    floor = _DARK * float(np.median(irradiance.mean(axis=1)))
    albedo, lit_enough = albedo_from_irradiance(radiance, irradiance, max(floor, _TINY))
    reflects = known & ~emissive
    over = (albedo > 1).any(axis=1) & reflects & lit_enough
    albedo = inpaint(texels, np.clip(albedo, 0, 1), reflects & lit_enough)
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        if not known[own].any():
            albedo[own] = NEUTRAL
    albedo[emissive] = 0
    return albedo, float(over.sum() / max(reflects.sum(), 1))


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
