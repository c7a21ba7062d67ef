"""Step 4: roughness and specular per object, written as material.usda."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import UsageError
from usdbrdf.geometry.texels import Texels
from usdbrdf.job.progress import progress, say
from usdbrdf.job.stage import StageResult, StageRun
from usdbrdf.material.fit_target import Residual, fit_target_frame
from usdbrdf.material.fit_views import fit_views
from usdbrdf.material.lit_scene import LitScene, View
from usdbrdf.material.observations import Follower, Observations
from usdbrdf.material.prior import NEUTRAL, class_prior
from usdbrdf.material.target_frames import FrameCounts, choose_target_frames, count_frame
from usdbrdf.material.verdict import verdict_on_frame, verdict_on_views
from usdbrdf.scan.frame_reading import read_frame
from usdbrdf.scan.scan import Frames
from usdbrdf.shading.denoise import NONE
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.material_layer import write_material_layer
from usdbrdf.stage.read import frames_from_stage, open_weaker
from usdbrdf.stage.records import FittedObject
from usdbrdf.steps.atlas import Atlas, MapWriter, atlas_from_stage
from usdbrdf.steps.lit import lit_scene
from usdbrdf.steps.preview import overview
from usdbrdf.steps.refine import refined_maps
from usdbrdf.steps.refined_irradiance import Lobes, filter_of
from usdbrdf.steps.step import Step, hash_of_files, hash_of_maps, weaker_layers
from usdbrdf.steps.surroundings import environment_from_file, environment_hash
from usdbrdf.steps.texture import FILLED, MEASURED

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# A1 and A2 are counted on about this many pixels per frame.
_COUNTED_PIXELS = 80_000

Method = Literal["views", "scaled", "paper"]
Mapping = Literal["measured", "matched"]


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """method "views": many views of the same texels, L_d free per texel, and L_d refined with what
    was found; "scaled": the target frame alone, L_d times a free factor per channel; "paper": the
    target frame, the paper's residual, its minimum always kept. max_pixels: of the target frame.
    Without evidence the first two write the class prior. mapping: what UsdPreviewSurface is told of
    phi and psi; materialx: whether MaterialX is told too."""

    method: Method = "views"
    max_pixels: int = 1500
    mapping: Mapping = "matched"
    materialx: bool = False
    environment: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_pixels < 50:
            raise UsageError("--max-pixels: at least 50 are needed. [usage.option]")


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
            **{key: value for key, value in asdict(options).items() if key != "environment"},
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
        survey = _survey(run, atlas, lit, frames, options)
        seen = atlas.map("coverage")[:, 0] != FILLED
        objects = []
        numbers = range(len(lit.scene.objects))
        for i in progress(numbers, total=len(numbers), label="fit", unit="objects"):
            own = atlas.texels.of_object(i)
            found = run.checkpoint(
                f"object-{i}", partial(_fit_arrays, lit, atlas.texels, frames, survey, i, options)
            )
            objects.append(_record(lit, i, found, options, bool(seen[own].any())))
        measured = sum(item.status == "measured" for item in objects)
        say(f"fit: {measured} of {len(objects)} objects measured, the others by their class")
        if options.method == "views":
            objects = _refined(
                run, asset, atlas, lit, frames, objects, lightmap_filter, options.seed
            )
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
    seed: int,
) -> list[FittedObject]:
    """The objects with maps of L_d, S and base colour that are free of their specular light."""
    lobes = Lobes(
        phi=np.array([item.phi for item in objects], np.float32),
        psi=np.array([item.psi for item in objects], np.float32),
    )
    maps = refined_maps(run, atlas, lit, frames, lobes, lightmap_filter, seed)
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


@dataclass(frozen=True, kw_only=True)
class _Survey:
    """What one pass over the frames gathers: per object the target frame, which shows its highlight
    best (-1: none), and, as the method needs, the observations of followed texels."""

    target: Int
    observations: Observations


def _survey(
    run: StageRun, atlas: Atlas, lit: LitScene, frames: Frames, options: FitOptions
) -> _Survey:
    def gather() -> dict[str, npt.NDArray[Any]]:
        measured = (atlas.map("coverage")[:, 0] == MEASURED) & atlas.texels.interior
        usable = measured & ~(atlas.map_where_present("emission", 3) > 0).any(axis=1)
        by_views = options.method == "views"
        follower = Follower(lit, atlas.texels, usable & by_views, len(frames), options.seed)
        counts = []
        numbers = range(len(frames))
        for i in progress(numbers, total=len(frames), label="fit: survey", unit="frames"):
            pixels = read_frame(frames, i)
            if by_views:
                view = _view(frames, i, np.nan_to_num(pixels.radiance), pixels.valid)
                follower.add(view, pixels.clipped, float(frames.noise_floor_radiance[i]))
            else:
                counts.append(_count(lit, frames, i, pixels.valid))
        target = (
            follower.target_frames(atlas.texels) if by_views else choose_target_frames(counts)[0]
        )
        chosen = follower.chosen(atlas.texels, options.seed)
        return {"target": target, **chosen.arrays()}

    found = run.checkpoint("survey", gather)
    return _Survey(target=found.pop("target"), observations=Observations(**found))


def _view(frames: Frames, i: int, radiance: Float, valid: Bool) -> View:
    return View(
        radiance=radiance,
        valid=valid,
        world_from_camera=frames.world_from_camera[i],
        intrinsics=frames.intrinsics[i],
    )


def _count(lit: LitScene, frames: Frames, i: int, valid: Bool) -> FrameCounts:
    stride = max(1, round(math.sqrt(valid.size / _COUNTED_PIXELS)))
    return count_frame(
        lit.rays, lit.scene, lit.emission, valid, frames.world_from_camera[i],
        frames.intrinsics[i], lit.size, stride,
    )  # fmt: skip


def _fit_arrays(
    lit: LitScene,
    texels: Texels,
    frames: Frames,
    survey: _Survey,
    index: int,
    options: FitOptions,
) -> dict[str, npt.NDArray[Any]]:
    """phi, psi, their errors, share unresolved, cost and evidence (NaN where the object could not
    be fitted), the number of samples, and the target frame (-1: none)."""
    numbers, used, target = np.full(7, np.nan), 0, int(survey.target[index])
    if options.method == "views":
        own = survey.observations.of_texels(texels.of_object(index))
        nothing = np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.bool_)
        lobe, used = fit_views(
            lit, texels, own, lambda frame: _view(frames, frame, *nothing), index, options.seed
        )
        if lobe is not None:
            numbers[:] = (
                lobe.phi, lobe.psi, lobe.phi_error, lobe.psi_error, lobe.unresolved, lobe.cost,
                lobe.evidence,
            )  # fmt: skip
    elif target >= 0 and not _is_lamp(lit, index):
        pixels = read_frame(frames, target)
        view = _view(frames, target, np.nan_to_num(pixels.radiance), pixels.valid)
        residual: Residual = "paper" if options.method == "paper" else "scaled"
        found, used = fit_target_frame(lit, view, index, residual, options.max_pixels, options.seed)
        if found is not None:
            # As if all roughnesses that fit were equally likely; of psi the frame alone tells none.
            error = (found.phi_high - found.phi_low) / math.sqrt(12)
            numbers[:] = found.phi, found.psi, error, np.nan, 0, found.cost, found.evidence
    return {"numbers": numbers, "used": np.array(used), "target": np.array(target)}


def _is_lamp(lit: LitScene, index: int) -> bool:
    """Does every point of the object shine?"""
    faces = np.arange(*lit.scene.objects[index].faces.indices(len(lit.scene.triangles)))
    third = np.full(len(faces), 1 / 3, np.float32)
    return bool((lit.emission.at(faces.astype(np.int32), third, third)[:, 0] > 0.5).all())


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
