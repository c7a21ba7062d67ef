"""What the fits share: the scene with its light, a frame, and surface points under its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.scene import Scene
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.material.target_frames import SurfacePoints, visible_points
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.lights import Lights

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class LitScene:
    """All that light transport needs: geometry, L_d as texture and as lights, surroundings, the
    emission mask, and the scene's size in metres."""

    scene: Scene
    rays: RayScene
    radiance: SurfaceTexture
    lights: Lights
    emission: SurfaceTexture
    environment: Environment
    size: float

    def owner(self, face: Int) -> Int:
        """The object of each face (R,), -1 where the face is -1."""
        return np.where(face >= 0, self.scene.face_object[face], -1).astype(np.int32)


@dataclass(frozen=True, kw_only=True)
class View:
    """One frame as the fit sees it: radiance (H, W, 3), valid (H, W), pose and pinhole."""

    radiance: Float
    valid: Bool
    world_from_camera: Double
    intrinsics: Double


def sub_pixel_points(
    lit: LitScene, view: View, pixels: Double, index: int, offsets: Double
) -> tuple[Bool, SurfacePoints]:
    """Surface points at ``offsets`` (K, 2) in pixels from each of the pixel coordinates (P, 2).

    Returns which pixels have all K on object ``index``, (P,) bool, and their points in order.
    """
    inside = (pixels[:, None] + offsets).reshape(-1, 2)
    points = visible_points(lit.rays, lit.scene, view.world_from_camera, view.intrinsics, inside)
    whole = (lit.owner(points.face) == index).reshape(-1, len(offsets)).all(axis=1)
    return whole, points.take(np.flatnonzero(np.repeat(whole, len(offsets))))
