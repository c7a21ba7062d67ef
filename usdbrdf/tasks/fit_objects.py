"""Inside step 4: one pass over the frames for all objects, then a lobe for each of them."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from usdbrdf.errors import UsageError
from usdbrdf.files.frames import read_frame
from usdbrdf.job.progress import progress
from usdbrdf.job.task import StageRun
from usdbrdf.material.fit_target import Residual, fit_target_frame
from usdbrdf.material.fit_views import MIXTURE, fit_views
from usdbrdf.material.observations import Follower, Observations
from usdbrdf.material.target_frames import FrameCounts, choose_target_frames, count_frame
from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import Texels
from usdbrdf.tasks.atlas import Atlas
from usdbrdf.tasks.texture import MEASURED, check_memory
from usdbrdf.transport.lit_scene import LitScene, View
from usdbrdf.transport.lobe_radiance import Mixture

# Objects that are fitted together: while rays of one are traced on all cores, another is at its
# algebra, which takes one.
_AT_A_TIME = 2

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
    phi and psi; materialx: whether MaterialX is told too; memory in GiB (None: three quarters of
    the machine's), on which no result depends."""

    method: Method = "views"
    max_pixels: int = 1500
    mapping: Mapping = "matched"
    materialx: bool = False
    environment: Path | None = None
    memory: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_pixels < 50:
            raise UsageError("--max-pixels: at least 50 are needed. [usage.option]")
        check_memory(self.memory)


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What one pass over the frames gathers: per object the target frame, which shows its highlight
    best (-1: none), and, as the method needs, the observations of followed texels, and by how many
    pixels the pictures were smoothed (NaN: they do not tell)."""

    target: Int
    observations: Observations
    smoothing: float


def survey_frames(
    run: StageRun, atlas: Atlas, lit: LitScene, frames: Frames, options: FitOptions
) -> Survey:
    """Gather all that the fits need of the frames, which are read once."""

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
        smoothing = np.array(follower.smoothing)
        return {"target": target, "smoothing": smoothing, **chosen.arrays()}

    found = run.checkpoint("survey", gather)
    target, smoothing = found.pop("target"), float(found.pop("smoothing"))
    return Survey(target=target, smoothing=smoothing, observations=Observations(**found))


def _view(frames: Frames, i: int, radiance: Float, valid: Bool) -> View:
    return View(radiance=radiance, valid=valid, camera=frames.camera(i))


def _count(lit: LitScene, frames: Frames, i: int, valid: Bool) -> FrameCounts:
    stride = max(1, round(math.sqrt(valid.size / _COUNTED_PIXELS)))
    return count_frame(
        lit.rays, lit.scene, lit.emission, valid, frames.camera(i), lit.diagonal_m, stride
    )


def fitted_objects(
    run: StageRun,
    lit: LitScene,
    texels: Texels,
    frames: Frames,
    survey: Survey,
    options: FitOptions,
) -> list[dict[str, npt.NDArray[Any]]]:
    """What ``fit_object`` says of every object, going on where an interrupted run was."""
    numbers = range(len(lit.scene.objects))
    stored = {i: run.checkpoint_if(f"object-{i}") for i in numbers}
    done = {i: found for i, found in stored.items() if found is not None}
    with (
        # With all cores for each object's small matrices BLAS's threads only wait for each other.
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(max_workers=min(_AT_A_TIME, os.cpu_count() or 1)) as pool,
    ):
        jobs = {
            pool.submit(fit_object, lit, texels, frames, survey, i, options): i
            for i in numbers
            if i not in done
        }
        try:
            for job in progress(as_completed(jobs), total=len(jobs), label="fit", unit="objects"):
                i, found = jobs[job], job.result()
                run.save(f"object-{i}", found)
                done[i] = found
        finally:
            for job in jobs:
                job.cancel()
    return [done[i] for i in numbers]


def fit_object(
    lit: LitScene,
    texels: Texels,
    frames: Frames,
    survey: Survey,
    index: int,
    options: FitOptions,
    mixture: Mixture = MIXTURE,
) -> dict[str, npt.NDArray[Any]]:
    """phi, psi, their errors, share unresolved, cost and evidence (NaN where the object could not
    be fitted), the number of samples, and the target frame (-1: none). mixture: see fit_views."""
    numbers, used, target = np.full(7, np.nan), 0, int(survey.target[index])
    if options.method == "views":
        own = survey.observations.of_texels(texels.of_object(index))
        lobe, used = fit_views(
            lit, texels, own, survey.smoothing, frames.camera, index, options.seed, mixture
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
