"""Task 4: roughness and specular per object; with these, L_d and albedo without specular light."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.task_layers import write_material_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps, MapWriter, TexelMap, overview
from usdbrdf.asset.preview_lobe import MICROFACET
from usdbrdf.asset.properties import FittedObject, colour
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.files.frames import FrameReader
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.material.fit_objects import fitted_by_likelier_lobe, judged, survey_frames
from usdbrdf.material.refine import Lobes, frame_reader, refined_light
from usdbrdf.options import FitOptions, kind_of_light
from usdbrdf.tasks.task import Task
from usdbrdf.transport.brdf import PAPER
from usdbrdf.transport.denoise import AUTO, NONE, OIDN, chosen_filter
from usdbrdf.transport.lit_scene import LitScene

# The maps that the fit reads.
_READ = ("lit", "samples", "coverage", "irradiance", "irradiance_raw", "emission", "sky")


def fit(asset: Asset, options: FitOptions) -> TaskResult:
    """Choose target frames, fit every object, write material.usda and, of views, refined maps."""
    maps = AssetMaps(open_weaker(asset, "material"))
    # S is refined as it was filtered, if the filter is here too.
    shading = read_provenance(asset.layer("shading")).get("parameters", {})
    filtered = options.method == "views" and shading.get("denoise") == OIDN
    lightmap_filter = chosen_filter(AUTO) if filtered else NONE
    chosen = {k: v for k, v in asdict(options).items() if k != "memory"}
    chosen["environment"] = kind_of_light(options.environment)
    task = Task(
        asset=asset,
        name="fit",
        role="material",
        parameters={**chosen, "denoise": lightmap_filter},
        inputs=hashes_of_inputs(
            asset, "material", maps, aovs=_READ, photographs=True, environment=options.environment
        ),
    )

    def work(run: TaskRun) -> dict[str, Any]:
        lit = maps.lit_scene(maps.environment(options.environment))
        usable = maps.coverage.measured & ~maps.emissive
        reader = frame_reader(lit, maps.frames, options.memory)
        survey = survey_frames(run, lit, usable, reader, options)
        lit, found = fitted_by_likelier_lobe(run, lit, reader, survey, options, maps.irradiance)
        microfacet = lit.lobe != PAPER
        mapping = MICROFACET if microfacet and options.mapping == "matched" else options.mapping
        objects = [
            FittedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                cost=own.cost,
                evidence=own.evidence,
                target_frame=own.target if math.isfinite(own.phi) else -1,
                num_pixels=own.num_samples,
                method=options.method,
                mapping=mapping,
                lobe=MICROFACET if microfacet else "paper",
                **vars(judged(own, obj, options, maps.is_observed(i))),
            )
            for i, (obj, own) in enumerate(zip(maps.scene.objects, found, strict=True))
        ]
        measured = sum(item.status == "measured" for item in objects)
        say(f"fit: {measured} of {len(objects)} objects measured")
        if options.method == "views":
            objects = _refined(run, asset, maps, lit, reader, objects, lightmap_filter, options)
        layer = run.output(f"layers/{asset.layer('material').name}")
        networks = run.output(f"layers/{asset.materialx_layer.name}") if options.materialx else None
        write_material_layer(layer, task.draft, objects, materialx=networks)
        return {"objects": {item.identifier: item.summary for item in objects}}

    return task.run(work)


def _refined(
    run: TaskRun,
    asset: Asset,
    maps: AssetMaps,
    lit: LitScene,
    reader: FrameReader,
    objects: list[FittedObject],
    lightmap_filter: str,
    options: FitOptions,
) -> list[FittedObject]:
    """The objects with maps of L_d, S and base colour that are free of their specular light."""
    lobes = Lobes(
        phi=np.array([item.phi for item in objects], np.float32),
        psi=np.array([item.psi_of_channels for item in objects], np.float32),
        conducts=np.array([item.is_metal for item in objects], np.bool_),
    )
    refined = refined_light(
        run, lit, reader, maps, lobes, lightmap_filter, options.memory, options.seed
    )
    written = {
        "diffuse": TexelMap(refined.diffuse, 1.0, "W/(m^2 sr)"),
        "refined_irradiance": TexelMap(refined.irradiance, 1 / np.pi, "W/m^2"),
        "base_color": TexelMap(refined.base_color, 1.0, "1"),
    }
    writer = MapWriter(run, asset, maps.scene, maps.texels)
    with_maps = []
    for i, item in enumerate(objects):
        mean = colour(maps.texels.mean_of_object(i, refined.base_color))
        with_maps.append(replace(item, aovs=writer.write(i, written), mean_color=mean))
    view = overview(maps.scene, lit.rays, maps.frames)
    view.write(run.output("previews/base_color.png"), maps.texels, refined.base_color, exposure=1)
    return with_maps
