"""Task 2: frames become the lit diffuse texture L_d and its companions, one atlas per object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from usdbrdf.asset.layers.interface import write_interface
from usdbrdf.asset.layers.task_layers import write_texturing_layer, write_uv_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps, MapWriter, TexelMap, overview
from usdbrdf.asset.properties import TexturedObject
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.job.units import HERE, Workers
from usdbrdf.options import TextureOptions
from usdbrdf.tasks.task import Task, warned
from usdbrdf.tasks.unwrap import charts_of_lightings, new_charts
from usdbrdf.texturing.earlier import GoingOn
from usdbrdf.texturing.lit_texture import LitTexture, lit_texture_from_frames
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import RayScene


def texture(asset: Asset, options: TextureOptions, workers: Workers = HERE) -> TaskResult:
    """Unwrap every object, project the frames, write texturing.usda and its EXR maps; of one of
    several lightings, which are unwrapped together before, its own layer and maps."""
    maps = AssetMaps(open_weaker(asset, "texturing"))
    task = Task(
        asset=asset,
        name="texture",
        role="texturing",
        parameters={k: v for k, v in asdict(options).items() if k != "memory"},
        inputs=hashes_of_inputs(asset, "texturing", maps, photographs=True),
    )

    def work(run: TaskRun) -> dict[str, Any]:
        scene, frames = maps.scene, maps.frames
        rays = RayScene(scene.points, scene.triangles)
        if asset.lighting:
            going_on = GoingOn.afresh(run, frames, charts_of_lightings(maps))
        else:
            new = partial(new_charts, maps, rays, options)
            # The input's own texture coordinates may be taken over.
            made_for = {**task.parameters, "geometry": task.inputs.get("geometry", "")}
            going_on = GoingOn.of(run, scene, frames, made_for, new)
        charts = going_on.charts
        scene = replace(scene, corner_uv=charts["corner_uv"])
        surface = TexturedScene(scene, texels_from_atlas(scene, charts["resolution"]), rays)
        sides = charts["sides"].tolist()
        side = 1000 * float(np.median(sides))
        say(f"texture: {len(surface.texels):,} texels of {side:.3g} mm, {len(frames)} frames")
        found = lit_texture_from_frames(
            run, surface, frames, options.quantile, options.memory, going_on
        )
        doubts = warned(found.doubts())
        writer = MapWriter(run, asset, scene, surface.texels)
        objects = _write_maps(writer, found, sides, options.quantile)
        if not asset.lighting:
            uv = run.output(f"layers/{asset.uv_layer.name}")
            write_uv_layer(uv, task.draft, objects, maps.stage)
        layer = run.output(f"layers/{asset.layer('texturing').name}")
        write_texturing_layer(layer, task.draft, objects)
        write_interface(run.output(f"layers/{asset.interface('texturing').name}"), layer)
        view = overview(scene, rays, frames)
        view.write(run.output(asset.preview("lit")), surface.texels, found.lit)
        return {
            "texel_size": float(np.median(sides)),
            "texels": len(surface.texels),
            "measured_fraction": float(found.coverage.measured.mean()),
            "clipped_fraction": float(found.coverage.clipped.mean()),
            "glimpsed_fraction": float(found.coverage.glimpsed.mean()),
            "unseen_objects": [item.identifier for item in objects if not item.seen],
            "contradicting_frames": found.contradicting,
            "warnings": doubts + found.contradictions(),
        }

    return task.run(work, workers)


def _write_maps(
    writer: MapWriter, found: LitTexture, sides: Sequence[float], quantile: float
) -> list[TexturedObject]:
    """Every object's pictures, and the record that names them."""
    maps = {
        "lit": TexelMap(found.lit, 1.0, "W/(m^2 sr)"),
        "mean": TexelMap(found.mean, 1.0, "W/(m^2 sr)"),
        "spread": TexelMap(found.spread, 1.0, "W/(m^2 sr)", colour=False),
        "samples": TexelMap(found.samples, 1 / 32, "1", colour=False),
        "coverage": TexelMap(found.coverage.stored(), 1.0, "1", colour=False),
    }
    scene, texels = writer.scene, writer.texels
    assert scene.corner_uv is not None
    measured, clipped = found.coverage.measured, found.coverage.clipped
    numbered, objects = list(enumerate(scene.objects)), []
    for i, obj in progress(numbered, total=len(numbered), label="texture: writing", unit="objects"):
        own = texels.of_object(i)
        width, height = (int(side) for side in texels.resolution[i])
        objects.append(
            TexturedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                corner_uv=scene.corner_uv[obj.faces],
                aovs=writer.write(i, maps),
                texel_size=sides[i],
                seen_fraction=float(measured[own].mean()),
                clipped_fraction=float(clipped[own].mean()),
                resolution=(width, height),
                seen=bool(found.coverage.observed[own].any()),
                quantile=quantile,
            )
        )
    return objects
