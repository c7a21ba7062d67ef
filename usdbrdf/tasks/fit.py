"""Task 4: roughness and specular per object; with these, L_d and albedo without specular light."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from usdbrdf.asset.directives import by_number, directives_of
from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.interface import write_interface
from usdbrdf.asset.layers.task_layers import write_material_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.errors import UsageError
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.job.units import HERE, Workers
from usdbrdf.material.fit_objects import Lighting, fitted_by_likelier_lobe, survey_frames
from usdbrdf.material.refine import frame_reader
from usdbrdf.model.mesh import GLASS, LEFT_OUT, OF_FIT
from usdbrdf.options import FitOptions, kind_of_light
from usdbrdf.tasks.refined import fitted_objects, refined_objects
from usdbrdf.tasks.task import Task, warned
from usdbrdf.transport.brdf import PAPER
from usdbrdf.transport.denoise import AUTO, NONE, OIDN, chosen_filter

# The maps that the fit reads; and which lightings are weighed by.
_READ = (
    "lit", "samples", "coverage", "irradiance", "irradiance_raw", "emission", "hidden", "sky",
)  # fmt: skip
_WEIGHED = ("stderr",)


def refuse_one_frame(options: FitOptions) -> None:
    """UsageError for the methods that take one frame, of which several lightings have each one."""
    if options.method != "views":
        raise UsageError(
            f"--fit {options.method}: takes one frame of one lighting, and these are several. "
            "Leave it out. [usage.option]"
        )


def fit(asset: Asset, options: FitOptions, workers: Workers = HERE) -> TaskResult:
    """Choose target frames, fit every object, write material.usda and, of views, refined maps; of
    several lightings one material of all, and the maps of each."""
    maps = [AssetMaps(open_weaker(one, "material")) for one in asset.in_each_lighting]
    if len(maps) > 1:
        refuse_one_frame(options)
    # S is refined as it was filtered, if the filter is here too.
    told = [read_provenance(one.layer("shading")) for one in asset.in_each_lighting]
    filters = [provenance.get("parameters", {}).get("denoise") for provenance in told]
    filtered = options.method == "views" and all(name == OIDN for name in filters)
    lightmap_filter = chosen_filter(AUTO) if filtered else NONE
    chosen = {k: v for k, v in asdict(options).items() if k != "memory"}
    chosen["environment"] = kind_of_light(options.environment)
    asked = directives_of(asset, maps[0].stage, OF_FIT)
    if asked:
        chosen["directives"] = asked
    doubts = [own.doubts_of_light for own in maps]
    if any(doubts):
        chosen["doubts_of_light"] = doubts
    inputs: dict[str, str] = {}
    read = (*_READ, *_WEIGHED) if len(maps) > 1 else _READ
    for own in maps:
        inputs |= hashes_of_inputs(
            replace(asset, lighting=own.lighting), "material", own,
            aovs=read, photographs=True, environment=options.environment,
        )  # fmt: skip
    task = Task(
        asset=asset,
        name="fit",
        role="material",
        parameters={**chosen, "denoise": lightmap_filter},
        inputs=inputs,
    )

    def work(run: TaskRun) -> dict[str, Any]:
        words = by_number(asked, maps[0].scene.objects)
        # Through which the outside shows is clear glass, unless a person says otherwise.
        wanted = dict.fromkeys((i for own in maps for i in own.surface.panes), GLASS) | words
        left_out = [i for i, word in wanted.items() if word in LEFT_OUT]
        fitted = ~np.isin(maps[0].texels.object_index(), left_out)
        lit = [own.lit_scene(own.environment(options.environment)) for own in maps]
        reader = frame_reader(lit, maps[0].all_frames, options.memory)
        lightings = [
            Lighting(
                scene,
                survey_frames(
                    run.part(own.lighting),
                    scene,
                    own.coverage.measured & ~own.emissive & fitted,
                    reader,
                    options,
                    own.own_frames,
                ),
                own.irradiance,
                own.light_in_doubt(options.environment) if options.method == "views" else None,
            )
            for own, scene in zip(maps, lit, strict=True)
        ]
        lobe, found = fitted_by_likelier_lobe(run, lightings, reader, options, wanted)
        objects = fitted_objects(maps, found, options, wanted, said=words, microfacet=lobe != PAPER)
        measured = sum(item.status == "measured" for item in objects)
        say(f"fit: {measured} of {len(objects)} objects measured")
        if options.method == "views":
            lit = [replace(scene, lobe=lobe) for scene in lit]
            objects = refined_objects(run, task, maps, lit, reader, objects, options)
        layer = run.output(f"layers/{asset.layer('material').name}")
        networks = run.output(f"layers/{asset.materialx_layer.name}") if options.materialx else None
        write_material_layer(layer, task.draft, objects, materialx=networks)
        write_interface(run.output(f"layers/{asset.interface('material').name}"), layer)
        return {
            "objects": {item.identifier: item.summary for item in objects},
            "warnings": warned(doubt for item in objects for doubt in item.doubts),
        }

    return task.run(work, workers)
