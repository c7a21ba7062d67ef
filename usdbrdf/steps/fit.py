"""Step 4: roughness and specular per object from its target frame, written as material.usda."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import UsageError
from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.surface_radiance import surface_texture
from usdbrdf.job.progress import progress
from usdbrdf.job.stage import StageResult, StageRun
from usdbrdf.material.fit_object import LitScene, View, fit_object
from usdbrdf.material.prior import class_prior
from usdbrdf.material.target_frames import FrameCounts, choose_target_frames, count_frame
from usdbrdf.scan.frame_reading import read_frame
from usdbrdf.scan.scan import Frames
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.lights import lights_from_radiance
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.material_layer import write_material_layer
from usdbrdf.stage.read import frames_from_stage, open_weaker
from usdbrdf.stage.records import FittedObject
from usdbrdf.steps.atlas import Atlas, atlas_from_stage
from usdbrdf.steps.step import Step, hash_of_files, hash_of_maps, weaker_layers
from usdbrdf.steps.surroundings import environment_from_file, environment_hash
from usdbrdf.steps.texture import FILLED

Int = npt.NDArray[np.int32]

# Below this evidence the target frame does not tell one material from another (on captures with
# known materials no such fit could be trusted), and the class prior is written instead.
MIN_EVIDENCE = 0.1
# A1 and A2 are counted on about this many pixels per frame.
_COUNTED_PIXELS = 80_000


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """method "scaled": L_d times a free factor per channel, relative residuals, class prior where
    the evidence is missing; "paper": the paper's residual, its minimum always kept."""

    method: Literal["scaled", "paper"] = "scaled"
    max_pixels: int = 1500
    environment: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_pixels < 50:
            raise UsageError("--max-pixels: at least 50 are needed. [usage.option]")


def fit(asset: Asset, options: FitOptions) -> StageResult:
    """Choose target frames, fit every object, write material.usda."""
    stage = open_weaker(asset, "material")
    frames = frames_from_stage(stage)
    layers = weaker_layers(asset, "material")
    step = Step(
        asset=asset,
        name="fit",
        role="material",
        parameters={key: value for key, value in asdict(options).items() if key != "environment"},
        inputs={
            **layers,
            **environment_hash(options.environment),
            "maps": hash_of_maps(asset, "lit", "coverage", "emission"),
            "frames": hash_of_files(frames.image_paths),
        },
    )

    def work(run: StageRun) -> dict[str, Any]:
        atlas = atlas_from_stage(stage)
        environment = environment_from_file(options.environment, step.header.up_axis)
        lit = _lit_scene(atlas, environment)
        target, mirrored = _target_frames(run, lit, frames)
        seen = atlas.map("coverage")[:, 0] != FILLED
        objects = []
        numbers = range(len(lit.scene.objects))
        for i in progress(numbers, total=len(numbers), label="fit", unit="objects"):
            own = atlas.texels.of_object(i)
            found = run.checkpoint(
                f"object-{i}",
                lambda i=i: _fit_arrays(lit, frames, i, int(target[i]), options),  # type: ignore[misc]
            )
            objects.append(
                _record(lit, i, found["numbers"], int(target[i]), options, bool(seen[own].any()))
            )
        write_material_layer(
            run.output(f"layers/{asset.layer('material').name}"),
            asset,
            step.header,
            step.provenance,
            objects,
        )
        return {
            "objects": {
                item.identifier: {
                    "phi": round(item.phi, 4),
                    "psi": round(item.psi, 4),
                    "status": item.status,
                    "evidence": round(item.evidence, 4) if math.isfinite(item.evidence) else 0.0,
                    "target_frame": item.target_frame,
                    "highlight_pixels": int(mirrored[i]),
                }
                for i, item in enumerate(objects)
            }
        }

    return step.run(work)


def _lit_scene(atlas: Atlas, environment: Environment) -> LitScene:
    scene, texels = atlas.scene, atlas.texels
    lit = atlas.map("lit")
    emissive = (atlas.map_where_present("emission", 3) > 0).any(axis=1, keepdims=True)
    return LitScene(
        scene=scene,
        rays=RayScene(scene.points, scene.triangles),
        radiance=surface_texture(texels, scene.face_object, lit),
        lights=lights_from_radiance(scene, texels, lit),
        emission=surface_texture(
            texels, scene.face_object, np.repeat(emissive.astype(np.float32), 3, axis=1)
        ),
        environment=environment,
        size=float(np.linalg.norm(np.ptp(scene.points, axis=0))),
    )


def _target_frames(run: StageRun, lit: LitScene, frames: Frames) -> tuple[Int, Int]:
    def count() -> dict[str, npt.NDArray[Any]]:
        counts = []
        for i in progress(
            range(len(frames)), total=len(frames), label="fit: target frames", unit="frames"
        ):
            counts.append(_count(lit, frames, i))
        target, mirrored = choose_target_frames(counts)
        return {"target": target, "mirrored": mirrored}

    found = run.checkpoint("targets", count)
    return found["target"], found["mirrored"]


def _count(lit: LitScene, frames: Frames, i: int) -> FrameCounts:
    valid = read_frame(frames, i).valid
    stride = max(1, round(math.sqrt(valid.size / _COUNTED_PIXELS)))
    return count_frame(
        lit.rays, lit.scene, lit.emission, valid, frames.world_from_camera[i],
        frames.intrinsics[i], lit.size, stride,
    )  # fmt: skip


def _fit_arrays(
    lit: LitScene, frames: Frames, index: int, target: int, options: FitOptions
) -> dict[str, npt.NDArray[Any]]:
    """phi, psi, cost, evidence, pixels of one object; NaN where it could not be fitted."""
    numbers = np.full(5, np.nan)
    if target >= 0 and not _is_lamp(lit, index):
        pixels = read_frame(frames, target)
        view = View(
            radiance=np.nan_to_num(pixels.radiance),
            valid=pixels.valid,
            world_from_camera=frames.world_from_camera[target],
            intrinsics=frames.intrinsics[target],
        )
        found, used = fit_object(lit, view, index, options.method, options.max_pixels, options.seed)
        if found is not None:
            numbers[:4] = found.phi, found.psi, found.cost, found.evidence
        numbers[4] = used
    return {"numbers": numbers}


def _is_lamp(lit: LitScene, index: int) -> bool:
    """Does every point of the object shine?"""
    faces = np.arange(*lit.scene.objects[index].faces.indices(len(lit.scene.triangles)))
    third = np.full(len(faces), 1 / 3, np.float32)
    return bool((lit.emission.at(faces.astype(np.int32), third, third)[:, 0] > 0.5).all())


def _record(
    lit: LitScene,
    index: int,
    numbers: npt.NDArray[np.float64],
    target: int,
    options: FitOptions,
    seen: bool,
) -> FittedObject:
    obj = lit.scene.objects[index]
    phi, psi, cost, evidence, pixels = (float(number) for number in numbers)
    fitted = math.isfinite(phi)
    if fitted and evidence >= MIN_EVIDENCE:
        status = "measured"
    elif fitted and options.method == "paper":
        status = "failed"
    else:
        status = "prior" if seen else "unseen"
        phi, psi = class_prior(obj.class_name, obj.label)
    return FittedObject(
        prim_path=obj.prim_path,
        identifier=obj.identifier,
        phi=phi,
        psi=psi,
        cost=cost,
        evidence=evidence,
        status=status,
        target_frame=target if fitted else -1,
        num_pixels=int(pixels) if math.isfinite(pixels) else 0,
        method=options.method,
    )
