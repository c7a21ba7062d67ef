"""What a lens and a camera do to all frames alike: do they darken towards the corners, and does
the white balance drift from frame to frame?

With x the logarithm of what a frame shows of a point, at the distance rho from its principal point
in half diagonals, x = radiance of the point + gain of the frame + k1 rho^2 + k2 rho^4 + error. Both
kinds of means are taken off x and off the powers of rho, and what is left of x is fitted by what
is left of these (Frisch and Waugh, "Partial Time Regressions", 1933), with Huber's weights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.files.frames import FramePixels
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.agreement import MeshPoints, seen_points
from usdbrdf.texturing.exposures import surfaces_agree
from usdbrdf.transport.rays import RayScene

_OUTLYING = calibration.number("optics.outlying")
_MOST = calibration.number("optics.most")
_TOLD = calibration.number("optics.told")
_STANDING_OUT = calibration.number("optics.standing_out")
# Steps of the reweighting, and of taking means off rows and columns in turn.
_STEPS, _TURNS = 5, 12
# Samples that are compared, at least; and parts of the points whose answers are held together.
_FEWEST, _PARTS = 2000, 4


class Samples(NamedTuple):
    """Of P points in N frames: logarithms of R, G and B (P, N, 3), NaN where a frame shows nothing
    valid; squared distance from the principal point in half diagonals (P, N)."""

    logarithm: Float
    radius2: Float


class Falloff(NamedTuple):
    """k1, k2 of ln V = k1 rho^2 + k2 rho^4; stops that corners are darker by, and their error."""

    coefficients: tuple[float, float]
    stops: float
    error: float

    @property
    def is_clear(self) -> bool:
        """Whether the frames darken, or brighten, so much that it is worth telling, and not more
        than lenses do."""
        return max(_TOLD, _STANDING_OUT * self.error) < abs(self.stops) < _MOST


def samples_in_frame(
    surface: MeshPoints, rays: RayScene, camera: Camera, pixels: FramePixels
) -> tuple[Float, Float]:
    """A column of ``Samples``: (P, 3) and (P,), the mean over 3 x 3 pixels."""
    found = np.full((len(surface.point), 3), np.nan, np.float32)
    radius2 = np.zeros(len(surface.point), np.float32)
    seen, column, row = seen_points(surface, rays, camera)
    usable = pixels.valid & (pixels.radiance > 0).all(axis=2)
    level = np.where(usable[..., None], pixels.radiance, np.nan)
    around = [level[row + down, column + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
    found[seen] = np.log(np.mean(around, axis=0))
    radius2[seen] = squared_radius(camera.intrinsics, camera.width, camera.height, column, row)
    return found, radius2


def squared_radius(
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    column: Double | Long,
    row: Double | Long,
) -> Double:
    """Of pixels, from the principal point, in half diagonals of the picture."""
    _, _, cx, cy = intrinsics
    squares = (np.asarray(column) + 0.5 - cx) ** 2 + (np.asarray(row) + 0.5 - cy) ** 2
    return np.asarray(4 * squares / (width**2 + height**2), np.float64)


def falloff_of_frames(samples: Samples) -> Falloff | None:
    """How all frames darken towards their corners; None where they share too few points."""
    value = samples.logarithm.mean(axis=2).astype(np.float64)
    known = np.isfinite(value)
    known &= (known.sum(axis=1) > 1)[:, None]
    if int(known.sum()) < _FEWEST:
        return None
    # Of what no two frames show nothing is told.
    shared = np.flatnonzero(known.any(axis=1))
    part, value, known = shared % _PARTS, value[shared], known[shared]
    radius2 = samples.radius2[shared].astype(np.float64)
    whole = _coefficients(value, radius2, known)
    of_parts = [part == k for k in range(_PARTS)]
    parts = [sum(_coefficients(value[own], radius2[own], known[own])) for own in of_parts]
    error = float(np.std(parts, ddof=1)) / math.sqrt(_PARTS)
    return Falloff(whole, -sum(whole) / math.log(2), error / math.log(2))


def _coefficients(value: Double, radius2: Double, known: Bool) -> tuple[float, float]:
    weight: Double = known.astype(np.float64)
    value = np.where(known, value, 0)
    powers = (radius2, radius2**2)
    found: Double = np.zeros(2)
    for _ in range(_STEPS):
        left = _without_means(value, weight)
        basis = np.stack([_without_means(p, weight)[known] for p in powers], axis=1)
        root = np.sqrt(weight[known])[:, None]
        solved = np.linalg.lstsq(root * basis, root[:, 0] * left[known], rcond=None)[0]
        found = np.asarray(solved, np.float64)
        off = np.zeros_like(value)
        off[known] = left[known] - basis @ found
        weight = np.where(known, np.minimum(1, _OUTLYING / np.maximum(np.abs(off), 1e-9)), 0)
    return float(found[0]), float(found[1])


def _without_means(value: Double, weight: Double) -> Double:
    """(P, N) less what rows and columns have in common."""
    of_row, of_column = (np.maximum(weight.sum(axis=axis), 1e-12) for axis in (1, 0))
    left = value.copy()
    for _ in range(_TURNS):
        _take_means(weight, of_row, of_column, left)
    return left


@loop
def _take_means(weight: Double, of_row: Double, of_column: Double, left: Double) -> None:
    """Off each number what its row has in common, and of what is left what its column has."""
    in_column = np.zeros(len(of_column))
    for i in range(len(left)):
        in_row = 0.0
        for j in range(len(in_column)):
            in_row += weight[i, j] * left[i, j]
        in_row /= of_row[i]
        for j in range(len(in_column)):
            left[i, j] -= in_row
            in_column[j] += weight[i, j] * left[i, j]
    in_column /= of_column
    for i in range(len(left)):
        for j in range(len(in_column)):
            left[i, j] -= in_column[j]


def balance_drift(samples: Samples, owner: Int) -> Double | None:
    """(N,) how far each frame's red or blue is off the others' beside its green, in stops; 0
    where that is much and a frame shows too little, or its surfaces do not agree; None where all
    share too few points.

    owner  (P,) the surface that a point is of
    """
    logarithm = samples.logarithm.astype(np.float64)
    known = np.isfinite(logarithm).all(axis=2)
    known &= (known.sum(axis=1) > 1)[:, None]
    if int(known.sum()) < _FEWEST:
        return None
    worst = np.zeros(logarithm.shape[1])
    shared = known.any(axis=1)
    for channel in (0, 2):
        beside_green = logarithm[..., channel] - logarithm[..., 1]
        hue = np.where(known, beside_green, np.nan)[shared]
        gain = np.zeros(hue.shape[1])
        seen = np.isfinite(hue).any(axis=0)
        for _ in range(_STEPS):
            usual = np.nanmedian(hue - gain, axis=1, keepdims=True)
            gain[seen] = np.nanmedian((hue - usual)[:, seen], axis=0)
        gain -= np.median(gain)
        size = np.abs(gain)
        # Of two views the middle is half way between: neither tells which of them is off.
        brighter = np.where(known[shared].sum(axis=1)[:, None] > 2, hue - usual, np.nan)
        off = np.flatnonzero(size > _TOLD * math.log(2))
        size[off] *= surfaces_agree(brighter[:, off], gain[off], owner[shared])
        worst = np.maximum(worst, size)
    return worst / math.log(2)


def drifts(drift: Double) -> Bool:
    """(N,) frames whose balance is off so much that it is worth telling."""
    return np.asarray(drift > _TOLD, np.bool_)
