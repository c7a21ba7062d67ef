"""What is measured between a picture or a map and its reference."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

# The exposure brings this percentile of the mean of R, G and B to this linear value.
PERCENTILE, SHOWN_AS = 90, 0.8


def relative_l2(image: Float, reference: Float, counted: Bool) -> float:
    """||image - reference|| / ||reference|| over the pixels ``counted``; NaN without light there.

    image, reference (H, W, 3) linear radiance; counted (H, W). Values elsewhere may be NaN.
    """
    x, ref = image[counted].astype(np.float64), reference[counted].astype(np.float64)
    norm = float(np.linalg.norm(ref))
    return float(np.linalg.norm(x - ref)) / norm if norm > 0 else math.nan


def psnr(image: Float, reference: Float, counted: Bool) -> float:
    """Peak signal to noise ratio in dB, -10 log10(mean squared error), of display values in [0, 1]
    over the pixels ``counted``; infinite for equal pictures, NaN where nothing is counted."""
    if not counted.any():
        return math.nan
    error = float(np.mean((image[counted].astype(np.float64) - reference[counted]) ** 2))
    return -10 * math.log10(error) if error > 0 else math.inf


def exposure_of(level: Float) -> float:
    """The factor that shows the 90th percentile of ``level`` (P,), mean of R, G and B, as 0.8."""
    bright = float(np.percentile(level, PERCENTILE)) if len(level) else 0.0
    return SHOWN_AS / bright if bright > 0 else 1.0


def nrmse(values: Float, reference: Float, area: Float) -> float:
    """||values - reference|| / ||reference|| of maps (T, C), weighted by texel area (T,): root mean
    square error over root mean square. NaN where the reference is 0 everywhere or empty."""
    weight = area.astype(np.float64)[:, None]
    norm = float((weight * reference.astype(np.float64) ** 2).sum())
    error = float((weight * (values.astype(np.float64) - reference) ** 2).sum())
    return math.sqrt(error / norm) if norm > 0 else math.nan


def median_relative(values: Float, reference: Float) -> tuple[float, float]:
    """Median of |values / reference - 1| and of values / reference - 1; NaN where empty."""
    if not values.size:
        return math.nan, math.nan
    relative = values / np.maximum(reference, 1e-6) - 1
    return float(np.median(np.abs(relative))), float(np.median(relative))


def finite(value: float, digits: int | None = None) -> float | None:
    """A number for a JSON document, which has no NaN and no infinity: None for those."""
    if not math.isfinite(value):
        return None
    return float(value) if digits is None else round(float(value), digits)
