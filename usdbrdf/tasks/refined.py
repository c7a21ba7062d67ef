"""What the task fit does with the lobes that it found: records, and maps that are free of their
light."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from usdbrdf.asset.layers.interface import write_interface
from usdbrdf.asset.layers.task_layers import write_refined_layer
from usdbrdf.asset.maps import AssetMaps, MapWriter, TexelMap, overview
from usdbrdf.asset.preview_lobe import BECKMANN_FACETS, MICROFACET
from usdbrdf.asset.properties import FittedObject, MeasuredObject, colour
from usdbrdf.files.frames import FrameReader
from usdbrdf.job.task import TaskRun
from usdbrdf.material.fit_objects import ObjectFit, judged
from usdbrdf.material.refine import refined_light
from usdbrdf.material.refined_irradiance import Lobes
from usdbrdf.material.refined_means import Lighting
from usdbrdf.options import FitOptions
from usdbrdf.tasks.task import Task
from usdbrdf.transport.lit_scene import LitScene


def fitted_objects(
    maps: Sequence[AssetMaps],
    found: Sequence[ObjectFit],
    options: FitOptions,
    wanted: Mapping[int, str],
    *,
    said: Mapping[int, str],
    microfacet: bool,
) -> list[FittedObject]:
    """What is published of each object's fit; ``wanted``: what some were taken for beforehand, by
    number; ``said``: that of a person."""
    mapping = MICROFACET if microfacet and options.mapping == "matched" else options.mapping
    objects = []
    for i, (obj, own) in enumerate(zip(maps[0].scene.objects, found, strict=True)):
        observed = any(some.is_observed(i) for some in maps)
        judgement = judged(own, obj, options, observed, wanted.get(i, ""))
        # A metal's numbers are of the facets of renderers.
        lobe = BECKMANN_FACETS if own.beckmann and judgement.model != "conductor" else MICROFACET
        objects.append(
            FittedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                # What the rays' noise brings is taken off, and may be more than there was.
                cost=0.0 if own.cost < 0 else own.cost,
                evidence=own.evidence,
                target_frame=own.target if math.isfinite(own.phi) else -1,
                num_pixels=own.num_samples,
                method=options.method,
                mapping=mapping,
                lobe=lobe if microfacet else "paper",
                directive=said.get(i, ""),
                **vars(judgement),
            )
        )
    return objects


def refined_objects(
    run: TaskRun,
    task: Task,
    maps: Sequence[AssetMaps],
    lit: Sequence[LitScene],
    reader: FrameReader,
    objects: list[FittedObject],
    options: FitOptions,
) -> list[FittedObject]:
    """The objects with maps of L_d, S and base colour that are free of their specular light; of
    several lightings those of the base colour alone, the others in a layer of each."""
    lobes = Lobes(
        phi=np.array([item.phi for item in objects], np.float32),
        psi=np.array([item.psi_of_channels for item in objects], np.float32),
        conducts=np.array([item.is_metal for item in objects], np.bool_),
    )
    beckmann = np.array([item.lobe == BECKMANN_FACETS for item in objects], np.bool_)
    lightings = [
        Lighting(own.lighting, replace(scene, beckmann=beckmann), own, own.own_frames)
        for scene, own in zip(lit, maps, strict=True)
    ]
    refined = refined_light(
        run, lightings, reader, lobes, task.parameters["denoise"], options.memory, options.seed
    )
    scene, texels = maps[0].scene, maps[0].texels
    base_color = refined[0].base_color
    shared = {"base_color": TexelMap(base_color, 1.0, "1")}
    own_maps = [
        {
            "diffuse": TexelMap(found.diffuse, 1.0, "W/(m^2 sr)"),
            "refined_irradiance": TexelMap(found.irradiance, 1 / np.pi, "W/m^2"),
        }
        for found in refined
    ]
    if len(maps) == 1:
        shared = own_maps.pop() | shared
    writer, with_maps = MapWriter(run, task.asset, scene, texels), []
    for i, item in enumerate(objects):
        mean = colour(texels.mean_of_object(i, base_color))
        with_maps.append(replace(item, aovs=writer.write(i, shared), mean_color=mean))
    for own, made in zip(maps, own_maps, strict=False):
        one = replace(task.asset, lighting=own.lighting)
        writer = MapWriter(run, one, scene, texels)
        in_light = [
            MeasuredObject(
                prim_path=item.prim_path, identifier=item.identifier, aovs=writer.write(i, made)
            )
            for i, item in enumerate(objects)
        ]
        layer = run.output(f"layers/{one.layer('material').name}")
        write_refined_layer(layer, replace(task.draft, asset=one), in_light, with_maps)
        write_interface(run.output(f"layers/{one.interface('material').name}"), layer)
    view = overview(scene, lit[0].rays, maps[0].all_frames)
    view.write(run.output(task.asset.preview("base_color")), texels, base_color, exposure=1)
    return with_maps
