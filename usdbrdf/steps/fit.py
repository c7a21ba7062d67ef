"""Step 4: roughness and specular per object, written as material.usda."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.job.progress import say
from usdbrdf.job.stage import StageResult, StageRun
from usdbrdf.material.lit_scene import LitScene
from usdbrdf.material.prior import NEUTRAL, class_prior
from usdbrdf.material.verdict import verdict_on_frame, verdict_on_views
from usdbrdf.scan.scan import Frames
from usdbrdf.shading.denoise import NONE
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.material_layer import write_material_layer
from usdbrdf.stage.read import frames_from_stage, open_weaker
from usdbrdf.stage.records import FittedObject
from usdbrdf.steps.atlas import Atlas, MapWriter, atlas_from_stage
from usdbrdf.steps.fit_objects import FitOptions, fitted_objects, survey_frames
from usdbrdf.steps.lit import lit_scene
from usdbrdf.steps.preview import overview
from usdbrdf.steps.refine import refined_maps
from usdbrdf.steps.refined_irradiance import Lobes, filter_of
from usdbrdf.steps.step import Step, hash_of_files, hash_of_maps, weaker_layers
from usdbrdf.steps.surroundings import environment_from_file, environment_hash
from usdbrdf.steps.texture import FILLED


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
            asset,
            step.header,
            step.provenance,
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
