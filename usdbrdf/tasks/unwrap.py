"""How the objects' textures are laid out; where several lightings share that, a task of its own."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from usdbrdf.ahead import ahead
from usdbrdf.asset.layers.task_layers import write_uv_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import UnwrappedObject
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.asset.readers.scene import given_corner_uv, read_unwrapped
from usdbrdf.files.frames import read_frame
from usdbrdf.geometry.unwrap import TexelSizes, charts_of_scene
from usdbrdf.job.progress import progress
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.model.arrays import Array
from usdbrdf.options import TextureOptions
from usdbrdf.tasks.task import Task
from usdbrdf.texturing.passes import most_texels
from usdbrdf.texturing.texel_density import (
    at_most,
    finer_where_patterned,
    frames_for_patterns,
    points_of_patterns,
    texel_sizes_from_frames,
)
from usdbrdf.transport.rays import RayScene


def unwrap(asset: Asset, options: TextureOptions) -> TaskResult:
    """Lay out the textures that all lightings of an asset share, by the frames of all of them."""
    maps = AssetMaps(open_weaker(asset, "texturing"))
    task = Task(
        asset=asset,
        name="unwrap",
        role="texturing",
        parameters={k: v for k, v in asdict(options).items() if k not in ("memory", "quantile")},
        inputs=hashes_of_inputs(asset, "texturing", maps, photographs=True),
    )

    def work(run: TaskRun) -> dict[str, Any]:
        rays = RayScene(maps.scene.points, maps.scene.triangles)
        charts = run.checkpoint("charts", partial(new_charts, maps, rays, options))
        resolution, sides = charts["resolution"].tolist(), charts["sides"].tolist()
        objects = [
            UnwrappedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                corner_uv=charts["corner_uv"][obj.faces],
                texel_size=sides[i],
                resolution=(resolution[i][0], resolution[i][1]),
            )
            for i, obj in enumerate(maps.scene.objects)
        ]
        uv = run.output(f"layers/{asset.uv_layer.name}")
        write_uv_layer(uv, task.draft, objects, maps.stage)
        return {"texel_size": float(np.median(sides))}

    return task.run(work)


def new_charts(maps: AssetMaps, rays: RayScene, options: TextureOptions) -> dict[str, Array]:
    """``charts_of_scene`` with texels as large as the frames, or the options, ask for, and the side
    of each object's texels in metres, (num_objects,)."""
    scene = maps.scene
    if options.texel_size:
        sizes = TexelSizes.even(scene, options.texel_size)
    else:
        most = options.max_texels or most_texels(options.memory)
        sizes = at_most(_sizes_by_frames(maps, rays), scene, most)
    given = [given_corner_uv(maps.stage, obj.prim_path) for obj in scene.objects]
    sides = np.array(sizes.of_objects(scene))
    return {**charts_of_scene(scene, given, sizes), "sides": sides}


def _sizes_by_frames(maps: AssetMaps, rays: RayScene) -> TexelSizes:
    scene, frames = maps.scene, maps.all_frames
    sizes = texel_sizes_from_frames(scene, rays, frames)
    looked_at = frames_for_patterns(frames)
    points = points_of_patterns(scene, rays, frames, looked_at)
    read = ahead(lambda i: (frames.camera(i), read_frame(frames, i)), looked_at)
    bar = progress(read, total=len(looked_at), label="patterns", unit="frames")
    # Each lighting's pixels tell its texels.
    most = max(Counter(frames.lightings).values(), default=len(frames))
    return finer_where_patterned(sizes, scene, rays, points, bar, most)


def charts_of_lightings(maps: AssetMaps) -> dict[str, Array]:
    """As ``unwrap`` left them."""
    found = [read_unwrapped(maps.stage, obj.prim_path) for obj in maps.scene.objects]
    assert maps.scene.corner_uv is not None
    return {
        "corner_uv": maps.scene.corner_uv,
        "resolution": np.array([size for size, _ in found], np.int32),
        "sides": np.array([side for _, side in found]),
    }
