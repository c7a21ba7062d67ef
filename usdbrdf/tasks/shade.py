"""Step 3: irradiance by ray tracing with L_d as the light, albedo = pi L_d / S, emitters."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.asset.layers.lights_layer import Lamp, world_from_root, write_lights_layer
from usdbrdf.asset.layers.shading_layer import write_shading_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import Aov, ShadedObject
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.frames import frames_from_stage
from usdbrdf.errors import UsageError
from usdbrdf.job.progress import say
from usdbrdf.job.task import StageResult, StageRun
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.light import LampShape
from usdbrdf.shading.emitters import Emitters, find_emitters
from usdbrdf.shading.lamp_shapes import lamp_shapes
from usdbrdf.tasks.albedo_map import albedo_map
from usdbrdf.tasks.atlas import Atlas, MapWriter, TexelMap, atlas_from_stage
from usdbrdf.tasks.clipped import ClippedLight, estimate_clipped_light
from usdbrdf.tasks.preview import overview
from usdbrdf.tasks.step import Step, hash_of_maps, weaker_layers
from usdbrdf.tasks.surroundings import environment_from_file, environment_hash
from usdbrdf.tasks.texture import CLIPPED, MEASURED
from usdbrdf.tasks.trace import denoised_irradiance, trace_irradiance
from usdbrdf.transport.denoise import AUTO, OIDN, chosen_filter
from usdbrdf.transport.irradiance import Irradiance, Sampling
from usdbrdf.transport.rays import RayScene

# What the lightmap filter is given may have this many times the standard error that was asked for:
# of 3.3 % it left 0.5 % on captures of rooms.
_BEFORE_FILTER = 1.1

# More Sobol points than this fill the memory, and improve nothing.
_MAX_RAYS = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ShadeOptions:
    """sampling; denoise "none", "oidn" (lightmap filter, extra ``denoise``) or "auto": oidn where
    it is installed; environment, a latitude-longitude HDR picture for rays that leave the scene,
    None for black."""

    sampling: Sampling = field(default_factory=Sampling)
    denoise: Literal["auto", "none", "oidn"] = AUTO
    environment: Path | None = None

    def __post_init__(self) -> None:
        if not self.sampling.standard_error >= 0:
            raise UsageError("--standard-error: must not be negative. [usage.option]")
        if not 4 <= self.sampling.max_rays <= _MAX_RAYS:
            raise UsageError(
                f"--rays {self.sampling.max_rays}: not between 4 and {_MAX_RAYS}. [usage.option]"
            )


def shade(asset: Asset, options: ShadeOptions) -> StageResult:
    """Trace S, divide, find the emitters, write shading.usda and its EXR maps."""
    # What was done is recorded, not "auto": with pyoidn newly installed, S is made again.
    lightmap_filter = chosen_filter(options.denoise)
    layers = weaker_layers(asset, "shading")
    stage = open_weaker(asset, "shading")
    inputs = {
        **layers,
        **environment_hash(options.environment),
        "maps": hash_of_maps(asset, "lit", "coverage"),
    }
    parameters = {**asdict(options.sampling), "denoise": lightmap_filter}
    step = Step(asset=asset, name="shade", role="shading", parameters=parameters, inputs=inputs)

    def work(run: StageRun) -> dict[str, Any]:
        atlas = atlas_from_stage(stage)
        coverage = atlas.map("coverage")[:, 0]
        seen, clipped = coverage == MEASURED, coverage == CLIPPED
        environment = environment_from_file(options.environment, step.header.up_axis)
        rays = RayScene(atlas.scene.points, atlas.scene.triangles)
        light = estimate_clipped_light(
            run, atlas, rays, atlas.map("lit"), seen, clipped, environment, options.sampling.seed
        )
        filtered, sampling = lightmap_filter == OIDN, options.sampling
        if filtered:
            sampling = replace(sampling, standard_error=_BEFORE_FILTER * sampling.standard_error)
        traced = trace_irradiance(run, atlas, rays, light.lit, environment, sampling)
        irradiance = denoised_irradiance(atlas.texels, traced.mean) if filtered else traced.mean
        shaded = _shaded(atlas, light, seen, clipped, traced, irradiance)
        summary = _write(run, step, atlas, shaded)
        view = overview(atlas.scene, rays, frames_from_stage(stage))
        view.write(run.output("previews/albedo.png"), atlas.texels, shaded.albedo, exposure=1)
        view.write(run.output("previews/irradiance.png"), atlas.texels, irradiance)
        return {**summary, "denoise": lightmap_filter}

    return step.run(work)


@dataclass(frozen=True, kw_only=True)
class _Shaded:
    """What is known of all texels: the light; traced S and its (T,) relative error; S as it is
    used; the emitters; albedo (T, 3) and the share of it that was over 1."""

    light: ClippedLight
    traced: Irradiance
    relative_error: Float
    irradiance: Float
    emitters: Emitters
    albedo: Float
    over_one: float


def _shaded(
    atlas: Atlas,
    light: ClippedLight,
    seen: Bool,
    clipped: Bool,
    traced: Irradiance,
    irradiance: Float,
) -> _Shaded:
    emitters = find_emitters(
        atlas.texels, light.lit, irradiance, seen, light.may_shine(clipped), light.least_of_lamps()
    )
    albedo, over_one = albedo_map(atlas.texels, light.lit, irradiance, seen, emitters.emissive)
    relative = np.sqrt((traced.standard_error**2).mean(axis=1)) / np.maximum(
        traced.mean.mean(axis=1), 1e-12
    )
    return _Shaded(
        light=light,
        traced=traced,
        relative_error=relative,
        irradiance=irradiance,
        emitters=emitters,
        albedo=albedo,
        over_one=over_one,
    )


def _maps(shaded: _Shaded) -> dict[str, TexelMap]:
    """The maps that every object has."""
    traced = shaded.traced
    maps = {
        "irradiance": TexelMap(shaded.irradiance, 1 / np.pi, "W/m^2"),
        "stderr": TexelMap(traced.standard_error, 1 / np.pi, "W/m^2"),
        "albedo": TexelMap(shaded.albedo, 1.0, "1"),
    }
    if shaded.irradiance is not traced.mean:
        maps["irradiance_raw"] = TexelMap(traced.mean, 1 / np.pi, "W/m^2")
    return maps


def _write(run: StageRun, step: Step, atlas: Atlas, shaded: _Shaded) -> dict[str, Any]:
    """Maps, layer and summary."""
    traced, emissive = shaded.traced, shaded.emitters.emissive
    shines = np.where(emissive[:, None], shaded.light.lit, 0)
    writer = MapWriter(run, step.asset, atlas.texels)
    maps = _maps(shaded)
    emission = TexelMap(shines, 1.0, "W/(m^2 sr)", exact=True)
    objects = []
    for i, obj in enumerate(atlas.scene.objects):
        emits = emissive[atlas.texels.of_object(i)].any()
        aovs = writer.write(i, obj, {**maps, "emission": emission} if emits else maps)
        objects.append(_record(atlas, shaded, i, aovs))
    write_shading_layer(
        run.output(f"layers/{step.asset.layer('shading').name}"), step.draft, objects
    )
    write_lights_layer(
        run.output(f"layers/{step.asset.lights_layer.name}"),
        step.draft,
        [
            Lamp(
                prim_path=item.prim_path,
                identifier=item.identifier,
                shapes=_light_shapes(atlas, shines, i),
            )
            for i, item in enumerate(objects)
            if item.emitter
        ],
        world_from_root(atlas.stage),
    )
    writer.warn()
    _warn(atlas.scene.objects, shaded)
    return {
        "rays_per_texel": float(traced.rays.mean()),
        "standard_error": float(np.median(shaded.relative_error)),
        "escaped_fraction": float(traced.escaped.mean()),
        "emitters": [item.identifier for item in objects if item.emitter],
        "estimated_emitters": {
            item.identifier: item.radiance_error
            for item in objects
            if item.emitter and item.radiance_status == "estimated"
        },
        "albedo_over_one": shaded.over_one,
    }


def _light_shapes(atlas: Atlas, shines: Float, i: int) -> tuple[LampShape, ...]:
    """Lights in place of lamp i, if it has a shape for that. shines (T, 3): emitted radiance."""
    own, faces = atlas.texels.of_object(i), atlas.scene.objects[i].faces
    area = atlas.texels.area[own]
    face = atlas.texels.face[own] - faces.start
    triangles = atlas.scene.triangles[faces]
    weight = np.bincount(face, area, len(triangles))
    power = np.stack([np.bincount(face, area * c, len(triangles)) for c in shines[own].T], axis=1)
    # Faces smaller than a texel may have none: they shine as the lamp does on the whole.
    mean = power.sum(axis=0) / max(weight.sum(), 1e-12)
    radiance = np.where(
        weight[:, None] > 0, power / np.maximum(weight, 1e-12)[:, None], mean
    ).astype(np.float32)
    return lamp_shapes(atlas.scene.points, triangles, radiance)


def _record(atlas: Atlas, shaded: _Shaded, i: int, aovs: tuple[Aov, ...]) -> ShadedObject:
    obj, own = atlas.scene.objects[i], atlas.texels.of_object(i)
    emitters, traced = shaded.emitters, shaded.traced
    area = np.maximum(atlas.texels.area[own], 1e-12)
    return ShadedObject(
        prim_path=obj.prim_path,
        identifier=obj.identifier,
        aovs=aovs,
        emitter=bool(emitters.is_lamp[i]),
        radiance=_colour(emitters.radiance[i]),
        radiance_status=_status(shaded, i),
        radiance_error=shaded.light.error_of_object(i) if emitters.lower_bound[i] else math.nan,
        area_fraction=float(np.average(emitters.emissive[own], weights=area)),
        mean_albedo=_colour(np.average(shaded.albedo[own], axis=0, weights=area)),
        rays_per_texel=float(traced.rays[own].mean()),
        standard_error=float(np.median(shaded.relative_error[own])),
        escaped_fraction=float(np.average(traced.escaped[own], weights=area)),
    )


def _status(shaded: _Shaded, i: int) -> str:
    """How the radiance of what shines on object i is known."""
    if not shaded.emitters.lower_bound[i]:
        return "measured"
    return "lowerBound" if math.isnan(shaded.light.error_of_object(i)) else "estimated"


def _warn(objects: Any, shaded: _Shaded) -> None:
    emitters, traced, over_one = shaded.emitters, shaded.traced, shaded.over_one
    if not emitters.emissive.any():
        say("warning: no emitter was found, so a relit stage will be dark. [shading.no-light]")
    for i, obj in enumerate(objects):
        status = _status(shaded, i)
        if status == "lowerBound":
            say(
                f"warning: {obj.identifier}: saturated in every frame, its radiance is only a "
                "lower bound. Capture a shorter exposure. [shading.clipped]"
            )
        elif status == "estimated":
            radiance = ", ".join(f"{value:.3g}" for value in emitters.radiance[i])
            say(
                f"warning: {obj.identifier}: saturated in every frame; from the light that it "
                f"casts its radiance is {radiance}, +-{100 * shaded.light.error_of_object(i):.0f} "
                "%. Capture a shorter exposure to measure it. [shading.estimated]"
            )
    if over_one > 0.05:
        say(
            f"warning: {100 * over_one:.0f} % of the seen texels have an albedo over 1 and were "
            "clamped. Check the exposures, or give the missing light as --environment. "
            "[shading.albedo]"
        )
    escaped = float(traced.escaped.mean())
    if escaped > 0.5:
        say(
            f"warning: {100 * escaped:.0f} % of the light's directions leave the scan and count as "
            "black. Give the surroundings as --environment. [shading.open]"
        )


def _colour(values: npt.NDArray[Any]) -> tuple[float, float, float]:
    r, g, b = (float(value) for value in values)
    return r, g, b
