"""One object's roughness and specular from its target frame alone (the paper's way)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.cameras import pixel_centres
from usdbrdf.material.grid_fit import GridFit, fit_grid, multiple_of, nothing
from usdbrdf.material.lit_scene import LitScene, View, sub_pixel_points
from usdbrdf.material.lobe_samples import lobe_basis
from usdbrdf.material.target_frames import (
    SurfacePoints,
    mirror_hits_emitter,
    object_pixels,
    visible_points,
)

Float = npt.NDArray[np.float32]

Residual = Literal["paper", "scaled"]

# A pixel sees an area: its rays start at 2 x 2 points of it. On small curved objects the normal
# turns within a pixel; taken at its centre alone, the highlight looks rougher than it is.
_SUB_PIXEL = 0.25 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
# Fewer pixels than this say nothing about two parameters.
MIN_PIXELS = 12


def fit_target_frame(
    lit: LitScene, view: View, index: int, residual: Residual, max_pixels: int, seed: int
) -> tuple[GridFit | None, int]:
    """Fit object ``index`` in its target frame: (fit, number of pixels), fit None if too few.

    Each pixel is the mean of 2 x 2 surface points with 52 rays each, traced once for all
    roughnesses.
    """
    chosen, stands_for, points = _points_of_object(lit, view, index, max_pixels, seed)
    if len(chosen) < MIN_PIXELS:
        return None, len(chosen)
    of_phis = lobe_basis(lit, points, len(chosen), seed)

    def basis(phi: float) -> tuple[Float, Float]:
        base, slope = of_phis([phi])
        return base[..., 0], slope[..., 0]

    diffuse = lit.radiance.at(points.face, points.u, points.v)
    diffuse = diffuse.reshape(len(chosen), -1, 3).mean(axis=1)
    observed = view.radiance.reshape(-1, 3)[chosen]
    if residual == "paper":
        # The paper sums over all pixels alike; what was left out is stood for by what was taken.
        weight = (stands_for / max(float(stands_for.mean()), 1e-12))[:, None]
        return fit_grid(observed - diffuse, weight, basis, nothing), len(chosen)
    # Highlights count for more than their share of pixels. Errors of L_d and of the frame grow with
    # the radiance; the floor keeps the noise of dark pixels small.
    level = diffuse.mean(axis=1, keepdims=True)
    floor = max(0.1 * float(np.median(level)), 1e-9)
    weight = (1 / (level + floor) ** 2).astype(np.float32)
    return fit_grid(observed, weight, basis, multiple_of(diffuse * np.sqrt(weight))), len(chosen)


def _points_of_object(
    lit: LitScene, view: View, index: int, max_pixels: int, seed: int
) -> tuple[npt.NDArray[np.int64], Float, SurfacePoints]:
    """The pixels to fit (flat indices), how many pixels each stands for, and the four surface
    points of each, in order."""
    height, width = view.valid.shape
    pixels = pixel_centres(width, height)
    seen = visible_points(lit.rays, lit.scene, view.world_from_camera, view.intrinsics, pixels)
    owner = lit.owner(seen.face).reshape(height, width)
    mirrored = mirror_hits_emitter(lit.rays, seen, lit.emission, lit.size)
    highlight = mirrored.reshape(height, width) & view.valid
    random = np.random.default_rng([seed, index])
    chosen, stands_for = object_pixels(
        owner, view.valid, highlight, index, max_pixels, random.permutation
    )
    whole, points = sub_pixel_points(lit, view, pixels[chosen], index, _SUB_PIXEL)
    return chosen[whole], stands_for[whole], points
