"""Step 2: frames become the lit diffuse texture L_d and its companions, one atlas per object."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Usd

from usdbrdf.asset.layers.texturing_layer import write_texturing_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import Aov, TexturedObject
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.frames import frames_from_stage
from usdbrdf.asset.readers.scene import given_corner_uv, scene_from_stage
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.geometry.unwrap import atlas_side, unwrap
from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import StageResult, StageRun
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.tasks.atlas import MapWriter, TexelMap
from usdbrdf.tasks.in_passes import in_passes
from usdbrdf.tasks.preview import overview
from usdbrdf.tasks.step import Step, hash_of_files, weaker_layers
from usdbrdf.texturing.inpaint import inpaint_alike
from usdbrdf.texturing.observe import Observation, radiance_from_frames
from usdbrdf.texturing.passes import Measured, groups_of_texels, measured_arrays
from usdbrdf.texturing.texel_size import texel_size_from_frames
from usdbrdf.transport.rays import RayScene

# In the coverage map.
MEASURED, CLIPPED, FILLED = 1.0, 0.5, 0.0

# A larger share of unmeasured texels is worth a warning.
_MOSTLY = 0.9


@dataclass(frozen=True, kw_only=True)
class TextureOptions:
    """texel_size in metres (None: the frames' own median pixel footprint); quantile of the
    observations that becomes L_d; max_texels: a chosen texel size is coarsened to stay below;
    memory in GiB (None: three quarters of the machine's), on which no result depends."""

    texel_size: float | None = None
    quantile: float = 0.5
    max_texels: int = 1_000_000
    memory: float | None = None

    def __post_init__(self) -> None:
        if self.texel_size is not None and not self.texel_size > 0:
            raise UsageError(
                f"--texel-size {self.texel_size}: not a positive length. [usage.option]"
            )
        if self.max_texels < 1:
            raise UsageError(
                f"--max-texels {self.max_texels}: at least 1 is needed. [usage.option]"
            )
        check_memory(self.memory)
        if not 0 < self.quantile < 1:
            raise UsageError(f"--quantile {self.quantile}: not between 0 and 1. [usage.option]")


def check_memory(memory: float | None) -> None:
    """Raises UsageError where ``memory``, in GiB, is given and none."""
    if memory is not None and not memory > 0:
        raise UsageError(f"--memory {memory}: not above 0. [usage.option]")


def texture(asset: Asset, options: TextureOptions) -> StageResult:
    """Unwrap every object, project the frames, write texturing.usda and its EXR maps."""
    layers = weaker_layers(asset, "texturing")
    stage = open_weaker(asset, "texturing")
    frames = frames_from_stage(stage)
    step = Step(
        asset=asset,
        name="texture",
        role="texturing",
        parameters={k: v for k, v in asdict(options).items() if k != "memory"},
        inputs={**layers, "frames": hash_of_files(frames.image_paths)},
    )

    def work(run: StageRun) -> dict[str, Any]:
        scene = scene_from_stage(stage)
        rays = RayScene(scene.points, scene.triangles)
        size = options.texel_size or texel_size_from_frames(scene, rays, frames, options.max_texels)
        charts = run.checkpoint("charts", lambda: _charts(stage, scene, size))
        scene = replace(scene, corner_uv=charts["corner_uv"])
        texels = texels_from_atlas(scene, charts["resolution"])
        say(f"texture: {len(texels):,} texels of {1000 * size:.3g} mm, {len(frames)} frames")
        found = _found(texels, _measure(run, texels, scene, rays, frames, options))
        summary = _write(run, step, scene, texels, found, size, options.quantile)
        view = overview(scene, rays, frames)
        view.write(run.output("previews/lit.png"), texels, found.maps["lit"].values)
        return summary

    return step.run(work)


def _charts(stage: Usd.Stage, scene: Scene, texel_size: float) -> dict[str, npt.NDArray[Any]]:
    """New charts, but for objects that came with coordinates which are fit for it."""
    corner_uv, resolution = unwrap(scene, texel_size)
    for i, obj in enumerate(scene.objects):
        given = given_corner_uv(stage, obj.prim_path)
        corners = scene.points[scene.triangles[obj.faces]]
        side = None if given is None else atlas_side(given, corners, texel_size)
        if given is not None and side is not None:
            corner_uv[obj.faces], resolution[i] = given, side
            say(f"texture: {obj.identifier} keeps the texture coordinates that it came with")
    return {"corner_uv": corner_uv, "resolution": resolution}


def _measure(
    run: StageRun,
    texels: Texels,
    scene: Scene,
    rays: RayScene,
    frames: Frames,
    options: TextureOptions,
) -> Measured:
    """All frames, in as many passes as memory asks for."""
    groups = groups_of_texels(texels, scene, frames, options.memory)

    def measured(part: slice) -> dict[str, npt.NDArray[Any]]:
        observed = _observe(run, texels, scene, rays, frames, options.quantile, part)
        return measured_arrays(observed, options.quantile)

    return Measured(**in_passes(run, "texels", groups, len(texels), measured))


def _observe(
    run: StageRun,
    texels: Texels,
    scene: Scene,
    rays: RayScene,
    frames: Frames,
    quantile: float,
    part: slice,
) -> Observation:
    """Some texels in all frames, going on from the last saved state of an interrupted run."""
    name = f"frames-{part.start}-{part.stop}"
    saved = run.latest(name)
    start, observed = 0, Observation.empty(part.stop - part.start)
    if saved is not None:
        start, observed = saved[0] + 1, Observation.from_arrays(saved[1])
    steps = radiance_from_frames(texels, scene, rays, frames, observed, quantile, start, part=part)
    for done in progress(steps, total=len(frames) - start, label="texture", unit="frames"):
        run.save_latest_in_time(name, done, observed.arrays)
    return observed


@dataclass(frozen=True, kw_only=True)
class _Found:
    """measured, clipped (T,) bool: a photograph measured the texel; all that see it clipped."""

    measured: Bool
    clipped: Bool
    maps: dict[str, TexelMap]


def _found(texels: Texels, seen: Measured) -> _Found:
    """The maps of all objects; refuses a capture that shows nothing of the mesh."""
    measured = seen.count > 0
    clipped = ~measured & (seen.clipped > 0)
    _check_seen(measured, clipped)
    lit, mean = _filled_in(texels, seen, measured, clipped)
    coverage = np.select([measured, clipped], [MEASURED, CLIPPED], FILLED).astype(np.float32)
    maps = {
        "lit": TexelMap(lit, 1.0, "W/(m^2 sr)", exact=True),
        "mean": TexelMap(mean, 1.0, "W/(m^2 sr)"),
        "spread": TexelMap(np.nan_to_num(seen.spread), 1.0, "W/(m^2 sr)"),
        "samples": TexelMap(seen.count.astype(np.float32), 1 / 32, "1"),
        "coverage": TexelMap(coverage, 1.0, "1"),
    }
    return _Found(measured=measured, clipped=clipped, maps=maps)


def _check_seen(measured: Bool, clipped: Bool) -> None:
    if not (measured | clipped).any():
        raise InputRefused(
            "no frame sees any surface from its front: the faces are wound away from the cameras, "
            "or the poses are wrong. Turn the mesh's faces or correct the poses. "
            "[texturing.unseen]"
        )
    unmeasured = 1 - float(measured.mean())
    if unmeasured > _MOSTLY:
        say(
            f"warning: {100 * unmeasured:.1f} % of the texels were measured by no frame and are "
            "filled in. Check the winding of the faces, the poses and the exposures. "
            "[texturing.unseen]"
        )


def _write(
    run: StageRun,
    step: Step,
    scene: Scene,
    texels: Texels,
    found: _Found,
    texel_size: float,
    quantile: float,
) -> dict[str, Any]:
    """Maps, layers and summary."""
    writer = MapWriter(run, step.asset, texels)
    numbered = list(enumerate(scene.objects))
    objects = []
    for i, obj in progress(numbered, total=len(numbered), label="texture: writing", unit="objects"):
        aovs = writer.write(i, obj, found.maps)
        objects.append(_record(scene, texels, found, i, aovs, texel_size, quantile))
    writer.warn()
    write_texturing_layer(
        run.output(f"layers/{step.asset.layer('texturing').name}"),
        run.output(f"layers/{step.asset.uv_layer.name}"),
        step.draft,
        objects,
    )
    return {
        "texel_size": texel_size,
        "texels": len(texels),
        "measured_fraction": float(found.measured.mean()),
        "clipped_fraction": float(found.clipped.mean()),
        "unseen_objects": [item.identifier for item in objects if not item.seen],
    }


def _record(
    scene: Scene,
    texels: Texels,
    found: _Found,
    i: int,
    aovs: tuple[Aov, ...],
    texel_size: float,
    quantile: float,
) -> TexturedObject:
    assert scene.corner_uv is not None
    obj, own = scene.objects[i], texels.of_object(i)
    return TexturedObject(
        prim_path=obj.prim_path,
        identifier=obj.identifier,
        corner_uv=scene.corner_uv[obj.faces],
        aovs=aovs,
        texel_size=texel_size,
        seen_fraction=float(found.measured[own].mean()),
        clipped_fraction=float(found.clipped[own].mean()),
        resolution=(int(texels.resolution[i, 0]), int(texels.resolution[i, 1])),
        seen=bool((found.measured | found.clipped)[own].any()),
        quantile=quantile,
    )


def _filled_in(
    texels: Texels, seen: Measured, measured: Bool, clipped: Bool
) -> tuple[Float, Float]:
    """L_d and the mean everywhere: measured, or inpainted from what was measured on the same
    object, but where every frame clipped at least what saturates them. An object that only ever
    clipped is known by those bounds alone."""
    owner = texels.object_index()
    has_measured = np.bincount(owner, measured, len(texels.resolution)) > 0
    bounded = clipped & ~has_measured[owner]
    least = seen.lower_bound[:, None]
    lit, mean = inpaint_alike(
        texels,
        [np.where(bounded[:, None], least, values) for values in (seen.median, seen.mean)],
        measured | bounded,
    )
    return np.where(clipped[:, None], np.maximum(lit, least), lit), mean
