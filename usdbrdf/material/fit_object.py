"""One object's roughness and specular from its target frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.cameras import pixel_centres
from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.scene import Scene
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.material.grid_fit import GridFit, Residual, fit_grid
from usdbrdf.material.lobe_samples import Mixture, non_diffuse, trace_lobe_samples
from usdbrdf.material.target_frames import (
    SurfacePoints,
    mirror_hits_emitter,
    object_pixels,
    visible_points,
)
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.lights import Lights

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

# A pixel sees an area: its rays start at 2 x 2 points of it. On small curved objects the normal
# turns within a pixel; taken at its centre alone, the highlight looks rougher than it is.
_SUBPIXELS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
# Fewer pixels than this say nothing about two parameters.
MIN_PIXELS = 12


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


@dataclass(frozen=True, kw_only=True)
class View:
    """One frame as the fit sees it: radiance (H, W, 3), valid (H, W), pose and pinhole."""

    radiance: Float
    valid: Bool
    world_from_camera: Double
    intrinsics: Double


def fit_object(
    lit: LitScene, view: View, index: int, residual: Residual, max_pixels: int, seed: int
) -> tuple[GridFit | None, int]:
    """Fit object ``index`` in its target frame: (fit, number of pixels), fit None if too few.

    Each pixel is the mean of 2 x 2 surface points with 52 rays each, traced once for all
    roughnesses.
    """
    chosen, stands_for, points = _points_of_object(lit, view, index, max_pixels, seed)
    if len(chosen) < MIN_PIXELS:
        return None, len(chosen)
    samples = trace_lobe_samples(
        lit.rays, points, lit.radiance, lit.lights, lit.environment, Mixture(), lit.size, seed
    )

    def per_pixel(values: Float) -> Float:
        return values.reshape(-1, len(_SUBPIXELS), 3).mean(axis=1)

    def basis(phi: float) -> tuple[Float, Float]:
        base, slope = non_diffuse(samples, phi)
        return per_pixel(base), per_pixel(slope)

    diffuse = per_pixel(lit.radiance.at(points.face, points.u, points.v))
    observed = view.radiance.reshape(-1, 3)[chosen]
    # The paper sums over all pixels alike; what was left out is stood for by what was taken.
    weight = (stands_for / max(float(stands_for.mean()), 1e-12))[:, None]
    if residual == "scaled":
        # Highlights count for more than their share of pixels. Errors of L_d and of the frame grow
        # with the radiance; the floor keeps the noise of dark pixels small.
        level = diffuse.mean(axis=1, keepdims=True)
        weight = 1 / (level + np.float32(0.1) * np.median(level)) ** 2
    return fit_grid(observed, diffuse, weight, basis, residual), len(chosen)


def _points_of_object(
    lit: LitScene, view: View, index: int, max_pixels: int, seed: int
) -> tuple[npt.NDArray[np.int64], Float, SurfacePoints]:
    """The pixels to fit (flat indices), how many pixels each stands for, and the four surface
    points of each, in order."""
    height, width = view.valid.shape
    pixels = pixel_centres(width, height)
    pose, lens = view.world_from_camera, view.intrinsics
    seen = visible_points(lit.rays, lit.scene, pose, lens, pixels)
    owner = _owner(lit.scene, seen).reshape(height, width)
    mirrored = mirror_hits_emitter(lit.rays, seen, lit.emission, lit.size)
    highlight = mirrored.reshape(height, width) & view.valid
    random = np.random.default_rng([seed, index])
    chosen, stands_for = object_pixels(
        owner, view.valid, highlight, index, max_pixels, random.permutation
    )
    inside = (pixels[chosen][:, None] + _SUBPIXELS).reshape(-1, 2)
    points = visible_points(lit.rays, lit.scene, pose, lens, inside)
    whole = (_owner(lit.scene, points) == index).reshape(-1, len(_SUBPIXELS)).all(axis=1)
    keep = np.repeat(whole, len(_SUBPIXELS))
    kept = {name: values[keep] for name, values in vars(points).items()}
    return chosen[whole], stands_for[whole], SurfacePoints(**kept)


def _owner(scene: Scene, points: SurfacePoints) -> npt.NDArray[np.int32]:
    return np.where(points.face >= 0, scene.face_object[points.face], -1).astype(np.int32)
