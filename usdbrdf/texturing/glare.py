"""Where a lamp is so near in the image that some of its light lies on other things' pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf import calibration
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Bool, Float

Count = npt.NDArray[np.int64]
_GLARING = calibration.number("glare.from")
_REACH = calibration.count("glare.reach")


def brightest_glare(radiance: Float, valid: Bool, clipped: Bool) -> Float:
    """(H, W) float32: the brightest glaring pixel nearby, in any channel; 0 where there is none."""
    level = np.empty(valid.shape, np.float32)
    _levels(radiance, valid, clipped, level)
    brightest = np.zeros(valid.shape, np.float32)
    glares = np.zeros(len(level), np.bool_)
    _keep_above(np.float32(_GLARING * _median(level, valid)), level, glares)
    if glares.any():
        _spread(level, glares, brightest)
    return brightest


@parallel_kernel
def _levels(radiance: Float, valid: Bool, clipped: Bool, level: Float) -> None:
    """The brightest channel; 0 where a pixel is neither valid nor clipped."""
    height, width = valid.shape
    for j in prange(height):
        for i in range(width):
            known = valid[j, i] or clipped[j, i]
            brightest = max(radiance[j, i, 0], radiance[j, i, 1], radiance[j, i, 2])
            level[j, i] = brightest if known else np.float32(0)


def _median(level: Float, valid: Bool) -> float:
    """np.median of the valid levels, in a quarter of its time; 0 if there are none."""
    levels = level[valid]
    if not len(levels):
        return 0.0
    middle = [(len(levels) - 1) // 2, len(levels) // 2]
    return float(np.partition(levels, middle)[middle].mean())


@parallel_kernel
def _keep_above(limit: np.float32, level: Float, glares: Bool) -> None:
    """Zero what glares not; ``glares`` (H,): rows where anything is left."""
    height, width = level.shape
    for j in prange(height):
        for i in range(width):
            if level[j, i] > limit:
                glares[j] = True
            else:
                level[j, i] = 0


@parallel_kernel
def _spread(level: Float, glares: Bool, brightest: Float) -> None:
    """The largest level within _REACH pixels to all sides."""
    height, width = level.shape
    for j in prange(height):
        for k in range(max(0, j - _REACH), min(height, j + _REACH + 1)):
            if not glares[k]:
                continue
            for i in range(width):
                for n in range(max(0, i - _REACH), min(width, i + _REACH + 1)):
                    brightest[j, i] = max(brightest[j, i], level[k, n])
