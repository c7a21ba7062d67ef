"""A texel size from the capture itself: what one pixel covers of the surface."""

from __future__ import annotations

from decimal import ROUND_CEILING, Context

import numpy as np

from usdbrdf import calibration
from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import doubled_areas
from usdbrdf.model.scene import Scene
from usdbrdf.transport.rays import RayScene

_RAYS_PER_FRAME = 600
_PACKING = calibration.number("texel_size.packing")
_DIGITS = 2


def texel_size_from_frames(scene: Scene, rays: RayScene, frames: Frames, max_texels: int) -> float:
    """Median pixel footprint in metres, sqrt(area that one pixel covers), over all frames; larger
    if the surface would otherwise need more than ``max_texels``. Two significant digits, rounded
    up where ``max_texels`` decides.

    Raises InputRefused if no camera ray meets the mesh.
    """
    footprints = []
    for i in range(len(frames)):
        camera = frames.camera(i)
        stride = max(1, int(np.sqrt(camera.width * camera.height / _RAYS_PER_FRAME)))
        origins, directions = camera.rays(camera.pixels(stride))
        hits = rays.closest(origins, directions)
        met = hits.face >= 0
        corners = scene.points[scene.triangles[hits.face[met]]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        cosine = np.abs(np.einsum("rd,rd->r", normal, directions[met]))
        pixel = hits.distance[met] / np.sqrt(frames.intrinsics[i, 0] * frames.intrinsics[i, 1])
        footprints.append(pixel / np.sqrt(np.maximum(cosine, 0.1)))
    footprint = np.concatenate(footprints)
    if not len(footprint):
        raise InputRefused(
            "no camera ray meets the mesh, so no texel size can be chosen. Check that poses and "
            "mesh share one frame of reference and unit. [texturing.texel-size]"
        )
    area = doubled_areas(scene.points, scene.triangles).sum() / 2
    size = float(f"{np.median(footprint):.{_DIGITS}g}")
    least = float(np.sqrt(area / (_PACKING * max_texels)))
    return size if size >= least else _rounded_up(least)


def _rounded_up(size: float) -> float:
    return float(Context(prec=_DIGITS, rounding=ROUND_CEILING).create_decimal_from_float(size))
