"""Where the texels of a capture are to lie: sizes from what its frames show, charts for these."""

from __future__ import annotations

import numpy as np

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import given_corner_uv
from usdbrdf.geometry.unwrap import TexelSizes, charts_of_scene
from usdbrdf.model.arrays import Array
from usdbrdf.options import TextureOptions
from usdbrdf.texturing.footprints import texel_sizes_from_frames
from usdbrdf.texturing.passes import most_texels
from usdbrdf.transport.rays import RayScene


def new_charts(maps: AssetMaps, rays: RayScene, options: TextureOptions) -> dict[str, Array]:
    """``charts_of_scene``, and the side of each object's texels in metres, (num_objects,)."""
    scene = maps.scene
    if options.texel_size:
        sizes = TexelSizes.even(scene, options.texel_size)
    else:
        most = options.max_texels or most_texels(options.memory)
        sizes = texel_sizes_from_frames(scene, rays, maps.frames, most)
    given = [given_corner_uv(maps.stage, obj.prim_path) for obj in scene.objects]
    sides = np.array(sizes.of_objects(scene))
    return {**charts_of_scene(scene, given, sizes), "sides": sides}
