"""Task 3: irradiance by ray tracing with L_d as the light, albedo = pi L_d / S, emitters."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from usdbrdf.asset.directives import by_number, directives_of
from usdbrdf.asset.layers.interface import write_interface
from usdbrdf.asset.layers.lights_layer import Lamp, world_from_root, write_lights_layer
from usdbrdf.asset.layers.task_layers import write_shading_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps, MapWriter, TexelMap, overview
from usdbrdf.asset.properties import ShadedObject, colour
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.job.units import HERE, Workers
from usdbrdf.model.mesh import LAMP, OF_SHADE
from usdbrdf.options import NO_LIGHT, ShadeOptions, kind_of_light
from usdbrdf.shading.lamp_shapes import shapes_of_object
from usdbrdf.shading.shaded import Shaded, shade_surface
from usdbrdf.tasks.outside import outside_of, with_panes, write_outside
from usdbrdf.tasks.task import Task, warned
from usdbrdf.transport.denoise import chosen_filter


def shade(asset: Asset, options: ShadeOptions, workers: Workers = HERE) -> TaskResult:
    """Trace S, divide, find the emitters; write shading.usda, lights.usda and their maps."""
    # What was done is recorded, not "auto": with pyoidn newly installed, S is made again.
    denoiser = chosen_filter(options.denoise)
    maps = AssetMaps(open_weaker(asset, "shading"))
    asked = directives_of(asset, maps.stage, OF_SHADE)
    inputs = hashes_of_inputs(
        asset, "shading", maps, aovs=("lit", "coverage", "samples", "spread"),
        environment=options.environment, photographs=options.environment != NO_LIGHT,
    )  # fmt: skip
    parameters = {
        **asdict(options.sampling),
        "denoise": denoiser,
        "environment": kind_of_light(options.environment),
        **({"directives": asked} if asked else {}),
    }
    task = Task(asset=asset, name="shade", role="shading", parameters=parameters, inputs=inputs)

    def work(run: TaskRun) -> dict[str, Any]:
        said = {i: word == LAMP for i, word in by_number(asked, maps.scene.objects).items()}
        surface = with_panes(run, maps, options, task.header.up_axis, said)
        outside = outside_of(run, maps, surface, options, task.header.up_axis, said)
        # Where nothing is outside, what panes show is all that is known of the light behind them.
        seen = surface if outside else maps.surface, maps.lit, maps.coverage, maps.frames, outside
        shaded = shade_surface(run, *seen, options.sampling, denoiser, said, lambda: maps.differing)
        published = write_outside(run, asset, outside) if outside else None
        writer = MapWriter(run, asset, maps.scene, maps.texels)
        objects = [
            replace(item, directive=asked.get(item.identifier, ""))
            for item in _write_maps(writer, shaded)
        ]
        layer = run.output(f"layers/{asset.layer('shading').name}")
        write_shading_layer(layer, task.draft, objects, published)
        shapes = partial(shapes_of_object, maps.scene, maps.texels, shaded.emission)
        lamps = [
            Lamp(prim_path=item.prim_path, identifier=item.identifier, shapes=shapes(i))
            for i, item in enumerate(objects)
            if item.emitter
        ]
        lights = run.output(f"layers/{asset.lights_layer.name}")
        write_lights_layer(lights, task.draft, lamps, published, world_from_root(maps.stage))
        write_interface(run.output(f"layers/{asset.interface('shading').name}"), layer, lights)
        view = overview(maps.scene, maps.surface.rays, maps.frames)
        view.write(run.output(asset.preview("albedo")), maps.texels, shaded.albedo, exposure=1)
        view.write(run.output(asset.preview("irradiance")), maps.texels, shaded.irradiance)
        doubts = warned(shaded.doubts(identifiers := [item.identifier for item in objects]))
        summary = shaded.summary(identifiers) | {"denoise": denoiser, "warnings": doubts}
        return summary | ({"outside": published.summary} if published else {})

    return task.run(work, workers)


def _write_maps(writer: MapWriter, shaded: Shaded) -> list[ShadedObject]:
    """Every object's pictures, and the record that names them."""
    traced = shaded.traced
    maps = {
        "irradiance": TexelMap(shaded.irradiance, 1 / np.pi, "W/m^2"),
        "stderr": TexelMap(traced.standard_error, 1 / np.pi, "W/m^2", colour=False),
        "albedo": TexelMap(shaded.albedo, 1.0, "1"),
    }
    if shaded.irradiance is not traced.mean:
        maps["irradiance_raw"] = TexelMap(traced.mean, 1 / np.pi, "W/m^2")
    if shaded.unexplained.any():
        unexplained = shaded.unexplained.astype(np.float32)
        maps["unexplained"] = TexelMap(unexplained, 1.0, "1", colour=False)
    radiances = {"emission": shaded.emission, "hidden": shaded.hidden}
    of_some = {name: TexelMap(values, 1.0, "W/(m^2 sr)") for name, values in radiances.items()}
    emitters, objects = shaded.emitters, []
    for i, obj in enumerate(writer.scene.objects):
        own = writer.texels.of_object(i)
        mean = partial(writer.texels.mean_of_object, i)
        objects.append(
            ShadedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                aovs=writer.write(
                    i, maps | {k: v for k, v in of_some.items() if v.values[own].any()}
                ),
                emitter=bool(emitters.is_lamp[i]),
                radiance=colour(emitters.radiance[i]),
                radiance_status=shaded.radiance_status(i),
                radiance_error=shaded.radiance_error(i),
                area_fraction=float(mean(emitters.emissive)),
                mean_albedo=colour(mean(shaded.albedo)),
                rays_per_texel=float(traced.rays[own].mean()),
                standard_error=float(np.median(shaded.relative_error[own])),
                escaped_fraction=float(mean(traced.escaped)),
                lets_through=i in shaded.panes,
            )
        )
    return objects
