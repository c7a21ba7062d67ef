"""How far pictures were smoothed, as their noise tells.

Sensors' noise differs from pixel to pixel. Where neighbouring pixels err alike, a noise reduction,
a renderer's denoiser or a resampling has spread both the noise and the picture; highlights on
curved objects then look wider than the surface is rough.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from usdbrdf.material.lit_scene import LitScene, View
from usdbrdf.material.target_frames import visible_points

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]

# The noise is looked at in tiles of so many pixels that show one object alone, so many per frame.
_TILE, _TILES = 24, 60
_FEWEST_TILES = 30
_LAGS = 3
# Errors of the model hang together a little too: less than this at neighbouring pixels is nothing,
# and what hangs together farther than any smoothing, in pixels, is structure of the surface.
_WHITE = 0.05
_WIDEST = 3.0


def noise_correlation(lit: LitScene, view: View) -> Double:
    """(N, 3): of N tiles of a frame, the correlation of its relative deviation from L_d between
    pixels 1, 2 and 3 apart."""
    height, width = view.valid.shape
    corners = [
        (row, column)
        for row in range(0, height - _TILE + 1, _TILE)
        for column in range(0, width - _TILE + 1, _TILE)
        if view.valid[row : row + _TILE, column : column + _TILE].all()
    ]
    chosen = np.linspace(0, len(corners) - 1, min(_TILES, len(corners))).round().astype(int)
    if not len(chosen):
        return np.zeros((0, _LAGS))
    within = np.moveaxis(np.indices((_TILE, _TILE)), 0, -1)
    place = np.array(corners)[chosen][:, None, None] + within
    pixels = place[..., ::-1].reshape(-1, 2) + 0.5
    seen = visible_points(lit.rays, lit.scene, view.world_from_camera, view.intrinsics, pixels)
    diffuse = lit.radiance.at(seen.face, seen.u, seen.v).reshape(len(chosen), _TILE, _TILE, 3)
    owner = lit.owner(seen.face).reshape(len(chosen), -1)
    alone = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    alone &= (diffuse > 0).all(axis=(1, 2, 3))
    shown = view.radiance[place[alone, ..., 0], place[alone, ..., 1]]
    return correlations((shown / diffuse[alone]).mean(axis=-1, dtype=np.float64))


def correlations(tiles: Double) -> Double:
    """(N, 3) correlation between pixels 1, 2 and 3 apart in tiles (N, H, W)."""
    rest = tiles - tiles.mean(axis=(1, 2), keepdims=True)
    power = np.maximum((rest**2).mean(axis=(1, 2)), 1e-30)
    each = [
        (rest[:, lag:] * rest[:, :-lag]).mean(axis=(1, 2))
        + (rest[:, :, lag:] * rest[:, :, :-lag]).mean(axis=(1, 2))
        for lag in range(1, _LAGS + 1)
    ]
    found: Double = np.stack(each, axis=1) / (2 * power[:, None])
    return found


def smoothing_of(tiles: Sequence[Double]) -> float:
    """Standard deviation in pixels of what smoothed the pictures, 0 if nothing did, NaN if they do
    not tell.

    White noise that a normal distribution of standard deviation s has smoothed correlates as
    exp(-d^2 / (4 s^2)) over a distance d. White noise that came on top, later, lessens all alike:
    so the ratio of two correlations tells s. tiles: ``noise_correlation`` of frames.
    """
    every = np.concatenate([np.zeros((0, _LAGS)), *tiles])
    if len(every) < _FEWEST_TILES:
        return math.nan
    first, _, last = np.median(every, axis=0)
    if first < _WHITE:
        return 0.0
    ratio = max(float(last / first), 0.01)
    if ratio > math.exp(-(_LAGS**2 - 1) / (4 * _WIDEST**2)):
        return math.nan
    return math.sqrt((_LAGS**2 - 1) / (-4 * math.log(ratio)))
