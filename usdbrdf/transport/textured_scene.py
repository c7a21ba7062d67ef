"""The captured surface as light transport meets it: triangles, texels on them, rays to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from usdbrdf.model.arrays import Float
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.lights import Lights, lights_from_radiance
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import SurfaceTexture, surface_texture


@dataclass(frozen=True)
class TexturedScene:
    """A scene, its texels, and Embree's tree of its triangles."""

    scene: Scene
    texels: Texels
    rays: RayScene

    @cached_property
    def diagonal_m(self) -> float:
        """Of the scene's bounding box, metres."""
        return float(np.linalg.norm(np.ptp(self.scene.points, axis=0)))

    def texture(self, values: Float) -> SurfaceTexture:
        """Per-texel values (T, 3) as a texture that rays can look up."""
        return surface_texture(self.texels, self.scene.face_object, values)

    def lights(self, radiance: Float, brighter_than: float | None = None) -> Lights:
        """The bright triangles of a radiance (T, 3), see ``lights_from_radiance``."""
        if brighter_than is None:
            return lights_from_radiance(self.scene, self.texels, radiance)
        return lights_from_radiance(self.scene, self.texels, radiance, brighter_than)
