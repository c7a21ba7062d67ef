"""One object's roughness and specular from many views, its diffuse radiance left free per texel.

A texel's diffuse radiance is the same in all frames that see it. Taking each texel's mean over its
views off the samples, and off the lobe's two parts alike, removes it: what is left is how the
radiance changes with the view, which only the lobe explains. The median texture, which holds the
specular light that is seen from everywhere, then enters as incident light only.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.texels import Texels
from usdbrdf.material.grid_fit import GridFit, fit_grid, mean_of
from usdbrdf.material.lit_scene import LitScene, View, sub_pixel_points
from usdbrdf.material.lobe_samples import Mixture, lobe_basis
from usdbrdf.material.observations import Observations
from usdbrdf.material.target_frames import SurfacePoints

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]

# A bilinear sample spreads over the pixels with a standard deviation of half a pixel per axis, and
# so do four points half a pixel off, diagonally.
_FOOTPRINT = 0.5
# Relative error of a sample besides the frame's noise: poses, footprints, L_d as incident light.
_MODEL_ERROR = 0.03
MIN_OBSERVATIONS = 48
# Noise in the lobe itself draws psi towards 0: wide lobes get more rays than a picture would need.
_MIXTURE = Mixture(per_lobe=8, lights=24, cosine=16)


def fit_views(
    lit: LitScene,
    texels: Texels,
    observed: Observations,
    view_of: Callable[[int], View],
    index: int,
    seed: int,
) -> tuple[GridFit | None, int]:
    """Fit object ``index`` to its observations: (fit, number of samples), fit None if too few.

    view_of(frame) gives poses and pinholes; the images themselves are not needed any more.
    """
    if not len(observed.texel):
        return None, 0
    kept, points = _points(lit, texels, observed, view_of, index)
    observed = observed.take(kept)
    group = np.unique(observed.texel, return_inverse=True)[1].astype(np.int64)
    several = np.bincount(group)[group] > 1 if len(group) else np.zeros(0, np.bool_)
    if np.count_nonzero(several) < MIN_OBSERVATIONS:
        return None, int(np.count_nonzero(several))
    points = points.take(np.flatnonzero(np.repeat(several, 4)))
    observed = observed.take(np.flatnonzero(several))
    group = np.unique(observed.texel, return_inverse=True)[1].astype(np.int64)
    # Views of a texel share their random numbers: what they have in common then cancels in their
    # differences, which are all that is fitted.
    stream = (4 * group[:, None] + np.arange(4)).ravel()
    basis = lobe_basis(lit, points, len(group), seed, _MIXTURE, stream)
    level = np.bincount(group, observed.radiance.mean(axis=1)) / np.bincount(group)
    weight = 1 / ((_MODEL_ERROR * level[group]) ** 2 + observed.noise.astype(np.float64) ** 2)
    root = np.sqrt(weight)[:, None]
    return fit_grid(
        observed.radiance, weight[:, None].astype(np.float64), basis, mean_of(group, root)
    ), len(group)


def _points(
    lit: LitScene,
    texels: Texels,
    observed: Observations,
    view_of: Callable[[int], View],
    index: int,
) -> tuple[npt.NDArray[np.int64], SurfacePoints]:
    """The observations whose footprint lies on the object as a whole, and four surface points of
    each, in order of the observations."""
    kept, parts = [], []
    for frame in np.unique(observed.frame):
        which = np.flatnonzero(observed.frame == frame)
        view = view_of(int(frame))
        pixels = _project(texels.position[observed.texel[which]], view)
        whole, points = sub_pixel_points(lit, view, pixels, index, _FOOTPRINT)
        kept.append(which[whole])
        parts.append(points)
    unordered = np.concatenate(kept)
    order = np.argsort(unordered, kind="stable")
    four = (4 * order[:, None] + np.arange(4)).ravel()
    return unordered[order], SurfacePoints.joined(parts).take(four)


def _project(position: Float, view: View) -> npt.NDArray[np.float64]:
    """Pixel coordinates (P, 2) of world points (P, 3)."""
    camera_from_world = np.linalg.inv(view.world_from_camera)
    in_camera = position @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    fx, fy, cx, cy = view.intrinsics
    depth = -in_camera[:, 2]
    return np.stack([cx + fx * in_camera[:, 0] / depth, cy - fy * in_camera[:, 1] / depth], axis=-1)
