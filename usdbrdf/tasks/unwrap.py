"""How the objects' textures are laid out; where several lightings share that, a task of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.asset.layers.task_layers import write_uv_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import UnwrappedObject
from usdbrdf.asset.readers.compose import hashes_of_inputs, open_weaker
from usdbrdf.asset.readers.scene import given_corner_uv, read_unwrapped
from usdbrdf.geometry.unwrap import TexelSizes, charts_of_scene
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.model.arrays import Int
from usdbrdf.model.scene import Scene
from usdbrdf.options import TextureOptions
from usdbrdf.tasks.task import Task
from usdbrdf.texturing.footprints import texel_sizes_from_frames
from usdbrdf.texturing.passes import most_texels
from usdbrdf.transport.rays import RayScene


def unwrap(asset: Asset, options: TextureOptions) -> TaskResult:
    """Lay out the textures that all lightings of an asset share, by the frames of all of them."""
    maps = AssetMaps(open_weaker(asset, "texturing"))
    task = Task(
        asset=asset,
        name="unwrap",
        role="texturing",
        parameters={k: v for k, v in asdict(options).items() if k not in ("memory", "quantile")},
        inputs=hashes_of_inputs(asset, "texturing", maps),
    )

    def work(run: TaskRun) -> dict[str, Any]:
        rays = RayScene(maps.scene.points, maps.scene.triangles)
        atlas = laid_out(run, maps, rays, options)
        assert atlas.scene.corner_uv is not None
        objects = [
            UnwrappedObject(
                prim_path=obj.prim_path,
                identifier=obj.identifier,
                corner_uv=atlas.scene.corner_uv[obj.faces],
                texel_size=atlas.sides[i],
                resolution=(int(atlas.resolution[i, 0]), int(atlas.resolution[i, 1])),
            )
            for i, obj in enumerate(atlas.scene.objects)
        ]
        uv = run.output(f"layers/{asset.uv_layer.name}")
        write_uv_layer(uv, task.draft, objects, maps.stage)
        return {"texel_size": float(np.median(atlas.sides))}

    return task.run(work)


class Atlas(NamedTuple):
    """The scene with its texture coordinates, width and height of each object's textures
    (num_objects, 2) int32, and the sides of their texels in metres."""

    scene: Scene
    resolution: Int
    sides: Sequence[float]


def laid_out(run: TaskRun, maps: AssetMaps, rays: RayScene, options: TextureOptions) -> Atlas:
    """Every object unwrapped, its texels as large as the frames, or the options, ask for."""
    scene = maps.scene
    if options.texel_size:
        sizes = TexelSizes.even(scene, options.texel_size)
    else:
        most = options.max_texels or most_texels(options.memory)
        sizes = texel_sizes_from_frames(scene, rays, maps.all_frames, most)
    given = [given_corner_uv(maps.stage, obj.prim_path) for obj in scene.objects]
    charts = run.checkpoint("charts", lambda: charts_of_scene(scene, given, sizes))
    unwrapped = replace(scene, corner_uv=charts["corner_uv"])
    return Atlas(unwrapped, charts["resolution"], sizes.of_objects(scene))


def atlas_of_lightings(maps: AssetMaps) -> Atlas:
    """As ``unwrap`` left it."""
    found = [read_unwrapped(maps.stage, obj.prim_path) for obj in maps.scene.objects]
    resolution = np.array([size for size, _ in found], np.int32)
    return Atlas(maps.scene, resolution, [side for _, side in found])
