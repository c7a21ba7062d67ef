"""Step 3: irradiance by ray tracing with L_d as the light, albedo = pi L_d / S, emitters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import UsageError
from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.surface_radiance import surface_texture
from usdbrdf.geometry.texels import Texels
from usdbrdf.job.progress import progress, say
from usdbrdf.job.stage import StageResult, StageRun
from usdbrdf.shading.albedo import albedo_from_irradiance
from usdbrdf.shading.denoise import denoise_lightmap, require_oidn
from usdbrdf.shading.emitters import Emitters, find_emitters
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.irradiance import Irradiance, Sampling, irradiance_at, patches_of_texels
from usdbrdf.shading.lights import lights_from_radiance
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.read import frames_from_stage, open_weaker
from usdbrdf.stage.records import Aov, ShadedObject
from usdbrdf.stage.shading_layer import write_shading_layer
from usdbrdf.steps.atlas import Atlas, MapWriter, TexelMap, atlas_from_stage
from usdbrdf.steps.preview import overview
from usdbrdf.steps.step import Step, hash_of_maps, weaker_layers
from usdbrdf.steps.surroundings import environment_from_file, environment_hash
from usdbrdf.steps.texture import CLIPPED, MEASURED
from usdbrdf.texturing.inpaint import inpaint

Float = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

# Irradiance is traced and saved in pieces of this many texels: what a kill can cost, and what
# bounds the memory of the ray buffers.
_TILE = 1 << 15
# More Sobol points than this fill the memory, and improve nothing.
_MAX_RAYS = 1 << 20
# Albedo of a surface that nobody saw.
NEUTRAL = 0.5
# S below this share of the scene's median is darkness in which an albedo means nothing.
_DARK = 1e-3


@dataclass(frozen=True, kw_only=True)
class ShadeOptions:
    """sampling; denoise "none" or "oidn" (lightmap filter, extra ``denoise``); environment, a
    latitude-longitude HDR picture for rays that leave the scene, None for black."""

    sampling: Sampling = field(default_factory=Sampling)
    denoise: Literal["none", "oidn"] = "none"
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
    if options.denoise == "oidn":
        require_oidn()
    layers = weaker_layers(asset, "shading")
    stage = open_weaker(asset, "shading")
    inputs = {
        **layers,
        **environment_hash(options.environment),
        "maps": hash_of_maps(asset, "lit", "coverage"),
    }
    parameters = {**asdict(options.sampling), "denoise": options.denoise}
    step = Step(asset=asset, name="shade", role="shading", parameters=parameters, inputs=inputs)

    def work(run: StageRun) -> dict[str, Any]:
        atlas = atlas_from_stage(stage)
        lit = atlas.map("lit")
        coverage = atlas.map("coverage")[:, 0]
        environment = environment_from_file(options.environment, step.header.up_axis)
        rays = RayScene(atlas.scene.points, atlas.scene.triangles)
        traced = _trace(run, atlas, rays, lit, environment, options.sampling)
        irradiance = traced.mean
        if options.denoise == "oidn":
            irradiance = _denoised(atlas.texels, traced.mean)
        shaded = _shaded(atlas, lit, coverage, traced, irradiance)
        summary = _write(run, step, atlas, lit, shaded)
        view = overview(atlas.scene, rays, frames_from_stage(stage))
        view.write(run.output("previews/albedo.png"), atlas.texels, shaded.albedo, exposure=1)
        view.write(run.output("previews/irradiance.png"), atlas.texels, irradiance)
        return summary

    return step.run(work)


def _trace(
    run: StageRun,
    atlas: Atlas,
    rays: RayScene,
    lit: Float,
    environment: Environment,
    sampling: Sampling,
) -> Irradiance:
    scene, texels = atlas.scene, atlas.texels
    radiance = surface_texture(texels, scene.face_object, lit)
    lights = lights_from_radiance(scene, texels, lit)
    size = float(np.linalg.norm(np.ptp(scene.points, axis=0)))
    # In less light than this the texel's albedo would be over 1 and is not to be had: lamps, and
    # surfaces lit from outside the scan.
    dark = np.pi * lit.mean(axis=1)
    order, patch = patches_of_texels(texels)
    tiles = list(_tiles(patch))
    say(f"shade: {len(texels):,} texels, {len(lights.face):,} bright triangles")

    def tile(first: int, last: int) -> dict[str, npt.NDArray[Any]]:
        index = order[first:last]
        found = irradiance_at(
            rays, radiance, lights, environment, texels.position[index], texels.normal[index],
            patch[first:last], sampling, size, dark[index],
        )  # fmt: skip
        return dict(vars(found))

    parts: dict[str, list[npt.NDArray[Any]]] = {}
    for number, (first, last) in enumerate(
        progress(tiles, total=len(tiles), label="shade", unit="tiles")
    ):
        done = run.checkpoint(f"tile-{number}", partial(tile, first, last))
        for name, values in done.items():
            parts.setdefault(name, []).append(values)
    back = np.argsort(order)
    return Irradiance(**{name: np.concatenate(values)[back] for name, values in parts.items()})


def _tiles(patch: npt.NDArray[np.int32]) -> Iterator[tuple[int, int]]:
    """Ranges of about _TILE texels that do not cut a patch."""
    starts = np.flatnonzero(np.diff(patch, prepend=-1))
    first = 0
    while first < len(patch):
        after = np.searchsorted(starts, first + _TILE)
        last = int(starts[after]) if after < len(starts) else len(patch)
        yield first, last
        first = last


def _denoised(texels: Texels, irradiance: Float) -> Float:
    return np.concatenate(
        [
            texels.from_image(i, denoise_lightmap(texels.image(i, irradiance)))
            for i in range(len(texels.resolution))
        ]
    )


@dataclass(frozen=True, kw_only=True)
class _Shaded:
    """What is known of all texels: traced S and its (T,) relative error; S as it is used; the
    emitters; albedo (T, 3) and the share of it that was over 1."""

    traced: Irradiance
    relative_error: Float
    irradiance: Float
    emitters: Emitters
    albedo: Float
    over_one: float


def _shaded(
    atlas: Atlas, lit: Float, coverage: Float, traced: Irradiance, irradiance: Float
) -> _Shaded:
    seen, clipped = coverage == MEASURED, coverage == CLIPPED
    emitters = find_emitters(atlas.texels, lit, irradiance, seen, clipped)
    albedo, over_one = _albedo(atlas.texels, lit, irradiance, seen, emitters)
    relative = np.sqrt((traced.standard_error**2).mean(axis=1)) / np.maximum(
        traced.mean.mean(axis=1), 1e-12
    )
    return _Shaded(
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


def _write(run: StageRun, step: Step, atlas: Atlas, lit: Float, shaded: _Shaded) -> dict[str, Any]:
    """Maps, layer and summary."""
    traced, emissive = shaded.traced, shaded.emitters.emissive
    writer = MapWriter(run, step.asset, atlas.texels)
    maps = _maps(shaded)
    emission = TexelMap(np.where(emissive[:, None], lit, 0), 1.0, "W/(m^2 sr)", exact=True)
    objects = []
    for i, obj in enumerate(atlas.scene.objects):
        emits = emissive[atlas.texels.of_object(i)].any()
        aovs = writer.write(i, obj, {**maps, "emission": emission} if emits else maps)
        objects.append(_record(atlas, shaded, i, aovs))
    write_shading_layer(
        run.output(f"layers/{step.asset.layer('shading').name}"),
        step.asset,
        step.header,
        step.provenance,
        objects,
    )
    writer.warn()
    _warn(atlas.scene.objects, shaded.emitters, traced, shaded.over_one)
    return {
        "rays_per_texel": float(traced.rays.mean()),
        "standard_error": float(np.median(shaded.relative_error)),
        "escaped_fraction": float(traced.escaped.mean()),
        "emitters": [item.identifier for item in objects if item.emitter],
        "albedo_over_one": shaded.over_one,
    }


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
        radiance_is_lower_bound=bool(emitters.lower_bound[i]),
        area_fraction=float(np.average(emitters.emissive[own], weights=area)),
        mean_albedo=_colour(np.average(shaded.albedo[own], axis=0, weights=area)),
        rays_per_texel=float(traced.rays[own].mean()),
        standard_error=float(np.median(shaded.relative_error[own])),
        escaped_fraction=float(np.average(traced.escaped[own], weights=area)),
    )


def _albedo(
    texels: Texels, lit: Float, irradiance: Float, seen: Bool, emitters: Emitters
) -> tuple[Float, float]:
    """(albedo (T, 3) in [0, 1] for the stage, share of the seen, non-emissive texels over 1)."""
    floor = _DARK * float(np.median(irradiance.mean(axis=1)))
    albedo, lit_enough = albedo_from_irradiance(lit, irradiance, max(floor, 1e-9))
    reflects = seen & ~emitters.emissive
    over = (albedo > 1).any(axis=1) & reflects & lit_enough
    albedo = inpaint(texels, np.clip(albedo, 0, 1), reflects & lit_enough)
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        if not seen[own].any():
            albedo[own] = NEUTRAL
    albedo[emitters.emissive] = 0
    return albedo, float(over.sum() / max(reflects.sum(), 1))


def _warn(objects: Any, emitters: Emitters, traced: Irradiance, over_one: float) -> None:
    if not emitters.emissive.any():
        say("warning: no emitter was found, so a relit stage will be dark. [shading.no-light]")
    for obj, bound in zip(objects, emitters.lower_bound, strict=True):
        if bound:
            say(
                f"warning: {obj.identifier}: saturated in every frame, its radiance is only a "
                "lower bound. Capture a shorter exposure. [shading.clipped]"
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
