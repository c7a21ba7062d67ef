"""Step 4: roughness and specular per object, written as material.usda."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.asset.layers.material_layer import write_material_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.frames import frames_from_stage
from usdbrdf.job.progress import say
from usdbrdf.job.task import StageResult, StageRun
from usdbrdf.material.verdict import NEUTRAL, class_prior, verdict_on_frame, verdict_on_views
from usdbrdf.model.capture import Frames
from usdbrdf.tasks.atlas import Atlas, MapWriter, atlas_from_stage
from usdbrdf.tasks.fit_objects import FitOptions, fitted_objects, survey_frames
from usdbrdf.tasks.lit import lit_scene
from usdbrdf.tasks.preview import overview
from usdbrdf.tasks.refine import refined_maps
from usdbrdf.tasks.refined_irradiance import Lobes, filter_of
from usdbrdf.tasks.step import Step, hash_of_files, hash_of_maps, weaker_layers
from usdbrdf.tasks.surroundings import environment_from_file, environment_hash
from usdbrdf.tasks.texture import FILLED
from usdbrdf.transport.denoise import NONE
from usdbrdf.transport.lit_scene import LitScene


def fit(asset: Asset, options: FitOptions) -> StageResult:
    """Choose target frames, fit every object, write material.usda."""
    layers = weaker_layers(asset, "material")
    stage = open_weaker(asset, "material")
    frames = frames_from_stage(stage)
    lightmap_filter = filter_of(asset) if options.method == "views" else NONE
    step = Step(
        asset=asset,
        name="fit",
        role="material",
        parameters={
            **{k: v for k, v in asdict(options).items() if k not in ("environment", "memory")},
            "denoise": lightmap_filter,
        },
        inputs={
            **layers,
            **environment_hash(options.environment),
            "maps": hash_of_maps(
                asset, "lit", "coverage", "irradiance", "irradiance_raw", "emission"
            ),
            "frames": hash_of_files(frames.image_paths),
        },
    )

    def work(run: StageRun) -> dict[str, Any]:
        atlas = atlas_from_stage(stage)
        environment = environment_from_file(options.environment, step.header.up_axis)
        lit = lit_scene(atlas, environment)
        survey = survey_frames(run, atlas, lit, frames, options)
        seen = atlas.map("coverage")[:, 0] != FILLED
        objects = [
            _record(lit, i, found, options, bool(seen[atlas.texels.of_object(i)].any()))
            for i, found in enumerate(
                fitted_objects(run, lit, atlas.texels, frames, survey, options)
            )
        ]
        measured = sum(item.status == "measured" for item in objects)
        say(f"fit: {measured} of {len(objects)} objects measured, the others by their class")
        if options.method == "views":
            objects = _refined(run, asset, atlas, lit, frames, objects, lightmap_filter, options)
        materialx = f"layers/{asset.materialx_layer.name}"
        write_material_layer(
            run.output(f"layers/{asset.layer('material').name}"),
            step.draft,
            objects,
            materialx=run.output(materialx) if options.materialx else None,
        )
        return {"objects": {item.identifier: _said(item) for item in objects}}

    return step.run(work)


def _refined(
    run: StageRun,
    asset: Asset,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    objects: list[FittedObject],
    lightmap_filter: str,
    options: FitOptions,
) -> list[FittedObject]:
    """The objects with maps of L_d, S and base colour that are free of their specular light."""
    lobes = Lobes(
        phi=np.array([item.phi for item in objects], np.float32),
        psi=np.array([item.psi for item in objects], np.float32),
    )
    maps = refined_maps(
        run, atlas, lit, frames, lobes, lightmap_filter, options.memory, options.seed
    )
    writer = MapWriter(run, asset, atlas.texels)
    refined = []
    for i, (obj, item) in enumerate(zip(atlas.scene.objects, objects, strict=True)):
        own = atlas.texels.of_object(i)
        area = np.maximum(atlas.texels.area[own], 1e-12)
        r, g, b = np.average(maps["base_color"].values[own], axis=0, weights=area)
        aovs = writer.write(i, obj, maps)
        refined.append(replace(item, aovs=aovs, mean_color=(float(r), float(g), float(b))))
    view = overview(atlas.scene, lit.rays, frames)
    view.write(
        run.output("previews/base_color.png"), atlas.texels, maps["base_color"].values, exposure=1
    )
    return refined


def _said(item: FittedObject) -> dict[str, Any]:
    """What the summary says of an object."""
    return {
        "phi": round(item.phi, 4),
        "psi": round(item.psi, 4),
        "phi_error": round(item.phi_error, 4) if math.isfinite(item.phi_error) else None,
        "psi_error": round(item.psi_error, 4) if math.isfinite(item.psi_error) else None,
        "phi_confidence": item.phi_confidence,
        "psi_confidence": item.psi_confidence,
        "status": item.status,
        "evidence": round(item.evidence, 4) if math.isfinite(item.evidence) else 0.0,
        "target_frame": item.target_frame,
    }


def _record(
    lit: LitScene,
    index: int,
    found: dict[str, npt.NDArray[Any]],
    options: FitOptions,
    seen: bool,
) -> FittedObject:
    obj = lit.scene.objects[index]
    # Digits beyond these depend on how many threads the linear algebra had.
    numbers = (round(float(number), 4) for number in found["numbers"])
    phi, psi, phi_error, psi_error, unresolved, cost, evidence = numbers
    prior = class_prior(obj.class_name, obj.label) if seen else NEUTRAL
    if options.method == "views":
        verdict = verdict_on_views(
            (phi, phi_error), (psi, psi_error), unresolved, evidence, prior, seen
        )
    else:
        keep = options.method == "paper"
        verdict = verdict_on_frame((phi, phi_error), psi, evidence, prior, seen, keep)
    return FittedObject(
        prim_path=obj.prim_path,
        identifier=obj.identifier,
        cost=cost,
        evidence=evidence,
        target_frame=int(found["target"]) if math.isfinite(phi) else -1,
        num_pixels=int(found["used"]),
        method=options.method,
        mapping=options.mapping,
        **vars(verdict),
    )
