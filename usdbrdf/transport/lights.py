"""The bright part of the surface, as triangles that rays can be sent to on purpose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.mesh import across_triangles, doubled_areas
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.light_groups import LightGroups, light_groups

# Surface brighter than this many times the scene's area-mean radiance is worth its own rays; the
# cosine-distributed ones find everything dimmer well enough.
_BRIGHTER_THAN = 3.0


@dataclass(frozen=True, kw_only=True)
class Lights:
    """K triangles and a density over their surface.

    face         (K,) int32, indices into the scene's triangles
    cumulative   (K,) float64, ascending to 1: probability of picking one of the first k
    density      (F,) float32, probability per m^2 of a point on any triangle of the scene (0 on
                 those that are no light)
    corners      (K, 3, 3) float32, metres, and normals (K, 3) float32, unit, of the lights
    """

    face: Int
    cumulative: Double
    density: Float
    corners: Float
    normals: Float

    @cached_property
    def groups(self) -> LightGroups:
        return light_groups(self.face, self.cumulative, self.density, self.corners, self.normals)


def lights_from_radiance(
    scene: Scene, texels: Texels, radiance: Float, brighter_than: float = _BRIGHTER_THAN
) -> Lights:
    """Triangles whose mean L_d is ``brighter_than`` so many times the scene's area mean, picked in
    proportion to area times radiance.

    radiance (T, 3): L_d per texel. Triangles smaller than a texel take the texel under their
    centre through their neighbours' mean, so that no lit triangle is left out.
    """
    brightness = radiance.max(axis=1)
    weight = np.where(texels.interior, texels.area, 0)
    num_faces = len(scene.triangles)
    power = np.bincount(texels.face, brightness * weight, num_faces).astype(np.float64)
    covered = np.bincount(texels.face, weight, num_faces).astype(np.float64)
    mean = _mean_per_face(scene, texels, brightness, power, covered)

    doubled = doubled_areas(scene.points, scene.triangles)
    area = doubled / 2
    scene_mean = float((mean * area).sum() / max(area.sum(), 1e-30))
    bright = (mean > brighter_than * scene_mean) & (area > 0)
    share = np.where(bright, mean * area, 0)
    total = share.sum()
    face = np.flatnonzero(bright).astype(np.int32)
    density = np.zeros(len(area), np.float32)
    density[face] = share[face] / total / area[face]
    triangles = scene.triangles[face]
    normals = across_triangles(scene.points, triangles) / doubled[face, None]
    return Lights(
        face=face,
        cumulative=np.cumsum(share[face]) / total if len(face) else np.zeros(0),
        density=density,
        corners=scene.points[triangles].astype(np.float32),
        normals=normals.astype(np.float32),
    )


def _mean_per_face(
    scene: Scene, texels: Texels, brightness: Float, power: Double, covered: Double
) -> Double:
    """Mean brightness of each face; one without a texel centre reads the texel at its centroid."""
    mean = power / np.maximum(covered, 1e-30)
    bare = np.flatnonzero(covered <= 0)
    if len(bare):
        centre = np.floor(texels.corner_pixel[bare].mean(axis=1)).astype(np.int64)
        size = texels.resolution[scene.face_object[bare]]
        centre = np.clip(centre, 0, size - 1)
        pixel = texels.first_pixel[scene.face_object[bare]] + centre[:, 1] * size[:, 0]
        mean[bare] = brightness[texels.nearest_texel[pixel + centre[:, 0]]]
    return mean
